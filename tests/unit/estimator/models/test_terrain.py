"""Terrain model, ground plane of odometry, and attitude of the body through the mount."""

import gtsam
import msgspec
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, C

from map_matches import plane
from simulated_flight import FRAME_S, EstimatorRun, Flight, blind
from terrafix.core.pose import tangent_to_world
from terrafix.estimator.estimator import Estimator
from terrafix.estimator.factors.plane_two_view import plane_two_view_factor
from terrafix.estimator.filter_state import FrameInput
from terrafix.estimator.keyframe_view import KeyframeView
from terrafix.estimator.measurements.ground_plane_motion import ground_below
from terrafix.estimator.measurements.map_pose import measured_pose
from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.models.plane_motion import Ground, MatchedRays
from terrafix.estimator.models.terrain import Terrain
from terrafix.estimator.models.terrain_roughness import PRIOR, ROUGHNESS_CANDIDATES
from terrafix.estimator.node import EstimatorNode
from terrafix.estimator.state import CALIBRATION_SIZE
from terrafix.messages import (
    Camera,
    MapMatch,
    MapPose,
    MeasurementVerdict,
    NavEstimate,
    Odometry,
    Origin,
    VehicleState,
    Verdict,
)

RISE = float(np.sqrt(PRIOR @ ROUGHNESS_CANDIDATES**2))  # prior

ORIGIN = Origin(
    t_ns=0,
    camera=Camera(width=960, height=540, fx=560.0, fy=560.0, cx=479.5, cy=269.5, mount_tolerance_deg=2.0),
    lat_deg=48.0,
    lon_deg=11.0,
    ground_amsl_m=40.0,
    start_sigma_m=5.0,
    yaw_sigma_deg=3.0,
    agl_sigma_m=3.0,
    attitude_sigma_deg=0.7,
)


def begun(attitude: Attitude) -> Estimator:
    estimator = Estimator(ORIGIN)
    first = Odometry(t_ns=0, frame_id=0, keyframe_id=0, verdict=Verdict.ACCEPTED, becomes_keyframe=True)
    estimator.feed_frame(FrameInput(0, 0.0, first, attitude))
    return estimator


@pytest.mark.parametrize("armed", [True, False, None])
def test_a_slightly_negative_height_on_the_ground_is_accepted_as_the_initial_height(armed: bool | None) -> None:
    """A barometer may read 4 cm too low."""
    below = Attitude(0.0, 0.0, 0.0, -0.04, armed=armed)
    estimator = begun(below)
    for frame in (1, 2, 3):
        advance = estimator.feed_frame(FrameInput(frame, 0.5 * frame, unseen(0.5 * frame), below))
        assert advance.placed is not None and np.isfinite(advance.placed.cov).all()


def test_the_ground_plane_is_relative_to_the_place_of_the_match() -> None:
    estimator = begun(Attitude(0.0, 0.0, 0.0, 100.0))
    assert estimator.terrain.elevation_m(np.array([300.0, -200.0, 140.0])) == 40.0  # flat before the first map match
    match = MapMatch(
        t_ns=0, frame_id=0, verdict=Verdict.FEW_INLIERS, matcher="gradient", ground=plane(50.0, 0.1, -0.05)
    )
    estimator.feed_map_match(match)
    assert estimator.terrain.elevation_m(np.array([0.0, 0.0, 140.0])) == pytest.approx(50.0, abs=0.5)
    here = estimator.terrain.elevation_m(np.array([0.0, 0.0, 140.0]))
    assert estimator.terrain.elevation_m(np.array([20.0, 10.0, 140.0])) - here == pytest.approx(
        20.0 * 0.1 - 10.0 * 0.05
    )


def test_a_slope_is_extrapolated_over_a_limited_distance() -> None:
    """A minute without pictures at 17 m/s: a slope extrapolated over a kilometre would rise by 100 m."""
    terrain = Terrain(40.0)
    terrain.update(plane(50.0, 0.1, 0.0), np.zeros(3))
    assert terrain.elevation_m(np.array([100.0, 0.0, 0.0])) == pytest.approx(60.0)
    assert terrain.elevation_m(np.array([1000.0, 0.0, 0.0])) == pytest.approx(65.0)
    near, far = (terrain.ground_plane(np.array([e_m, 0.0, 0.0]), 130.0, 2.0, 1.0) for e_m in (100.0, 1000.0))
    assert near.level_share * 130.0 == pytest.approx(np.hypot(1.3, 1.2))
    assert far.level_share * 130.0 == pytest.approx(RISE * np.sqrt(850.0), rel=0.03)
    low = terrain.ground_plane(np.zeros(3), 10.0, 0.5, 1.0)
    assert low.level_share == pytest.approx(0.12, rel=0.01)  # a DEM error of a metre is large at low height


def test_without_a_dem_the_elevation_is_a_random_walk() -> None:
    terrain = Terrain(40.0)
    assert terrain.rise_sigma_m(100.0) == pytest.approx(10.0 * RISE)
    assert terrain.slope_sigma(100.0) == pytest.approx(0.1 * RISE)
    # Half of the curvature times 50 m squared, on both sides: the rise of a random walk over 100 m.
    assert terrain.curvature_sigma(100.0) * 50.0**2 == pytest.approx(10.0 * RISE)
    assert terrain.ground_plane(np.zeros(3), 100.0, 2.0, 1.0).curvature_sigma == terrain.curvature_sigma(100.0)
    terrain.update(plane(50.0, 0.1, 0.0), np.zeros(3))
    assert terrain.rise_sigma_m(100.0) == terrain.slope_sigma(100.0) == terrain.curvature_sigma(100.0) == 0.0


def test_a_plane_with_few_inliers_has_a_larger_level_sigma() -> None:
    ground, roof = (Terrain(40.0).ground_plane(np.zeros(3), 100.0, 2.0, share) for share in (1.0, 0.4))
    assert ground.rise_sigma_m == roof.rise_sigma_m == 0.0
    assert roof.level_sigma_m == pytest.approx(ground.level_sigma_m + 12.0 * 0.6**2)


def test_the_sigma_of_an_unknown_slope_accounts_for_repeated_views_and_roughness() -> None:
    """Some fifteen keyframes see the same slope, so the sigma of each is larger by the root of their number."""
    terrain = Terrain(40.0)
    unknown = terrain.ground_plane(np.zeros(3), 100.0, 2.0, 1.0)
    assert unknown.slope_sigma == pytest.approx(4.0 * terrain.slope_sigma(100.0), rel=0.01)
    for north_m in np.arange(0.0, 3000.0, 60.0):
        terrain.roughness.update(np.array([0.0, north_m]), 100.0, 0.0, 3.0)
    assert terrain.ground_plane(np.zeros(3), 100.0, 2.0, 1.0).slope_sigma < 0.5 * unknown.slope_sigma


def test_a_map_pose_over_an_unknown_slope_is_within_its_covariance() -> None:
    """The PnP pose over ground with a slope of 3 % that is taken for flat is within its covariance."""
    known = Terrain(0.0)
    known.update(plane(0.0), None)
    exact = np.diag([0.01, 0.01, 0.01, 1e-6, 1e-6, 1e-6])
    seen = MapPose(p_c_in_w_m=(0.0, 0.0, 100.0), q_w_c=(0.0, 1.0, 0.0, 0.0), cov=tuple(exact.ravel()))
    sloped = np.array([3.0, 0.0, 0.0, 0.0, 0.03, 0.0])  # east by a turn about north; the order of the messages
    for terrain, low, high in ((known, 100.0, np.inf), (Terrain(0.0), 0.0, 2.0)):
        pose, cov = measured_pose(seen, 0.0, terrain)
        world = tangent_to_world(cov, pose.rotation().matrix())
        assert low < float(sloped @ np.linalg.solve(world, sloped)) < high


@pytest.mark.parametrize("along", [(1.0, 0.0), (0.0, 1.0), (0.6, 0.8)])
def test_the_curvature_of_the_ground_is_in_the_noise_of_odometry(along: tuple[float, float]) -> None:
    """The slope of a valley changes by 4 % in 100 m. In steps of 25 m and taken for a plane, it rotates the estimated
    camera at every step in the same direction, beyond the covariance; with the curvature in the noise it does not."""
    curvature, course = 4e-4, np.array(along)
    places = np.random.default_rng(1).uniform(-40.0, 40.0, (60, 2))
    points = np.column_stack([places, 0.5 * curvature * (places @ course) ** 2])
    looks_down = gtsam.Rot3(np.diag([1.0, -1.0, -1.0]))
    keyframe, pose = (gtsam.Pose3(looks_down, np.array([*way_m * course, 100.0])) for way_m in (0.0, 25.0))
    in_both = [(points - camera.translation()) @ looks_down.matrix() for camera in (keyframe, pose)]
    pairs = np.hstack([p[:, :2] / p[:, 2:] for p in in_both])
    turned_rad, in_sigmas = [], []
    for curvature_sigma in (0.0, curvature):
        ground = Ground(100.0, 2.0, slope_sigma=0.3, curvature_sigma=curvature_sigma)
        values, graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
        values.insert(C(0), keyframe)
        values.insert(C(1), pose)
        values.insert(B(1), np.zeros(CALIBRATION_SIZE))
        known = gtsam.noiseModel.Isotropic.Sigma
        graph.add(gtsam.PriorFactorPose3(C(0), keyframe, known(6, 1e-6)))
        graph.add(gtsam.PriorFactorVector(B(1), np.zeros(CALIBRATION_SIZE), known(CALIBRATION_SIZE, 1e-6)))
        graph.add(plane_two_view_factor(C(0), C(1), B(1), keyframe, pose, MatchedRays(pairs, 1e-4, ground)))
        solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        turned = gtsam.Rot3.Logmap(looks_down.between(solved.atPose3(C(1)).rotation()))
        cov = gtsam.Marginals(graph, solved).marginalCovariance(C(1))[:3, :3]
        turned_rad.append(float(np.linalg.norm(turned)))
        in_sigmas.append(float(np.sqrt(turned @ np.linalg.solve(cov, turned))))
    assert in_sigmas[0] > 1.5 and in_sigmas[1] < 0.2
    assert turned_rad[0] > 0.05 * curvature * 25.0 and turned_rad[1] < 0.1 * turned_rad[0]


@pytest.mark.parametrize(("pitch_rad", "sigma_deg"), [(0.0, 0.7), (None, 2.0)])
def test_the_attitude_sigma_of_the_body_is_that_of_the_autopilot_or_of_the_mount(
    pitch_rad: float | None, sigma_deg: float
) -> None:
    estimator = begun(Attitude(0.0, pitch_rad, pitch_rad, 100.0))
    assert estimator.state.camera.body_sigma_rad == pytest.approx(np.radians(sigma_deg))


def test_a_sloping_plane_does_not_make_the_horizontal_position_observable() -> None:
    """With a plane that extends everywhere, the height would determine the position: a camera that was 110 m off after
    a take-off had a sigma of 22 m."""
    looks_down = np.diag([1.0, -1.0, -1.0])
    keyframe = gtsam.Pose3(gtsam.Rot3(looks_down), np.array([0.0, 0.0, 100.0]))
    pose = gtsam.Pose3(gtsam.Rot3(looks_down), np.array([10.0, 5.0, 101.0]))
    seen = np.random.default_rng(1).uniform(-0.4, 0.4, (40, 2))
    sloping = Ground(100.0, 2.0, slope_e=0.15, slope_n=-0.1, slope_sigma=0.01)
    depth = 100.0 / (1.0 + seen @ (0.15, 0.1))  # rays (x, -y, -1) meet the plane up = 0.15 east - 0.1 north
    points = np.column_stack([seen[:, 0] * depth, -seen[:, 1] * depth, 100.0 - depth])
    in_pose = (points - pose.translation()) @ looks_down
    pairs = np.column_stack([seen, in_pose[:, :2] / in_pose[:, 2:]])
    factor = plane_two_view_factor(0, 1, 2, keyframe, pose, MatchedRays(pairs, 1e-3, sloping))

    def error(moved_m: tuple[float, float, float]) -> float:
        values = gtsam.Values()
        values.insert(2, np.zeros(CALIBRATION_SIZE))
        for key, camera in ((0, keyframe), (1, pose)):
            values.insert(key, gtsam.Pose3(camera.rotation(), camera.translation() + moved_m))
        return float(factor.error(values))

    assert error((0.0, 0.0, 0.0)) < 1e-6
    assert error((60.0, -40.0, 0.0)) < 1e-6  # position of both
    assert error((0.0, 0.0, 5.0)) > 1.0  # height of both over the ground


def test_the_level_sigma_on_a_slope_grows_with_the_position_sigma() -> None:
    estimator = begun(Attitude(0.0, 0.0, 0.0, 100.0))
    match = MapMatch(t_ns=0, frame_id=0, verdict=Verdict.FEW_INLIERS, matcher="gradient", ground=plane(40.0, 0.1, 0.0))
    estimator.feed_map_match(match)
    pose = gtsam.Pose3(gtsam.Rot3.Rx(np.pi), np.array([0.0, 0.0, 140.0]))
    found, lost = (
        ground_below(
            estimator.state,
            KeyframeView(pose, np.diag([0.1, 0.1, 0.1, sigma_m, sigma_m, 3.0]) ** 2, 40.0),
            1.0,
        ).level_sigma_m
        for sigma_m in (1.0, 60.0)
    )
    assert found < 1.8 and lost == pytest.approx(4.0 * 6.0, rel=0.05)


def unseen(t_s: float) -> Odometry:
    frame_id = round(2 * t_s)
    return Odometry(t_ns=round(t_s * 1e9), frame_id=frame_id, keyframe_id=0, verdict=Verdict.FEW_INLIERS)


def test_a_take_off_without_measurements_is_within_the_covariance() -> None:
    """Off the runway at 8 m/s^2, without IMU: 6 s later it is 102 m away."""
    estimator = begun(Attitude(0.0, 0.0, 0.0, 0.0, armed=False))
    for t_s in np.arange(0.5, 60.0, 0.5):
        waiting = estimator.feed_frame(
            FrameInput(round(2 * t_s), t_s, unseen(t_s), Attitude(0.0, 0.0, 0.0, 0.0, armed=False))
        )
    assert np.sqrt(waiting.placed.cov[3, 3]) < 6.0  # stationary: the initial covariance
    for t_s in np.arange(60.0, 66.0, 0.5):
        height_m = max(0.0, 5.0 * (t_s - 64.0))
        off = estimator.feed_frame(
            FrameInput(round(2 * t_s), t_s, unseen(t_s), Attitude(0.0, 0.1, 0.0, height_m, armed=True))
        )
    position = np.sqrt(np.linalg.eigvalsh(off.placed.cov[3:, 3:])[-1])
    assert 102.0 / 3.0 < position < 150.0
    assert 22.0 / 3.0 < np.sqrt(off.placed.velocity_cov[0, 0]) < 40.0


@pytest.mark.parametrize(("began_ns", "low_m", "high_m"), [(None, 4.0, 30.0), (0, 100.0, 1000.0)])
def test_an_estimator_restarted_in_flight_has_a_wide_initial_position(
    began_ns: int | None, low_m: float, high_m: float
) -> None:
    """Killed 15 s after the start, it began at the start again, 280 m behind, with the covariance of the ground."""
    node = EstimatorNode(began_ns)
    list(node.on(ORIGIN))
    state = VehicleState(t_ns=15_000_000_000, source="x", yaw_rad=0.0, pitch_rad=0.0, roll_rad=0.0, agl_m=100.0)
    list(node.on(state))
    seen = Odometry(t_ns=15_000_000_000, frame_id=30, keyframe_id=30, verdict=Verdict.ACCEPTED, becomes_keyframe=True)
    (estimate,) = (m for m in node.on(seen) if isinstance(m, NavEstimate))
    assert low_m < np.sqrt(estimate.cov[0]) < high_m


def test_velocity_with_a_wrong_ground_level_is_within_its_sigma() -> None:
    """The ground at the estimated position was 60 m higher than the true one: translations were half as long, and the
    shorter the more certain, so that a plane at 20 m/s had an estimate of 3 +- 3 m/s for a minute."""
    flight = Flight(100, seed=4, dem=True)
    run = EstimatorRun().fly(flight, 0, 20)
    for i in range(20, flight.frames):
        elsewhere = MapMatch(
            t_ns=round(i * FRAME_S * 1e9),
            frame_id=i,
            verdict=Verdict.FEW_INLIERS,
            matcher="gradient",
            ground=plane(60.0, 0.15, 0.0),
        )
        messages = [m for m in flight.messages(i) if not isinstance(m, MapMatch)]
        run.feed([blind(m) if i < 60 and isinstance(m, Odometry) else m for m in messages] + [elsewhere])
    for i in range(62, flight.frames):
        estimate = run.estimate(i)
        flown_mps = (flight.p_m[i] - flight.p_m[i - 1]) / FRAME_S
        off_mps = float(np.hypot(*(np.array(estimate.velocity_enu_mps) - flown_mps)[:2]))
        assert off_mps < 3.0 * estimate.velocity_sigma_mps
    why = {m.verdict for m in run.published if isinstance(m, MeasurementVerdict) and m.measurement == "odometry"}
    assert why == {Verdict.ACCEPTED, Verdict.FEW_INLIERS, Verdict.DEGENERATE}


def test_rejected_odometry_has_a_verdict_with_the_reason() -> None:
    flight = Flight(4, dem=True)
    run = EstimatorRun().fly(flight, 0, 3)
    odometry = next(m for m in flight.messages(3) if isinstance(m, Odometry))
    run.feed([msgspec.structs.replace(odometry, keyframe_id=777), msgspec.structs.replace(odometry, two_view=[])])
    verdicts = [m.verdict for m in run.published if isinstance(m, MeasurementVerdict) and m.measurement == "odometry"]
    assert verdicts[-2:] == [Verdict.STALE, Verdict.FEW_INLIERS]
