"""PoseEstimator, the estimator as a function call (ON-1): names, shared graph, covariance mode, and failures."""

import msgspec
import numpy as np
import pytest

from map_matches import pose_of, with_pose
from simulated_flight import CAMERA, ORIGIN, EstimatorRun, Flight, cov_of, t_ns
from terrafix.core.camera import CameraCalibration
from terrafix.core.geodesy import quat_from_rot, rot_from_quat
from terrafix.core.pose import exp_so3
from terrafix.estimator import (
    CovarianceDegradedWarning,
    CovarianceMode,
    MatchResult,
    PnpFailureError,
    PoseEstimator,
    ThermalState,
)
from terrafix.messages import MapMatch, SourceLabel, ThermalBand, Verdict

LENS = CameraCalibration.of(CAMERA)
AT = 20


def thermal(band: ThermalBand) -> ThermalState:
    return ThermalState(t_ns=0, band=band, temperature_c=60.0, throttled=False, disk_free_mb=1000, cause="test")


COOL, HOT = thermal(ThermalBand.NORMAL), thermal(ThermalBand.HOT)


def seen(flight: Flight, i: int, points: np.ndarray) -> list[tuple[float, float, float, float, float, float]]:
    """2D-3D matches of ground points (N, 3) [m] in frame i."""
    q = (points - flight.p_m[i]) @ flight.r_w_c[i]
    xy = q[:, :2] / q[:, 2:]
    return [(*map(float, a), *map(float, b), 1.0) for a, b in zip(xy, points, strict=True)]  # type: ignore[misc]


@pytest.fixture
def flight() -> Flight:
    return Flight(AT + 3, seed=2, fix_every=1000)


@pytest.fixture
def run(flight: Flight) -> EstimatorRun:
    return EstimatorRun().fly(flight, 0, AT + 1)


def match_of(flight: Flight, i: int = AT) -> MatchResult:
    under = flight.p_m[i] * (1.0, 1.0, 0.0)
    grid = np.array([[e, n, 0.0] for e in (-40.0, 0.0, 40.0) for n in (-20.0, 0.0, 20.0)])
    return msgspec.structs.replace(flight.fix(i), matches=seen(flight, i, under + grid))


def test_estimate_adds_the_map_factor_to_the_graph_of_the_node(flight: Flight, run: EstimatorRun) -> None:
    pose = poses_of(run).estimate(match_of(flight), LENS, COOL)
    assert (pose.frame_id, pose.source_label) == (AT, SourceLabel.SATELLITE_ANCHORED)
    assert pose.last_satellite_anchor_age_ms == 0
    estimate_after = run.feed(m for m in flight.messages(AT + 1) if not isinstance(m, MapMatch))[-1]
    assert estimate_after.last_anchor_age_ms == 500  # type: ignore[attr-defined]
    assert np.sqrt(cov_of(estimate_after)[0, 0]) < 5.0  # type: ignore[arg-type]  # without the fix 15 m, the sigma of the start


def test_pose_and_covariance_have_the_stated_order_and_units(flight: Flight, run: EstimatorRun) -> None:
    before = run.estimate(AT)
    pose = poses_of(run).estimate(match_of(flight), LENS, COOL)
    assert pose.covariance_6x6.shape == (6, 6)
    assert np.isfinite(pose.covariance_6x6).all() and np.linalg.eigvalsh(pose.covariance_6x6)[0] > 0.0
    sigma = np.sqrt(np.diag(pose.covariance_6x6))
    assert (sigma[:3] > 0.5).all() and (sigma[:3] < 10.0).all()  # metres come first ...
    assert (sigma[3:] < 0.1).all()  # ... then radians
    latitude, longitude, height_m = pose.position_wgs84
    assert (latitude, longitude) == pytest.approx((before.lat_deg, before.lon_deg), abs=1e-3)
    assert height_m == pytest.approx(flight.p_m[AT, 2], abs=8.0)
    assert np.linalg.norm(pose.orientation_world_T_body) == pytest.approx(1.0)
    assert pose.emitted_at == t_ns(AT)


def test_the_covariance_mode_follows_the_thermal_state_per_frame(flight: Flight, run: EstimatorRun) -> None:
    estimator = poses_of(run)
    assert estimator.current_covariance_mode() is CovarianceMode.MARGINALS
    with pytest.warns(CovarianceDegradedWarning, match="test"):
        hot = estimator.estimate(match_of(flight), LENS, HOT)
    assert hot.covariance_mode is estimator.current_covariance_mode() is CovarianceMode.JACOBIAN
    run.feed(flight.messages(AT + 1))
    cool = estimator.estimate(match_of(flight, AT + 1), LENS, COOL)  # a warning would be an error here
    assert cool.covariance_mode is estimator.current_covariance_mode() is CovarianceMode.MARGINALS


def broken(match: MatchResult, flight: Flight) -> dict[str, MatchResult]:
    line = flight.p_m[AT] * (1.0, 1.0, 0.0) + np.array([[n, 2.0 * n, 0.0] for n in range(-20, 20)])
    change = msgspec.structs.replace
    nan = float("nan")
    return {
        "on a line": change(match, matches=seen(flight, AT, line)),
        "three matches of one point": change(match, matches=match.matches[:1] * 3),
        "behind the camera": with_pose(match, q_w_c=_upside_down(match)),
        "no number": with_pose(match, p_c_in_w_m=(nan, 0.0, 100.0)),
        "no covariance": with_pose(match, cov=tuple([0.0] * 36)),
        "no pose": change(match, pose=None),
    }


def _upside_down(match: MatchResult) -> tuple[float, float, float, float]:
    return quat_from_rot(rot_from_quat(pose_of(match).q_w_c) @ exp_so3(np.array([np.pi - 1e-6, 0.0, 0.0])))


@pytest.mark.parametrize(
    "why", ["on a line", "three matches of one point", "behind the camera", "no number", "no covariance", "no pose"]
)
def test_degenerate_matches_raise_and_leave_the_estimate_unchanged(why: str, flight: Flight, run: EstimatorRun) -> None:
    before = run.estimate(AT)
    with pytest.raises(PnpFailureError, match="degenerate") as failure:
        poses_of(run).estimate(broken(match_of(flight), flight)[why], LENS, COOL)
    assert failure.value.verdict is Verdict.DEGENERATE
    assert run.estimate(AT) == before
    run.feed(flight.messages(AT + 1))
    assert run.estimate(AT + 1).source_label is SourceLabel.VISUAL_PROPAGATED  # the flight continues with odometry


def test_failures_of_pnp_and_gate_are_stated_in_the_exception(flight: Flight, run: EstimatorRun) -> None:
    estimator = poses_of(run)
    with pytest.raises(PnpFailureError, match="degenerate"):
        estimator.estimate(msgspec.structs.replace(match_of(flight), verdict=Verdict.DEGENERATE), LENS, COOL)
    with pytest.raises(PnpFailureError, match=r"innovation: horizontally \d+ m from the estimate"):
        estimator.estimate(flight.fix(AT, (354.0, 0.0)), LENS, COOL)
    with pytest.raises(PnpFailureError, match="stale"):
        estimator.estimate(msgspec.structs.replace(match_of(flight), frame_id=4711), LENS, COOL)


def test_a_camera_other_than_that_of_the_flight_is_an_error(flight: Flight, run: EstimatorRun) -> None:
    with pytest.raises(ValueError, match="camera"):
        poses_of(run).estimate(match_of(flight), LENS.scaled(0.5), COOL)
    with pytest.raises(ValueError, match="camera"):
        poses_of(EstimatorRun()).estimate(match_of(flight), LENS, COOL)


def test_the_camera_and_message_types_match_those_of_the_flight() -> None:
    assert CameraCalibration.of(ORIGIN.camera) == LENS
    assert issubclass(MatchResult, MapMatch)
