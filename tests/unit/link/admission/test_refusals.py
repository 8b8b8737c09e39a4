"""Rejected telemetry: verdicts, faults by their cause, notes in LinkStatus."""

from link_rig import MS, S
from terrafix import messages as m
from terrafix.link.admission.refusals import (
    EPISODE_TIMEOUT_NS,
    MIN_FAULT_MESSAGES,
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


def test_an_episode_of_many_rejections_is_one_fault_from_the_first_to_the_last_of_them() -> None:
    rejections = RejectionLog()
    faults = []
    for i in range(30):  # the last ten begin another episode
        at_ns = S + i * MS + (2 * EPISODE_TIMEOUT_NS if i >= 20 else 0)
        faults += rejections.faults(at_ns)
        rejections.add(RejectionReason.SEQUENCE, "x", at_ns)
        faults += rejections.faults(at_ns)
    last_ns = S + 19 * MS
    assert [(f.quantity, f.t_ns, f.active) for f in faults] == [
        ("telemetry of two senders", t_ns, active)
        for t_ns, active in ((S, True), (last_ns, False), (S + 20 * MS + 2 * EPISODE_TIMEOUT_NS, True))
    ]


def test_a_few_rejections_are_no_fault_and_a_second_sender_is_named_elsewhere() -> None:
    rejections = RejectionLog()
    for i in range(2 * MIN_FAULT_MESSAGES):
        rejections.add(RejectionReason.SENDER, "x", S)
        if i < MIN_FAULT_MESSAGES - 1:
            rejections.add(RejectionReason.SEQUENCE, "x", S)
    assert list(rejections.faults(S)) == []


def test_link_status_names_a_rejection_until_its_episode_ends() -> None:
    rejections = RejectionLog()
    rejections.add(RejectionReason.BOOT_TIME, "steps", S)
    assert list(rejections.notes(S + EPISODE_TIMEOUT_NS - 1)) == ["telemetry refused, boot time: steps"]
    assert list(rejections.notes(S + EPISODE_TIMEOUT_NS)) == []
