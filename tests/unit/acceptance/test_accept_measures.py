"""The numbers of the acceptance table, on a flight with known errors."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from accept_case import STEP_S, FrameCase, evidence, file_of
from terrafix.core.pose import exp_so3
from terrafix.link.ground_station import prior_request
from terrafix.link.ground_station.prior_request import PriorRequest
from terrafix.messages import CovarianceMode, Odometry, SourceLabel
from terrafix.messages import Verdict as Answer
from terrafix_lab.accept.measuring import measures as of
from terrafix_lab.accept.measuring.criteria import CRITERIA, judge
from terrafix_lab.accept.measuring.results import Bounds, JudgedRow, Marks, Verdict, with_unit
from terrafix_lab.faults.edits import Span

GOOD = FrameCase()
LOST = FrameCase(
    error_m=300.0, sigma_m=200.0, label=SourceLabel.DEAD_RECKONED, fixed=False, odometry=Answer.FEW_INLIERS
)
ODOMETRY = FrameCase(error_m=8.0, label=SourceLabel.VISUAL_PROPAGATED, fixed=False)


def test_a_good_flight_holds_every_floor(tmp_path: Path) -> None:
    found = evidence(tmp_path, [GOOD] * 20, start_up_s=2.0)
    names = (
        "within 50 m",
        "within 20 m",
        "not localised",
        "both estimates",
        "odometry",
        "claims",
        "memory",
    )
    assert {row.verdict for row in judge("a", names, found)} == {Verdict.PASS}
    assert of.first_position_s(found).value == pytest.approx(2.0)


def test_shares_are_of_all_frames(tmp_path: Path) -> None:
    found = evidence(tmp_path, [GOOD] * 6 + [replace(GOOD, error_m=30.0)] * 2 + [LOST] * 2)
    assert of.within_50m(found).value == pytest.approx(0.8)
    assert of.within_20m(found).value == pytest.approx(0.6)
    assert of.not_localised(found).value == pytest.approx(0.2)  # dead reckoning only counts as not localised
    rows = judge("a", ("within 50 m", "not localised"), found)
    assert [row.verdict for row in rows] == [Verdict.PASS, Verdict.BELOW]
    assert rows[0].goal_met is False


def test_a_false_fix_breaks_a_floor(tmp_path: Path) -> None:
    found = evidence(tmp_path, [GOOD] * 9 + [replace(GOOD, error_m=120.0)])
    row = judge("a", ("false fixes",), found)[0]
    assert row.measured == 1.0 and row.verdict is Verdict.BELOW


def test_an_accepted_wrong_fix_breaks_the_floor(tmp_path: Path) -> None:
    marks = Marks(wrong_files=frozenset({file_of(3), file_of(7)}))
    frames = [GOOD] * 10
    frames[3] = replace(GOOD, fixed=False)
    frames[8] = replace(GOOD, error_m=77.0)
    found = evidence(tmp_path, frames, marks)
    assert of.wrong_rejected(found).value == pytest.approx(0.5)
    assert of.error_after_wrong(found).value == pytest.approx(77.0, abs=0.1)


GAPS = Marks(breaks_s=(2.0, 4.0))  # frames 0-3, 4-7, 8-11


def numbered(frames: list[FrameCase], fragments: list[int]) -> list[FrameCase]:
    """``fragments``: fragment id of the odometry of each frame."""
    return [replace(frame, fragment_id=fragment) for frame, fragment in zip(frames, fragments, strict=True)]


def test_fragments_are_judged_separately(tmp_path: Path) -> None:
    frames = [GOOD] * 4 + [replace(GOOD, fixed=False, error_m=90.0)] * 4 + [GOOD] * 3 + [LOST]
    found = evidence(tmp_path, numbered(frames, [0] * 4 + [1] * 4 + [2] * 4), GAPS)
    assert of.fragments_localised(found).value == pytest.approx(2 / 3)
    assert of.worst_fragment(found).value == 0.0


def test_a_gap_that_odometry_bridges_counts_as_a_fragment_that_does_not_survive(tmp_path: Path) -> None:
    begun = evidence(tmp_path / "begun", numbered([GOOD] * 12, [0] * 4 + [1] * 4 + [2] * 4), GAPS)
    assert judge("a", ("fragments",), begun)[0].verdict is Verdict.PASS
    bridged = evidence(tmp_path / "bridged", numbered([GOOD] * 12, [0] * 8 + [1] * 4), GAPS)
    row = judge("a", ("fragments",), bridged)[0]
    assert (row.measured, row.verdict) == (pytest.approx(2 / 3), Verdict.BELOW)
    assert row.why.startswith("2 of 3; 1 begun after 2 gaps")


def test_each_fragment_with_a_map_fix_is_refined_in_flight_within_five_seconds_of_it(tmp_path: Path) -> None:
    unfixed, refined = replace(GOOD, fixed=False), replace(GOOD, refined_after_s=1.0)
    late = [refined] * 4 + [unfixed] * 2 + [GOOD] + [replace(GOOD, refined_after_s=4.0)]  # fix at 3 s, refined at 7.5 s
    found = evidence(tmp_path / "late", numbered(late, [0] * 4 + [1] * 4))
    assert of.fragments_merged_after_s(found).value == pytest.approx(4.5)
    assert judge("a", ("fragments merged",), found)[0].verdict is Verdict.PASS
    later = evidence(tmp_path / "later", numbered([*late[:7], replace(GOOD, refined_after_s=5.0)], [0] * 4 + [1] * 4))
    assert judge("a", ("fragments merged",), later)[0].verdict is Verdict.BELOW
    never = evidence(tmp_path / "never", numbered([refined] * 4 + [GOOD] * 4, [0] * 4 + [1] * 4))
    row = judge("a", ("fragments merged",), never)[0]
    assert row.verdict is Verdict.BELOW and row.why == "fragment 1 has a map fix and was not refined in flight"
    unanchored = evidence(tmp_path / "none", numbered([refined] * 4 + [unfixed] * 4, [0] * 4 + [1] * 4))
    assert of.fragments_merged_after_s(unanchored).value == pytest.approx(1.0)


def test_a_fragment_counts_where_odometry_begins_it_and_not_where_the_scenario_has_its_gap(tmp_path: Path) -> None:
    gap = Marks(breaks_s=(2.0,))
    elsewhere = evidence(tmp_path / "a", numbered([GOOD] * 14, [0] * 11 + [1] * 3), gap)  # at 5.5 s
    assert of.fragments_localised(elsewhere).value == pytest.approx(2 / 3)
    # Without a mark: two fragments, of which the second one has no map fix.
    unfixed = [GOOD] * 6 + [replace(GOOD, fixed=False)] * 4
    unmarked = evidence(tmp_path / "b", numbered(unfixed, [0] * 6 + [1] * 4))
    assert of.fragments_localised(unmarked).value == pytest.approx(1 / 2)


def test_a_fragment_begins_with_the_first_frame_of_its_number_after_frames_of_none(tmp_path: Path) -> None:
    failed = replace(GOOD, odometry=Answer.FEW_INLIERS)
    frames = [GOOD] * 4 + [failed] + [GOOD] * 7
    found = evidence(tmp_path, numbered(frames, [0] * 4 + [-1] + [1] * 7), Marks(breaks_s=(2.0,)))
    assert of.fragments_localised(found).why.startswith("2 of 2; 1 begun after 1 gaps")


def test_a_fragment_that_goes_on_after_another_one_is_the_same_fragment(tmp_path: Path) -> None:
    found = evidence(tmp_path, numbered([GOOD] * 12, [0] * 4 + [1] * 4 + [0] * 4))
    assert of.fragments_localised(found).why.startswith("2 of 2;")


def test_a_fragment_is_counted_by_its_number_also_where_frames_refer_to_one_keyframe(tmp_path: Path) -> None:
    frames = [replace(frame, keyframe_id=0) for frame in numbered([GOOD] * 12, [0] * 6 + [1] * 6)]
    assert of.fragments_localised(evidence(tmp_path, frames)).why.startswith("2 of 2;")


def test_a_fragment_of_one_frame_is_none(tmp_path: Path) -> None:
    found = evidence(tmp_path, numbered([GOOD] * 9, [0] * 4 + [1] + [0] * 4))
    assert of.fragments_localised(found).why.startswith("1 of 1;")


def test_frames_before_the_first_fragment_belong_to_it(tmp_path: Path) -> None:
    found = evidence(tmp_path, numbered([GOOD] * 8, [-1] * 2 + [0] * 6))
    assert of.fragments_localised(found).why.startswith("1 of 1;")


def test_a_single_frame_without_odometry_is_no_fragment(tmp_path: Path) -> None:
    foreign = replace(GOOD, odometry=Answer.FEW_INLIERS, fixed=False)
    found = evidence(tmp_path, numbered([GOOD] * 4 + [foreign] + [GOOD] * 4, [0] * 4 + [-1] + [0] * 4))
    assert of.fragments_localised(found).why.startswith("1 of 1")


def test_the_delay_of_the_label_change_over_unmatchable_ground(tmp_path: Path) -> None:
    marks = Marks(spans=(Span(5.0, 9.0, "blind"),))
    frames = [GOOD] * 13 + [ODOMETRY] * 6 + [GOOD] * 11  # the label changes at 6.5 s
    assert of.label_change_s(evidence(tmp_path / "a", frames, marks)).value == pytest.approx(1.5)
    never = of.label_change_s(evidence(tmp_path / "b", [GOOD] * 30, marks))
    assert never.value == pytest.approx(4.0) and never.why == "the label never changes"
    at_once = evidence(tmp_path / "c", [GOOD] * 10 + [ODOMETRY] * 20, marks)
    assert of.label_change_s(at_once).value == 0.0


def test_relocalization_requires_five_consecutive_frames(tmp_path: Path) -> None:
    marks = Marks(spans=(Span(1.0, 3.0, "blind"),))
    frames = [GOOD] * 2 + [LOST] * 6 + [GOOD] + [LOST] * 3 + [GOOD] * 8  # one good frame at 4 s, all from 6 s on
    assert of.relocalized_after_s(evidence(tmp_path, frames, marks)).value == pytest.approx(3.0)


@pytest.mark.parametrize(("seconds_after", "verdict"), [(29, None), (31, Verdict.BELOW)])
def test_a_flight_that_ends_before_the_floor_of_the_relocalization_decides_nothing(
    tmp_path: Path, seconds_after: int, verdict: Verdict | None
) -> None:
    frames = [GOOD] * 2 + [LOST] * (2 * seconds_after + 5)  # two a second, the last one so long after the span
    found = of.relocalized_after_s(evidence(tmp_path, frames, Marks(spans=(Span(1.0, 3.0, "blind"),))))
    assert found.value is None and found.verdict is verdict


def test_frames_in_a_marked_span_do_not_count_as_outside(tmp_path: Path) -> None:
    marks = Marks(spans=(Span(5.0, 9.0, "blind"),))
    frames = [GOOD] * 10 + [LOST] * 28 + [GOOD] * 12  # lost until 19 s: 10 s after the end
    assert of.within_50m_outside(evidence(tmp_path, frames, marks)).value == pytest.approx(1.0)


def test_drift_is_the_error_of_the_motion_between_fixes(tmp_path: Path) -> None:
    """Between the fixes at frames 2 and 7 the prediction gains 12 m to the east; the first fix has an error of 2 m."""
    frames = [GOOD] * 2 + [replace(GOOD, error_m=2.0)] + [ODOMETRY] * 4 + [replace(GOOD, predicted_error_m=14.0)]
    found = evidence(tmp_path, frames)
    assert of.drift(found).value == pytest.approx(12.0, abs=0.05)
    assert of.drift_share(found).value is None  # a path of 50 m is too short
    long = evidence(tmp_path / "long", [*frames[:3], *[ODOMETRY] * 19, frames[-1]])
    assert of.drift_share(long).value == pytest.approx(12.0 / 200.0, rel=0.01)


def test_drift_needs_odometry_in_all_frames(tmp_path: Path) -> None:
    frames = [GOOD, replace(ODOMETRY, odometry=Answer.FEW_INLIERS), replace(GOOD, predicted_error_m=500.0)]
    assert (of.drift(evidence(tmp_path, frames)).value or 0.0) < 5.0


def test_the_covariance_mode_follows_throttling(tmp_path: Path) -> None:
    found = evidence(tmp_path, [GOOD] * 4 + [replace(GOOD, mode=CovarianceMode.JACOBIAN)] * 2)
    assert of.right_mode(found).value == pytest.approx(4 / 6)  # no throttling was reported


def test_an_invalid_covariance_breaks_the_floor(tmp_path: Path) -> None:
    found = evidence(tmp_path, [GOOD] * 3)
    broken = [-1.0] + [0.0] * 35
    estimates = found.frames[1].estimates
    estimates[0] = msgspec.structs.replace(estimates[0], cov=tuple(broken))
    assert of.complete_estimates(found).value == pytest.approx(2 / 3)


def test_the_truth_is_shifted_by_the_drawn_map_error(tmp_path: Path) -> None:
    found = evidence(tmp_path, [replace(GOOD, error_m=0.0)] * 5, truth_offset_m=(3.0, 4.0))
    errors = [f.error_m for f in found.frames]
    assert errors == pytest.approx([5.0] * 5, abs=0.02)


@pytest.mark.parametrize("relief", [0.0, 0.02])
def test_the_reprojection_error_of_odometry_is_that_of_the_noise(tmp_path: Path, relief: float) -> None:
    """Noise of 0.8 px in both pictures: the mean length of a plane normal error is 0.8 sqrt(pi/2), whether the points
    lie on a plane or are up to 2 % of the height above it, as much as odometry
    lets in; a little less after a fit of 8 unknowns to 2 x 48 numbers."""
    found = evidence(tmp_path, [GOOD] * 30)
    rng = np.random.default_rng(5)
    turn, way = exp_so3(np.array([0.02, -0.03, 0.3])), np.array([0.25, 0.1, 0.05])
    for frame in found.frames:
        a = rng.uniform(-0.8, 0.8, (48, 2))
        q = (np.column_stack([a, np.ones(48)]) * (1.0 - relief * rng.uniform(0.0, 1.0, (48, 1))) - way) @ turn
        seen = np.hstack([a, q[:, :2] / q[:, 2:]]) + rng.normal(0.0, 0.8 / 500.0, (48, 4))
        pairs = [(float(w), float(x), float(y), float(z)) for w, x, y, z in seen]
        frame.odometry = Odometry(t_ns=0, frame_id=0, keyframe_id=0, verdict=Answer.ACCEPTED, two_view=pairs)
    expected = 0.8 * np.sqrt(np.pi / 2) * np.sqrt(1 - 8 / 96)
    assert of.odometry_px(found).value == pytest.approx(expected, rel=0.08)


def test_the_reprojection_error_of_a_hovering_camera_is_finite(tmp_path: Path) -> None:
    found = evidence(tmp_path, [GOOD] * 3)
    still = [(x, y, x, y) for x in (-0.5, 0.0, 0.5) for y in (-0.3, 0.0, 0.3)]
    for frame in found.frames:
        frame.odometry = Odometry(t_ns=0, frame_id=0, keyframe_id=0, verdict=Answer.ACCEPTED, two_view=still)
    assert of.odometry_px(found).value == pytest.approx(0.0, abs=1e-6)


def test_a_lost_flight_must_request_a_position(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lost = [FrameCase(fixed=False, sigma_m=800.0)] * 20
    delay = of.prior_request_delay_s(evidence(tmp_path / "a", [*[FrameCase()] * 4, *lost]))
    assert delay.value == pytest.approx(0.0, abs=0.5)  # up to one frame
    assert delay.why == "asked 4 s into the flight"  # lost from frame 4, at 2 s; 3 frames and 2 s later
    for short in ([FrameCase()] * 10, [*[FrameCase()] * 4, *lost[:4], *[FrameCase()] * 4]):
        found = of.prior_request_delay_s(evidence(tmp_path / f"b{len(short)}", short))
        assert (found.value, found.verdict) == (None, None) and "never lost" in found.why
    monkeypatch.setattr(PriorRequest, "due", lambda *_: "")
    assert of.prior_request_delay_s(evidence(tmp_path / "c", lost)).verdict is Verdict.BELOW


def test_a_request_for_a_position_where_nothing_was_lost_breaks_the_floor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flights = {"known": [FrameCase()] * 10, "lost later": [FrameCase()] * 10 + [FrameCase(sigma_m=800.0)] * 10}
    monkeypatch.setattr(PriorRequest, "due", lambda *_: "send a hint")
    for name, frames in flights.items():
        row = judge("a", ("asks",), evidence(tmp_path / name, frames))[0]
        assert row.verdict is Verdict.BELOW and "requests without need, the first 0 s into the flight" in row.why


def without_fix(from_frame: int, frames: int) -> list[FrameCase]:
    """Two frames a second at 20 m/s, accurate, whose map fixes end at ``from_frame``."""
    step_ms = round(1000 * STEP_S)
    return [FrameCase(fixed=i <= from_frame, anchor_age_ms=step_ms * max(i - from_frame, 0)) for i in range(frames)]


@pytest.mark.parametrize(("from_frame", "needed_s"), [(20, 15.0), (400, 250.0), (1000, 600.0)])
def test_a_request_is_needed_after_a_fifth_of_the_route_and_5_s_without_a_map_fix(
    tmp_path: Path, from_frame: int, needed_s: float
) -> None:
    found = evidence(tmp_path, without_fix(from_frame, 1250))
    estimates = [estimate for frame in found.frames for estimate in frame.estimates]
    assert of.request_is_needed(estimates).index(True) * STEP_S == needed_s  # 2 km at the latest: 100 s at 20 m/s
    row = judge("a", ("asks",), found)[0]
    assert (row.measured, row.verdict) == (0.0, Verdict.PASS)


def test_a_request_before_a_fifth_of_the_route_without_a_map_fix_breaks_the_floor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(prior_request, "UNANCHORED_SHARE", 0.15)
    row = judge("a", ("asks",), evidence(tmp_path, without_fix(400, 600)))[0]
    assert row.verdict is Verdict.BELOW and "requests without need" in row.why


def test_a_request_that_does_not_come_after_a_fifth_of_the_route_without_a_map_fix_breaks_the_floor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(prior_request, "UNANCHORED_SHARE", 0.3)
    assert judge("a", ("asks",), evidence(tmp_path / "late", without_fix(400, 600)))[0].verdict is Verdict.BELOW
    monkeypatch.setattr(prior_request, "UNANCHORED_SHARE", 1.1)
    monkeypatch.setattr(prior_request, "MAX_UNANCHORED_M", 1e6)
    assert judge("a", ("asks",), evidence(tmp_path / "never", without_fix(20, 120)))[0].verdict is Verdict.BELOW


def test_bounds_and_their_texts() -> None:
    assert Bounds(0.93, 0.98).holds(0.93) and not Bounds(0.93, 0.98).holds(0.985)
    assert Bounds(low=0.8).text("%") == ">= 80 %" and Bounds(high=50.0).text("m") == "<= 50 m"
    assert Bounds(0.93, 0.98).text("%") == "93 to 98 %"
    assert with_unit(0.9549, "%") == "95.5 %" and with_unit(None, "m") == "-" and with_unit(0.0, "") == "0"


def coverage_row(tmp_path: Path, frames: list[FrameCase]) -> JudgedRow:
    return judge("a", ("coverage",), evidence(tmp_path, frames))[0]


def test_one_flight_that_is_inside_the_95_percent_ellipse_altogether_is_not_decidable(tmp_path: Path) -> None:
    row = coverage_row(tmp_path, [replace(GOOD, error_m=4.0)] * 20)
    assert (row.measured, row.verdict, row.floor) == (1.0, Verdict.NOT_MEASURABLE, "93 to 98 %")
    assert "not decidable in one flight" in row.why


def test_one_flight_within_the_band_of_coverage_passes(tmp_path: Path) -> None:
    frames = [replace(GOOD, error_m=4.0)] * 19 + [replace(GOOD, error_m=13.0)]
    assert coverage_row(tmp_path, frames).verdict is Verdict.PASS


def test_one_flight_with_less_coverage_breaks_the_floor(tmp_path: Path) -> None:
    row = coverage_row(tmp_path, [replace(GOOD, error_m=4.0)] * 18 + [replace(GOOD, error_m=13.0)] * 2)
    assert row.verdict is Verdict.BELOW and row.why.endswith("too narrow")


def test_one_flight_with_claims_that_one_consistent_flight_in_a_thousand_has_breaks_the_floor(tmp_path: Path) -> None:
    row = coverage_row(tmp_path, [replace(GOOD, error_m=0.2)] * 20)  # of 5 m; the limit is 0.22 m
    assert row.verdict is Verdict.BELOW and row.why.endswith("too wide")


def test_every_row_has_a_requirement_number() -> None:
    known = {f"AC-{i}" for i in range(1, 18)} | {"ON-2", "ON-6"}
    assert {criterion.ac for criterion in CRITERIA.values()} <= known
