"""Rejected telemetry: verdicts, texts to the pilot, notes in LinkStatus."""

import pytest

from link_rig import MS, S
from terrafix import messages as m
from terrafix.link.admission.refusals import (
    EPISODE_TIMEOUT_NS,
    MIN_PILOT_TEXT_MESSAGES,
    PILOT_TEXTS,
    RejectionLog,
    RejectionReason,
)


def test_each_rejection_reason_is_recorded_immediately_then_once_a_second_with_a_count() -> None:
    rejections, details = RejectionLog(), []
    for i in range(100):
        rejections.add(RejectionReason.ATTITUDE, f"number {i}", S + i * 20 * MS)
        if i == 50:
            rejections.add(RejectionReason.BOOT_TIME, "x", S + i * 20 * MS)
        details += [(i, v.detail) for v in rejections.verdicts(S + i * 20 * MS)]
    assert details == [(0, "attitude: number 0"), (50, "attitude: number 50 (50 messages)"), (50, "boot time: x")]
    assert next(iter(rejections.verdicts(4 * S))).detail == "attitude: number 99 (49 messages)"
    assert list(rejections.verdicts(9 * S)) == []


def test_a_rejection_verdict_has_measurement_telemetry_and_no_frame() -> None:
    rejections = RejectionLog()
    rejections.add(RejectionReason.SEQUENCE, "x", S)
    (verdict,) = rejections.verdicts(S)
    assert (verdict.t_ns, verdict.frame_id, verdict.measurement) == (S, -1, "telemetry")
    assert verdict.verdict is m.Verdict.IMPLAUSIBLE


def test_the_pilot_gets_one_text_per_episode_of_many_rejections() -> None:
    rejections = RejectionLog()
    texts = []
    for i in range(3 * MIN_PILOT_TEXT_MESSAGES):
        at_ns = S + i * MS + (EPISODE_TIMEOUT_NS if i >= 2 * MIN_PILOT_TEXT_MESSAGES else 0)
        rejections.add(RejectionReason.ATTITUDE, "x", at_ns)
        texts += [(i, text) for text in rejections.pilot_texts()]
    text = PILOT_TEXTS[RejectionReason.ATTITUDE]
    assert texts == [(MIN_PILOT_TEXT_MESSAGES - 1, text), (3 * MIN_PILOT_TEXT_MESSAGES - 1, text)]


def test_link_status_names_a_rejection_until_its_episode_ends() -> None:
    rejections = RejectionLog()
    rejections.add(RejectionReason.BOOT_TIME, "steps", S)
    assert list(rejections.notes(S + EPISODE_TIMEOUT_NS - 1)) == ["telemetry refused, boot time: steps"]
    assert list(rejections.notes(S + EPISODE_TIMEOUT_NS)) == []


@pytest.mark.parametrize("text", PILOT_TEXTS.values())
def test_rejection_texts_fit_into_statustext(text: str) -> None:
    assert len("Terrafix: " + text) <= 50
