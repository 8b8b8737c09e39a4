"""The cause of pictures that are not used for seconds."""

import numpy as np
import pytest

from terrafix.estimator.monitors.refused_pictures import (
    AWAY,
    EMPTY,
    FROZEN,
    INPUT_KINDS,
    OTHER,
    UNSEEN,
    RefusedInput,
    UnseenGround,
)
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


def unseen_of(*shown: bool, fragments: list[int], step: float = 0.3) -> UnseenGround:
    """Correlations of frames of these fragments, half a second and ``step`` heights apart."""
    unseen = UnseenGround()
    for k, (found, fragment) in enumerate(zip(shown, fragments, strict=True)):
        unseen.add(k * 500_000_000, fragment, np.array([k * step, 0.0]), shown=found)
    return unseen


def test_pictures_after_an_interruption_that_the_map_does_not_show_are_named_from_their_first_one_on() -> None:
    unseen = unseen_of(*[True] * 40, *[False] * 4, fragments=[0] * 40 + [1] * 4)
    assert unseen.since_ns == 20_000_000_000
    refused = RefusedInput()
    (began,) = refused.add(22_000_000_000, "", (UNSEEN, unseen.since_ns))
    assert (began.quantity, began.t_ns) == (UNSEEN, 20_000_000_000) and fault_text(began) == UNSEEN
    unseen.add(23_000_000_000, 1, np.zeros(2), shown=True)
    assert unseen.since_ns is None
    later = [refused.add(k * 1_000_000_000, "") for k in (23, 24, 25)]
    assert [fault.active for faults in later for fault in faults] == [False]


@pytest.mark.parametrize(
    ("shown", "fragments", "step"),
    [
        pytest.param([True] * 40 + [False] * 9, [0] * 49, 0.3, id="without an interruption it is other ground"),
        pytest.param([True, False] * 20 + [False] * 5, [0] * 40 + [1] * 5, 0.3, id="of ground that is hardly shown"),
        pytest.param([True] * 40 + [False] * 9, [0] * 40 + [1] * 9, 0.02, id="hovering: the same ground counts once"),
        pytest.param([False] * 40, [0] * 20 + [1] * 20, 0.3, id="a map that shows nothing"),
    ],
)
def test_ground_that_the_map_does_not_show_is_no_other_picture(
    shown: list[bool], fragments: list[int], step: float
) -> None:
    assert unseen_of(*shown, fragments=fragments, step=step).since_ns is None
