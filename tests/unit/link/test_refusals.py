"""What is recorded, and said to the pilot, of telemetry that was refused."""

import pytest

from link_rig import MS, S
from terrafix import messages as m
from terrafix.link.admission.refusals import EPISODE_NS, MANY, PILOT_TEXTS, Reason, Refusals


def test_each_reason_is_recorded_at_once_and_then_once_a_second_with_its_count() -> None:
    refusals, said = Refusals(), []
    for i in range(100):
        refusals.add(Reason.ATTITUDE, f"number {i}", S + i * 20 * MS)
        if i == 50:
            refusals.add(Reason.BOOT_TIME, "x", S + i * 20 * MS)
        said += [(i, v.detail) for v in refusals.verdicts(S + i * 20 * MS)]
    assert said == [(0, "attitude: number 0"), (50, "attitude: number 50 (50 messages)"), (50, "boot time: x")]
    assert next(iter(refusals.verdicts(4 * S))).detail == "attitude: number 99 (49 messages)"
    assert list(refusals.verdicts(9 * S)) == []


def test_the_verdict_is_of_telemetry_and_of_no_frame() -> None:
    refusals = Refusals()
    refusals.add(Reason.SEQUENCE, "x", S)
    (verdict,) = refusals.verdicts(S)
    assert (verdict.t_ns, verdict.frame_id, verdict.measurement) == (S, -1, "telemetry")
    assert verdict.verdict is m.Verdict.IMPLAUSIBLE


def test_the_pilot_is_told_once_an_episode_and_of_many_messages_only() -> None:
    refusals = Refusals()
    told = []
    for i in range(3 * MANY):
        at_ns = S + i * MS + (EPISODE_NS if i >= 2 * MANY else 0)
        refusals.add(Reason.ATTITUDE, "x", at_ns)
        told += [(i, text) for text in refusals.pilot_texts()]
    text = PILOT_TEXTS[Reason.ATTITUDE]
    assert told == [(MANY - 1, text), (3 * MANY - 1, text)]


def test_the_state_of_the_link_names_it_while_it_lasts() -> None:
    refusals = Refusals()
    refusals.add(Reason.BOOT_TIME, "steps", S)
    assert list(refusals.notes(S + EPISODE_NS - 1)) == ["telemetry refused, boot time: steps"]
    assert list(refusals.notes(S + EPISODE_NS)) == []


@pytest.mark.parametrize("text", PILOT_TEXTS.values())
def test_what_the_pilot_reads_fits_the_screen(text: str) -> None:
    assert len("Terrafix: " + text) <= 50
