"""False fixes, time to notice and recovery around a lie, on a flight with known errors."""

from dataclasses import replace
from pathlib import Path

import pytest

from accept_case import STEP_S, FrameCase, evidence
from terrafix_lab.accept.false_inputs import integrity as of
from terrafix_lab.accept.fly import Result
from terrafix_lab.accept.measuring.criteria import judge
from terrafix_lab.accept.measuring.results import Marks, Verdict
from terrafix_lab.accept.table import conclude
from terrafix_lab.faults.edits import Span

GOOD = FrameCase()
FALSE = FrameCase(error_m=80.0)
COVERED = FrameCase(error_m=80.0, sigma_m=60.0)  # wrong, with a consistent sigma
SLIGHTLY = FrameCase(error_m=30.0)
LIE = Span(5.0, 10.0, "lie")  # frames 10 to 20
MARKS = Marks(spans=(LIE,), lie=LIE)


def flight(tmp_path: Path, **changed: FrameCase):  # type: ignore[no-untyped-def]
    """60 good frames, except for those of keywords like f12 or f12_15 (both included)."""
    frames = [GOOD] * 60
    for name, case in changed.items():
        first, _, last = name[1:].partition("_")
        frames[int(first) : int(last or first) + 1] = [case] * (int(last or first) + 1 - int(first))
    return evidence(tmp_path, frames, MARKS)


def test_false_fixes_are_allowed_for_three_seconds_or_five_frames_of_a_false_input(tmp_path: Path) -> None:
    assert of.late_false_fixes(flight(tmp_path / "a", f10_16=FALSE)).value == 0.0  # frame 16 is 3 s into it
    assert of.late_false_fixes(flight(tmp_path / "b", f10_18=FALSE)).value == 2.0
    assert of.late_false_fixes(flight(tmp_path / "c", f10_30=COVERED)).value == 0.0
    row = judge("a", ("late false fixes",), flight(tmp_path / "d", f18=FALSE))[0]
    assert row.verdict is Verdict.BELOW and row.why == "of 1; 80 m at worst"


def test_five_frames_are_allowed_if_these_are_longer_than_three_seconds(tmp_path: Path) -> None:
    frames = [GOOD] * 10 + [FALSE] * 4 + [GOOD] * 10
    slow = evidence(tmp_path, frames, MARKS)
    for number, frame in enumerate(slow.frames):
        frame.row.t_s = 2.0 * number
    long = Span(20.0, 40.0, "lie")
    slow.marks = Marks(spans=(long,), lie=long)
    assert of.late_false_fixes(slow).value == 0.0  # the last of them is 6 s into it


def test_false_fixes_before_and_after_the_false_input_count_as_late(tmp_path: Path) -> None:
    found = flight(tmp_path, f3=FALSE, f10=FALSE, f22_23=FALSE)  # frame 10 is the first of the lie
    assert of.late_false_fixes(found).value == 3.0
    assert of.false_fixes_in_all(found) == of.Measured(4.0, "1 before the lie, 1 in it, 2 after it")


def test_the_allowance_does_not_depend_on_the_length_of_the_false_input(tmp_path: Path) -> None:
    found = flight(tmp_path, f10_13=FALSE, f30=FALSE)
    short = Span(10 * STEP_S, 10 * STEP_S, "reported once")
    found.marks = Marks(spans=(short,), lie=short)
    assert of.late_false_fixes(found).value == 1.0


def test_an_estimate_is_compared_with_the_truth_of_its_own_time(tmp_path: Path) -> None:
    """With a corrected time offset the time of an estimate is before the stamp of its frame."""
    late = flight(tmp_path, f2_57=FrameCase(late_s=0.7 * STEP_S))
    assert max(f.error_m for f in late.frames if f.error_m is not None) == pytest.approx(1.0, abs=0.1)
    assert late.metrics["within_5m"] == 1.0


def test_late_false_fixes_beyond_20_m_are_counted_separately(tmp_path: Path) -> None:
    found = flight(tmp_path, f30=SLIGHTLY)
    assert of.late_false_fixes(found).value == 0.0 and of.late_overconfident_over_20m(found).value == 1.0


def test_time_to_notice_ends_at_the_last_false_fix(tmp_path: Path) -> None:
    assert of.time_to_notice_s(flight(tmp_path / "a", f3=FALSE)).value == 0.0
    found = of.time_to_notice_s(flight(tmp_path / "b", f12=FALSE, f17=FALSE))
    assert found.value == pytest.approx(7 * STEP_S) and found.why == "8 frames"
    assert of.longest_false_run(flight(tmp_path / "c", f12=FALSE, f15_17=FALSE, f40_41=FALSE)).value == 3.0


def test_recovery_counts_frames_until_the_first_of_three_consecutive_correct_ones(tmp_path: Path) -> None:
    assert of.recovery_frames(flight(tmp_path / "a")).value == 1.0
    assert of.recovery_frames(flight(tmp_path / "b", f21_23=COVERED)).value == 4.0
    assert of.recovery_frames(flight(tmp_path / "c", f21_23=COVERED, f25=SLIGHTLY)).value == 6.0
    assert (
        of.recovery_frames(flight(tmp_path / "last", f21_56=COVERED)).value == 37.0
    )  # the last three frames are right
    never = of.recovery_frames(flight(tmp_path / "d", f21_59=SLIGHTLY))
    assert never.value is None and never.verdict is Verdict.BELOW
    assert judge("a", ("recovery",), flight(tmp_path / "e", f21_31=COVERED))[0].verdict is Verdict.BELOW
    ends = evidence(tmp_path / "f", [GOOD] * 20, MARKS)
    assert of.recovery_frames(ends).why == "the flight ends with the lie"


def test_after_a_gap_recovery_counts_from_its_end(tmp_path: Path) -> None:
    gap = evidence(tmp_path, [GOOD] * 21 + [COVERED] * 2 + [GOOD] * 9, Marks(spans=(LIE,)))
    assert of.recovery_frames(gap).value == 3.0


def test_errors_in_the_last_tenth_break_the_floor(tmp_path: Path) -> None:
    assert of.right_at_the_end(flight(tmp_path / "a", f20_53=COVERED)).value == 1.0
    found = flight(tmp_path / "b", f20_57=COVERED)
    assert of.right_at_the_end(found).value == pytest.approx(2 / 6)
    assert judge("a", ("right at the end",), found)[0].verdict is Verdict.BELOW
    lasting = evidence(tmp_path / "c", [GOOD] * 20, MARKS)
    assert of.right_at_the_end(lasting).value is None


def test_the_claim_width_uses_frames_with_true_inputs_only(tmp_path: Path) -> None:
    """An error of 5.887 m is the median of a circular normal error with 5 m on each axis."""
    found = flight(tmp_path / "a", f0_59=replace(GOOD, error_m=5.887), f10_20=replace(GOOD, sigma_m=500.0))
    assert of.claim_width(found).value == pytest.approx(1.0, rel=0.01)
    wide = flight(tmp_path / "b", f0_59=replace(GOOD, error_m=2.0))
    assert of.claim_width(wide).value == pytest.approx(5.0 * 1.1774 / 2.0, rel=0.01)


def test_a_median_claim_width_above_two_breaks_the_row_over_all_flights() -> None:
    def over(widths: list[float | None]) -> tuple[float | None, Verdict]:
        results = [Result(scenario=f"s{i}", promise="", rows=[], claim_width=w) for i, w in enumerate(widths)]
        rows = conclude(results, flight="", map_path="", quick=False, seed=1, whole=False).rows
        row = next(r for r in rows if r.what.startswith("claimed 1-sigma"))
        return row.measured, row.verdict

    assert over([1.0, 1.5, None, 1.8, 2.5, 9.0]) == (1.8, Verdict.PASS)
    assert over([1.0, 2.2, 2.4, 2.5, 9.0]) == (2.4, Verdict.BELOW)
    assert over([3.0] * 4) == (None, Verdict.NOT_MEASURABLE)
