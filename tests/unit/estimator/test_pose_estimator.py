"""PoseEstimator (ON-1, RS-1): 2D-3D matches become a pose and a factor of the flight's graph; modes and failures."""

import dataclasses
import itertools
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

from map_matches import pose_of, with_pose, with_search
from simulated_flight import CAMERA, ORIGIN, PLACE, EstimatorRun, Flight, cov_of, error_m, t_ns
from smoother_marginals import recorded_marginals
from terrafix.core.camera import CameraCalibration
from terrafix.core.geodesy import quat_from_rot, rot_from_quat
from terrafix.core.pnp import INLIER_THRESHOLD, PLANAR_RELIEF, PNP_MIN_INLIERS, SEARCH_RADIUS, solved
from terrafix.core.pose import exp_so3
from terrafix.estimator import (
    CovarianceDegradedWarning,
    CovarianceMode,
    MatchResult,
    OpenCVGtsamPoseEstimator,
    PnpFailureError,
    PoseEstimate,
    PoseEstimator,
    ThermalState,
)
from terrafix.messages import (
    MapMatch,
    MeasurementVerdict,
    NavEstimate,
    PnpInput,
    PoseAnchor,
    PoseLink,
    PoseMethod,
    PoseSolution,
    SourceLabel,
    ThermalBand,
    Verdict,
)

LENS = CameraCalibration.of(CAMERA)
AT = 20
GRID_M = np.array(list(itertools.product((-40.0, 0.0, 40.0), (-20.0, 0.0, 20.0), (0.0,))))
PIXEL = 1.0 / CAMERA.fx


def thermal(band: ThermalBand) -> ThermalState:
    return ThermalState(t_ns=0, band=band, temperature_c=60.0, throttled=False, disk_free_mb=1000, cause="test")


COOL, HOT = thermal(ThermalBand.NORMAL), thermal(ThermalBand.HOT)


def relief(points: np.ndarray, relief_m: float) -> np.ndarray:
    """Points (N, 3) with heights spread evenly over ``relief_m``, in an order that fits no plane."""
    heights = np.random.default_rng(1).permutation(np.linspace(0.0, relief_m, len(points)))
    return np.column_stack([points[:, :2], heights])


def seen(flight: Flight, i: int, points: np.ndarray) -> np.ndarray:
    """(N, 6) 2D-3D matches of ground points (N, 3) [m] in frame i, without errors."""
    q = (points - flight.p_m[i]) @ flight.r_w_c[i]
    return np.column_stack([q[:, :2] / q[:, 2:], points, np.ones(len(points))])


def below(flight: Flight, i: int, points: np.ndarray = GRID_M) -> np.ndarray:
    """Points (N, 3) around the ground below the camera of frame i."""
    return flight.p_m[i] * (1.0, 1.0, 0.0) + points


def match_of(flight: Flight, i: int = AT, matches: np.ndarray | None = None, **pnp: Any) -> MatchResult:
    """As the anchor publishes it: 2D-3D matches, those of nine points of flat ground by default, with the input of PnP,
    whose fields ``pnp`` changes."""
    given = PnpInput(
        q_w_c=quat_from_rot(flight.r_w_c[i]),
        agl_m=float(flight.p_m[i, 2]),
        sigma_floor=PIXEL,
        threshold=INLIER_THRESHOLD,
        search_radius=SEARCH_RADIUS,
        min_inliers=PNP_MIN_INLIERS,
    )
    rows = (seen(flight, i, below(flight, i)) if matches is None else matches).tolist()
    return msgspec.structs.replace(
        flight.fix(i), pose=None, pnp=msgspec.structs.replace(given, **pnp), matches=[tuple(row) for row in rows]
    )


def poses_of(run: EstimatorRun) -> PoseEstimator:
    estimator = run.node.pose_estimator
    assert estimator is not None
    return estimator


def solution_of(estimate: PoseEstimate | PnpFailureError) -> PoseSolution:
    return estimate.outcome.solution


def off_m(solution: PoseSolution, flight: Flight, i: int = AT) -> float:
    """Distance of the pose that was computed from the true one, before fusion."""
    assert solution.pose is not None
    return float(np.linalg.norm(np.array(solution.pose.p_c_in_w_m) - flight.p_m[i]))


def horizontal_off_m(pose: PoseEstimate, flight: Flight, i: int) -> float:
    """Horizontal distance of an estimate from the true position of frame i."""
    return float(np.hypot(*(np.array(PLACE.to_local(*pose.position_wgs84[:2])) - flight.p_m[i, :2])))


@pytest.fixture
def flight() -> Flight:
    return Flight(AT + 3, seed=2, fix_every=1000)


@pytest.fixture
def run(flight: Flight) -> EstimatorRun:
    return EstimatorRun().fly(flight, 0, AT + 1)


# --- a match becomes a pose ---------------------------------------------------------------------------------------


def test_nine_perfect_matches_without_a_pose_give_the_pose_of_their_frame(flight: Flight, run: EstimatorRun) -> None:
    before_m = np.linalg.norm(error_m(run.estimate(AT), flight)[:2])
    pose = poses_of(run).estimate(match_of(flight), LENS, COOL)
    solution = solution_of(pose)
    assert (solution.verdict, solution.method, solution.inliers) == (Verdict.ACCEPTED, PoseMethod.IPPE, 9)
    assert off_m(solution, flight) < 1e-3
    assert solution.residual_px == pytest.approx(0.0, abs=1e-3)
    assert (pose.frame_id, pose.source_label) == (AT, SourceLabel.SATELLITE_ANCHORED)
    assert horizontal_off_m(pose, flight, AT) < 0.5 * before_m


def test_matches_alone_are_solved_about_the_prediction_of_the_graph(flight: Flight, run: EstimatorRun) -> None:
    """A caller that has matches, and neither a pose nor the input of PnP."""
    match = msgspec.structs.replace(match_of(flight), pnp=None)
    solution = solution_of(poses_of(run).estimate(match, LENS, COOL))
    assert (solution.method, solution.inliers) == (PoseMethod.IPPE, 9)
    assert off_m(solution, flight) < 1e-3
    hills = relief(below(flight, AT), 12.0)
    over_hills = msgspec.structs.replace(match_of(flight, matches=seen(flight, AT, hills)), pnp=None)
    rough = solution_of(poses_of(run).estimate(over_hills, LENS, COOL))
    assert (rough.method, rough.inliers) == (PoseMethod.SQPNP, 9)
    outlier = np.array(match.matches)
    outlier[0, :2] += 0.5 * INLIER_THRESHOLD
    noisy = msgspec.structs.replace(match, matches=[tuple(row) for row in outlier.tolist()])
    assert solution_of(poses_of(run).estimate(noisy, LENS, COOL)).inliers == 9
    outlier[0, :2] += INLIER_THRESHOLD
    wrong = msgspec.structs.replace(match, matches=[tuple(row) for row in outlier.tolist()])
    assert solution_of(poses_of(run).estimate(wrong, LENS, COOL)).inliers == 8


def test_the_residual_is_that_of_the_inliers_in_pixels_of_the_frame(flight: Flight, run: EstimatorRun) -> None:
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-60.0, 60.0, 40), rng.uniform(-30.0, 30.0, 40), np.zeros(40)])
    matches = seen(flight, AT, below(flight, AT, points))
    matches[:, :2] += rng.normal(0.0, 2.0 * PIXEL, (40, 2))
    solution = solution_of(poses_of(run).estimate(match_of(flight, matches=matches), LENS, COOL))
    # sqrt(2) times 2 px in two coordinates, less the six degrees of freedom of the pose among eighty numbers
    assert solution.residual_px == pytest.approx(2.0 * np.sqrt(2.0 * 74 / 80), rel=0.15)
    assert solution.inliers == 40


def test_wrong_matches_are_left_out(flight: Flight, run: EstimatorRun) -> None:
    rng = np.random.default_rng(7)
    points = np.column_stack([rng.uniform(-60.0, 60.0, 40), rng.uniform(-30.0, 30.0, 40), np.zeros(40)])
    matches = seen(flight, AT, below(flight, AT, points))
    matches[:, :2] += rng.normal(0.0, PIXEL, (40, 2))
    matches[:12, 2:4] += 7.0 * rng.choice([-1.0, 1.0], (12, 2))
    solution = solution_of(poses_of(run).estimate(match_of(flight, matches=matches), LENS, COOL))
    assert (solution.verdict, solution.inliers) == (Verdict.ACCEPTED, 28)
    assert off_m(solution, flight) < 1.5


@pytest.mark.parametrize(
    ("relief_share", "method", "flag"),
    [
        (0.0, PoseMethod.IPPE, cv2.SOLVEPNP_IPPE),
        (0.9 * PLANAR_RELIEF, PoseMethod.IPPE, cv2.SOLVEPNP_IPPE),
        (1.1 * PLANAR_RELIEF, PoseMethod.SQPNP, cv2.SOLVEPNP_SQPNP),
        (0.2, PoseMethod.SQPNP, cv2.SOLVEPNP_SQPNP),
    ],
)
def test_the_relief_of_the_matched_points_decides_the_method_and_their_heights_count(
    relief_share: float,
    method: PoseMethod,
    flag: int,
    flight: Flight,
    run: EstimatorRun,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flags, ransac = [], cv2.solvePnPRansac

    def recorded(*args: Any, **options: Any) -> Any:
        flags.append(options["flags"])
        return ransac(*args, **options)

    monkeypatch.setattr(cv2, "solvePnPRansac", recorded)
    hills = relief(below(flight, AT), relief_share * float(flight.p_m[AT, 2]))
    solution = solution_of(poses_of(run).estimate(match_of(flight, matches=seen(flight, AT, hills)), LENS, COOL))
    assert (solution.method, flags, solution.inliers) == (method, [flag], 9)
    assert off_m(solution, flight) < 1e-3  # as a plane, relief of 2 % of the height moves it by decimetres


def test_a_pose_that_the_matcher_has_computed_is_fused_as_it_is(flight: Flight, run: EstimatorRun) -> None:
    """The consensus of all patches, a search, or a mode of the posterior: there is nothing to solve."""
    given = msgspec.structs.replace(flight.fix(AT), matches=match_of(flight).matches)
    assert solved(given) is given
    solution = solution_of(poses_of(run).estimate(given, LENS, COOL))
    assert (solution.method, solution.pose, solution.inliers) == (PoseMethod.MATCHER, given.pose, 30)
    assert solution.residual_px is not None and solution.residual_px > 5.0  # of the true points from a pose with errors
    without = solution_of(poses_of(run).estimate(flight.fix(AT), LENS, COOL))
    assert without.residual_px is None


def test_the_pose_does_not_depend_on_who_computes_it(flight: Flight, run: EstimatorRun) -> None:
    """The anchor judges a place by the pose that the estimator fuses, after the message was encoded and decoded."""
    rng = np.random.default_rng(3)
    matches = seen(flight, AT, below(flight, AT))
    matches[:, :2] += rng.normal(0.0, PIXEL, (9, 2))
    match = match_of(flight, matches=matches)
    received = msgspec.json.decode(msgspec.json.encode(match), type=MapMatch)
    assert received == match
    assert solution_of(poses_of(run).estimate(received, LENS, COOL)).pose == pose_of(solved(match))


# --- the factor and the estimate ----------------------------------------------------------------------------------


def test_estimate_adds_the_map_factor_to_the_graph_of_the_node(flight: Flight, run: EstimatorRun) -> None:
    pose = poses_of(run).estimate(match_of(flight), LENS, COOL)
    assert pose.last_satellite_anchor_age_ms == 0
    *_, estimate_after, link = run.feed(m for m in flight.messages(AT + 1) if not isinstance(m, MapMatch))
    assert isinstance(link, PoseLink)  # for the smoother, after the estimate
    assert isinstance(estimate_after, NavEstimate) and estimate_after.last_anchor_age_ms == 500
    assert np.sqrt(cov_of(estimate_after)[0, 0]) < 5.0  # without the fix 15 m, the sigma of the start


def test_pose_and_covariance_have_the_stated_order_and_units(flight: Flight, run: EstimatorRun) -> None:
    pose = poses_of(run).estimate(match_of(flight), LENS, COOL)
    assert pose.covariance_6x6.shape == (6, 6)
    assert np.isfinite(pose.covariance_6x6).all() and np.linalg.eigvalsh(pose.covariance_6x6)[0] > 0.0
    sigma = np.sqrt(np.diag(pose.covariance_6x6))
    assert (sigma[:3] > 0.1).all() and (sigma[:3] < 10.0).all()  # metres come first ...
    assert (sigma[3:] < 0.1).all()  # ... then radians
    assert pose.position_wgs84[2] == pytest.approx(flight.p_m[AT, 2], abs=8.0)
    turn = rot_from_quat(pose.orientation_world_T_body).T @ flight.r_w_b[AT]
    assert np.degrees(np.arccos((np.trace(turn) - 1.0) / 2.0)) < 2.0


def test_the_node_estimates_with_the_same_poses(flight: Flight) -> None:
    """A match as a message and as a call: the same verdict, estimate and covariance."""
    called, fed = (EstimatorRun().fly(flight, 0, AT + 1) for _ in range(2))
    pose = poses_of(called).estimate(match_of(flight), LENS, COOL)
    verdict, solution, estimate, anchor = fed.feed([match_of(flight)])
    assert isinstance(anchor, PoseAnchor)  # for the smoother, after the estimate
    assert isinstance(verdict, MeasurementVerdict) and isinstance(estimate, NavEstimate)
    assert solution == solution_of(pose)
    assert (verdict.measurement, verdict.verdict) == ("map", Verdict.ACCEPTED)
    assert (estimate.lat_deg, estimate.lon_deg, estimate.alt_amsl_m) == pose.position_wgs84
    assert np.array_equal(cov_of(estimate), pose.covariance_6x6)
    assert (estimate.q_w_b, estimate.source_label) == (pose.orientation_world_T_body, pose.source_label)


def test_the_covariance_is_the_marginal_of_the_smoother_with_what_the_claim_adds(
    flight: Flight, run: EstimatorRun
) -> None:
    pose = poses_of(run).estimate(match_of(flight), LENS, COOL)
    estimator = run.node.estimator
    assert estimator is not None and estimator.last is not None
    rotation = estimator.last.pose.rotation().matrix()
    marginal = rotation @ estimator.graph.covariance(estimator.last.node)[3:, 3:] @ rotation.T
    added = pose.covariance_6x6[:2, :2] - marginal[:2, :2]
    assert np.linalg.eigvalsh(added)[0] >= -1e-9
    assert np.trace(added) < 0.5 * np.trace(marginal[:2, :2])


def test_a_late_match_gives_the_pose_of_its_own_frame(flight: Flight, run: EstimatorRun) -> None:
    run.fly(flight, AT + 1, AT + 3)
    pose = poses_of(run).estimate(match_of(flight), LENS, COOL)
    assert (pose.frame_id, pose.emitted_at) == (AT, t_ns(AT + 2))
    assert horizontal_off_m(pose, flight, AT) < 4.0  # the newest frame is 12 m on
    *_, newest, anchor = EstimatorRun().fly(flight, 0, AT + 3).feed([match_of(flight)])
    assert isinstance(anchor, PoseAnchor) and anchor.frame_id == AT
    assert isinstance(newest, NavEstimate) and newest.frame_id == AT + 2  # the node publishes the newest one again


def test_a_match_that_restarts_the_graph_gives_the_pose_of_the_newest_frame(flight: Flight, run: EstimatorRun) -> None:
    run.fly(flight, AT + 1, AT + 3)
    found = with_search(flight.fix(AT, (300.0, 0.0)), relocalized=True)
    pose = poses_of(run).estimate(found, LENS, COOL)
    assert pose.frame_id == AT + 2
    e_m, _ = PLACE.to_local(*pose.position_wgs84[:2])
    assert e_m - flight.p_m[AT + 2, 0] == pytest.approx(300.0, abs=20.0)


def test_emitted_at_is_the_monotonic_time_of_the_call_where_there_is_a_clock(flight: Flight, run: EstimatorRun) -> None:
    assert poses_of(run).estimate(match_of(flight), LENS, COOL).emitted_at == t_ns(AT)  # in a replay: of the frame
    part = poses_of(run)
    assert isinstance(part, OpenCVGtsamPoseEstimator)
    clocked = OpenCVGtsamPoseEstimator(part.flight, clock=lambda: 123_456_789_000)
    assert clocked.estimate(match_of(flight), LENS, COOL).emitted_at == 123_456_789_000


# --- covariance mode ----------------------------------------------------------------------------------------------


def test_the_covariance_mode_follows_the_thermal_state_per_frame(flight: Flight, run: EstimatorRun) -> None:
    estimator = poses_of(run)
    assert estimator.current_covariance_mode() is CovarianceMode.MARGINALS
    with pytest.warns(CovarianceDegradedWarning, match="propagated covariance: test"):
        hot = estimator.estimate(match_of(flight), LENS, HOT)
    assert hot.covariance_mode is estimator.current_covariance_mode() is CovarianceMode.JACOBIAN
    assert solution_of(hot).covariance_mode is CovarianceMode.JACOBIAN
    run.feed(flight.messages(AT + 1))
    cool = estimator.estimate(match_of(flight, AT + 1), LENS, COOL)  # a warning would be an error here
    assert cool.covariance_mode is estimator.current_covariance_mode() is CovarianceMode.MARGINALS
    assert solution_of(cool).covariance_mode is CovarianceMode.MARGINALS


def test_no_marginal_is_computed_for_a_match_while_hot(
    flight: Flight, run: EstimatorRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    run.feed([HOT, *flight.messages(AT + 1)])
    asked = recorded_marginals(monkeypatch)
    with pytest.warns(CovarianceDegradedWarning):
        poses_of(run).estimate(match_of(flight, AT + 1), LENS, HOT)
    assert asked == []
    poses_of(run).estimate(match_of(flight, AT + 1), LENS, COOL)
    assert asked != []


def test_the_node_publishes_the_mode_of_each_match(flight: Flight, run: EstimatorRun) -> None:
    modes = []
    for health, i in ((HOT, AT + 1), (COOL, AT + 2)):
        published = run.feed([health, *flight.messages(i), match_of(flight, i)])
        modes += [m.covariance_mode for m in published if isinstance(m, PoseSolution)]
    assert modes == [CovarianceMode.JACOBIAN, CovarianceMode.MARGINALS]


# --- failures -----------------------------------------------------------------------------------------------------


def broken(flight: Flight) -> dict[str, tuple[MatchResult, Verdict]]:
    exact = seen(flight, AT, below(flight, AT))
    line = below(flight, AT, np.array([[n, 0.5 * n, 0.0] for n in range(-20, 20)], dtype=float))
    nan, inf = exact.copy(), exact.copy()
    nan[2, 0], inf[3, 4] = np.nan, np.inf
    mirrored = exact * (-1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    turned = quat_from_rot(flight.r_w_c[AT] @ exp_so3(np.array([0.5, 0.0, 0.0])))
    given = flight.fix(AT)
    upside_down = quat_from_rot(rot_from_quat(pose_of(given).q_w_c) @ exp_so3(np.array([np.pi - 1e-6, 0.0, 0.0])))
    with_points = msgspec.structs.replace(given, matches=match_of(flight).matches)
    far = exact.copy()
    far[:5, 2] += 40.0
    return {
        "on a line": (match_of(flight, matches=seen(flight, AT, line)), Verdict.FEW_INLIERS),
        "one point": (match_of(flight, matches=np.repeat(exact[:1], 12, axis=0)), Verdict.FEW_INLIERS),
        "a number that is not finite": (match_of(flight, matches=nan), Verdict.DEGENERATE),
        "a point at infinity": (match_of(flight, matches=inf), Verdict.DEGENERATE),
        "tilted by 29 degrees": (match_of(flight, q_w_c=turned), Verdict.DEGENERATE),
        "mirrored": (match_of(flight, matches=mirrored), Verdict.DEGENERATE),
        "seven matches": (match_of(flight, matches=exact[:7]), Verdict.FEW_INLIERS),
        "no match": (match_of(flight, matches=exact[:0]), Verdict.FEW_INLIERS),
        "five of nine are wrong": (match_of(flight, matches=far), Verdict.FEW_INLIERS),
        "too few for a learned model": (match_of(flight, min_inliers=20), Verdict.FEW_INLIERS),
        "given pose: points behind the camera": (with_pose(with_points, q_w_c=upside_down), Verdict.DEGENERATE),
        "given pose: no number": (with_pose(given, p_c_in_w_m=(float("nan"), 0.0, 100.0)), Verdict.DEGENERATE),
        "given pose: no covariance": (with_pose(given, cov=tuple([0.0] * 36)), Verdict.DEGENERATE),
        "neither matches nor a pose": (msgspec.structs.replace(given, pose=None), Verdict.DEGENERATE),
    }


@pytest.mark.parametrize("why", broken(Flight(AT + 1, seed=2, fix_every=1000)))
def test_matches_that_give_no_pose_raise_and_leave_the_estimate_to_odometry(
    why: str, flight: Flight, run: EstimatorRun
) -> None:
    match, verdict = broken(flight)[why]
    before = run.estimate(AT)
    with pytest.raises(PnpFailureError, match=verdict.value) as failure:
        poses_of(run).estimate(match, LENS, COOL)
    solution = solution_of(failure.value)
    assert (failure.value.verdict, solution.verdict, solution.pose) == (verdict, verdict, None)
    assert run.estimate(AT) == before
    run.feed(flight.messages(AT + 1))
    assert run.estimate(AT + 1).source_label is SourceLabel.VISUAL_PROPAGATED  # the flight continues with odometry
    assert run.estimate(AT + 1).last_anchor_age_ms == 10_500  # since frame 0, the last one with a match


def test_the_node_publishes_verdict_and_solution_of_a_match_without_a_pose(flight: Flight, run: EstimatorRun) -> None:
    match, _ = broken(flight)["seven matches"]
    verdict, solution = run.feed([match])
    assert isinstance(verdict, MeasurementVerdict) and isinstance(solution, PoseSolution)
    assert (verdict.verdict, solution.verdict) == (Verdict.FEW_INLIERS, Verdict.FEW_INLIERS)
    assert msgspec.json.decode(msgspec.json.encode(solution), type=PoseSolution) == solution


@pytest.mark.parametrize("verdict", [Verdict.AMBIGUOUS, Verdict.DEGENERATE, Verdict.THROTTLED, Verdict.LOST])
def test_a_match_that_the_anchor_did_not_accept_is_not_solved(
    verdict: Verdict, flight: Flight, run: EstimatorRun
) -> None:
    with pytest.raises(PnpFailureError, match=verdict.value) as failure:
        poses_of(run).estimate(msgspec.structs.replace(match_of(flight), verdict=verdict), LENS, COOL)
    solution = solution_of(failure.value)
    assert (solution.verdict, solution.method, solution.pose) == (verdict, PoseMethod.NONE, None)


def test_rejections_by_the_gate_and_of_frames_that_left_the_window_are_stated(
    flight: Flight, run: EstimatorRun
) -> None:
    estimator = poses_of(run)
    away = seen(flight, AT, below(flight, AT))
    away[:, 2] += 354.0
    with pytest.raises(PnpFailureError, match=r"innovation: horizontally 35\d m from the estimate") as failure:
        estimator.estimate(match_of(flight, matches=away), LENS, COOL)
    assert solution_of(failure.value).verdict is Verdict.ACCEPTED  # the pose was computed, and then rejected
    for stale in (flight.fix(AT), match_of(flight), msgspec.structs.replace(match_of(flight), pnp=None)):
        with pytest.raises(PnpFailureError, match="stale: frame has left the window"):
            estimator.estimate(msgspec.structs.replace(stale, frame_id=4711), LENS, COOL)


def test_a_camera_other_than_that_of_the_flight_is_an_error(flight: Flight, run: EstimatorRun) -> None:
    before = run.node.estimator
    assert before is not None and before.last is not None
    last = before.last
    for wrong in (LENS.scaled(0.5), dataclasses.replace(LENS, fx=LENS.fx * 1.001)):
        with pytest.raises(ValueError, match="camera"):
            poses_of(run).estimate(match_of(flight), wrong, COOL)
    assert before.last is last


def test_before_the_origin_there_is_no_pose_estimator() -> None:
    assert EstimatorRun().node.pose_estimator is None


def test_the_camera_and_message_types_match_those_of_the_flight() -> None:
    assert CameraCalibration.of(ORIGIN.camera) == LENS
    assert issubclass(MatchResult, MapMatch)
