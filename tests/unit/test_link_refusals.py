"""What is recorded of telemetry that was refused."""

from link_rig import MS, S

from terrafix import messages as m
from terrafix.link.refusals import Refusals


def test_each_reason_is_said_at_once_and_then_once_a_second_with_its_count() -> None:
    refusals = Refusals()
    said = []
    for i in range(100):
        refusals.add("one", f"number {i}")
        if i == 50:
            refusals.add("another", "x")
        said += [(i, v.detail) for v in refusals.verdicts(S + i * 20 * MS)]
    assert said == [(0, "one: number 0"), (50, "one: number 50 (50 messages)"), (50, "another: x")]
    assert next(iter(refusals.verdicts(4 * S))).detail == "one: number 99 (49 messages)"
    assert list(refusals.verdicts(9 * S)) == []


def test_the_verdict_is_of_telemetry_and_of_no_frame() -> None:
    refusals = Refusals()
    refusals.add("one", "x")
    (verdict,) = refusals.verdicts(S)
    assert (verdict.t_ns, verdict.frame_id, verdict.measurement) == (S, -1, "telemetry")
    assert verdict.verdict is m.Verdict.IMPLAUSIBLE
