"""The cause of pictures that are not used for seconds."""

import pytest

from terrafix.estimator.monitors.refused_pictures import AWAY, EMPTY, FROZEN, INPUT_KINDS, OTHER, RefusedInput
from terrafix.link.pilot_text.statustext import fault_text
from terrafix.messages import CalibrationFault, Verdict


def faults_of(*verdicts: Verdict) -> list[CalibrationFault]:
    """Of frames half a second apart."""
    refused = RefusedInput()
    return [
        fault for k, verdict in enumerate(verdicts) for fault in refused.add(k * 500_000_000, INPUT_KINDS.get(verdict))
    ]


@pytest.mark.parametrize(
    ("verdicts", "quantity"),
    [
        ([Verdict.STALLED] * 7, FROZEN),
        ([Verdict.FEW_INLIERS, Verdict.IMPLAUSIBLE, *[Verdict.UNCONFIRMED] * 6], OTHER),
        ([Verdict.FEW_INLIERS] * 8, EMPTY),
        ([Verdict.NO_GROUND] * 7, AWAY),
    ],
)
def test_a_run_of_refused_pictures_is_named_from_its_first_one_to_three_used_ones(
    verdicts: list[Verdict], quantity: str
) -> None:
    used = [Verdict.ACCEPTED]
    began, ended = faults_of(*used, *verdicts, *used * 3)
    assert (began.quantity, began.active, began.t_ns) == (quantity, True, 500_000_000)
    assert (ended.quantity, ended.active) == (quantity, False)
    assert fault_text(began) == f"{quantity}: not used" and len(f"Terrafix: {fault_text(began)}") <= 50


def test_less_than_three_seconds_and_frames_without_an_image_are_not_named() -> None:
    assert faults_of(*[Verdict.STALLED] * 6, Verdict.ACCEPTED) == []
    assert faults_of(*[Verdict.OVERTAKEN] * 20, Verdict.STALLED, *[Verdict.DEGENERATE] * 20) == []
    began, *others = faults_of(*[Verdict.STALLED] * 8, Verdict.ACCEPTED, Verdict.ACCEPTED, *[Verdict.STALLED] * 9)
    assert began.active and others == [], "two used ones are no end"
