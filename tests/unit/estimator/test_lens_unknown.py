"""A lens that nobody has calibrated: learnt in flight, claimed until it is, and used by whoever looks at the map."""

import gtsam
import msgspec
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, C

from simulated_flight import CAMERA, ORIGIN, Flight, Listener
from terrafix.anchor.matching.orthorectify import rectify
from terrafix.core.camera import CameraCalibration, bent, straightened
from terrafix.core.geodesy import quat_from_rot, rot_from_quat
from terrafix.core.pose import fit_pose
from terrafix.estimator.factors.custom_factors import BIAS_SIZE, LENS, map_fix_factor
from terrafix.estimator.measurements.map_pose import moved_by_lens
from terrafix.estimator.models.lens_prior import centre_sigma, lens_sigma
from terrafix.messages import MapMatch, Message, NavEstimate, Odometry, Prediction, SlowErrors, Verdict
from terrafix_tools.lens_words import lens_words

BEND = -0.28  # an action camera
UNCALIBRATED, CALIBRATED = msgspec.structs.replace(CAMERA, focal_sigma=0.1), CAMERA
DOWN = np.diag([1.0, -1.0, -1.0])


def test_what_is_bent_is_straightened() -> None:
    xy = np.random.default_rng(1).uniform(-0.9, 0.9, (50, 2))
    for bend in (-0.35, -0.05, 0.1):
        assert np.allclose(straightened(bent(xy, bend), bend), xy)
    near = 0.01 * xy
    assert np.allclose(bent(near, BEND), near * (1.0 + BEND * np.sum(near**2, axis=1, keepdims=True)), atol=1e-9)


@pytest.mark.parametrize("distortion", [(), (-0.1, 0.02, 0.0, 0.0)])
def test_a_camera_that_bends_projects_what_it_normalises(distortion: tuple[float, ...]) -> None:
    camera = CameraCalibration(960, 540, 560.0, 560.0, 479.5, 269.5, distortion, -0.1)
    px = np.array([[30.0, 20.0], [480.0, 270.0], [900.0, 500.0]])
    rays = np.column_stack([camera.normalise(px), np.ones(3)])
    assert np.allclose(camera.project(2.0 * rays), px, atol=0.01)
    assert camera.scaled(0.5).bend == camera.bend


def test_a_picture_is_rectified_through_the_lens_as_it_is() -> None:
    camera = CameraCalibration(960, 540, 560.0, 560.0, 479.5, 269.5, (), BEND)
    across = np.tile(np.linspace(0, 255, 960, dtype=np.float32)[None, :, None], (540, 1, 3)).astype(np.uint8)
    flat = rectify(across, camera, DOWN, 100.0, 1.0)
    assert flat is not None
    row, column = flat.image.shape[0] // 2, flat.image.shape[1] // 2 + 60
    ground = np.array([flat.e_min_m + column + 0.5, flat.n_max_m - row - 0.5, -100.0])
    x, y = camera.project((ground @ DOWN)[None])[0]
    assert flat.mask[row, column]
    assert abs(float(flat.image[row, column, 0]) - float(across[round(y), round(x), 0])) < 2.0


def seen_through(bend: float, aside_m: float) -> MapMatch:
    """The pose, 100 m up, of ground that lies aside, through a lens that was taken for a straight one."""
    ground = np.random.default_rng(2).uniform((aside_m - 40.0, -40.0), (aside_m + 40.0, 40.0), (40, 2))
    points = np.column_stack([ground, np.zeros(40)])
    xy = bent(np.column_stack([ground[:, 0], -ground[:, 1]]) / 100.0, bend)
    fit = fit_pose(points, xy, DOWN, np.array([0.0, 0.0, 100.0]), 1e-3)
    assert fit is not None
    p = fit.p_c_in_w_m
    return MapMatch(
        t_ns=0,
        frame_id=0,
        verdict=Verdict.ACCEPTED,
        matcher="gradient",
        matches=[(float(a), float(b), float(c), float(d), 0.0, 1.0) for (a, b), (c, d) in zip(xy, ground, strict=True)],
        p_c_in_w_m=(float(p[0]), float(p[1]), float(p[2])),
        q_w_c=quat_from_rot(fit.r_w_c),
        cov=tuple(np.eye(6).ravel()),
    )


@pytest.mark.parametrize("aside_m", [0.0, 45.0])
def test_what_a_lens_moved_a_fix_by_is_known(aside_m: float) -> None:
    bend = -0.03
    match = seen_through(bend, aside_m)
    assert match.p_c_in_w_m is not None and match.q_w_c is not None
    wrong_m = float(np.linalg.norm(np.array(match.p_c_in_w_m) - (0.0, 0.0, 100.0)))
    by_lens = moved_by_lens(match)
    assert by_lens is not None
    pose = gtsam.Pose3(gtsam.Rot3(rot_from_quat(match.q_w_c)), np.array(match.p_c_in_w_m))
    righted = pose.retract(by_lens * bend).translation()
    assert float(np.linalg.norm(righted - (0.0, 0.0, 100.0))) < 0.25 * wrong_m
    assert moved_by_lens(msgspec.structs.replace(match, matches=[])) is None


def test_what_the_lens_leaves_open_does_not_average_away() -> None:
    pose, by_lens = gtsam.Pose3(gtsam.Rot3(DOWN), np.array([0.0, 0.0, 100.0])), np.zeros(6)
    by_lens[3] = 50.0  # m, of a lens that bends by one more
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorVector(B(0), np.zeros(BIAS_SIZE), gtsam.noiseModel.Isotropic.Sigma(BIAS_SIZE, 0.15)))
    for _ in range(100):
        graph.add(map_fix_factor(C(0), B(0), pose, np.eye(6), by_lens, 0.0))
    values.insert(C(0), pose)
    values.insert(B(0), np.zeros(BIAS_SIZE))
    sigmas_m = np.sqrt(np.diag(gtsam.Marginals(graph, values).marginalCovariance(C(0))))
    assert sigmas_m[3] == pytest.approx(0.15 * 50.0, rel=0.05)
    assert sigmas_m[4] == pytest.approx(0.1, rel=0.05)


def test_a_lens_that_nobody_stated_is_learnt_at_once() -> None:
    flight, run = Flight(24, seed=3), Listener()

    def through_the_lens(message: Message) -> Message:
        if not isinstance(message, Odometry) or not message.pairs:
            return message
        pairs = np.array(message.pairs)
        pairs = np.hstack([bent(pairs[:, :2], BEND), bent(pairs[:, 2:], BEND)])
        return msgspec.structs.replace(
            message, pairs=[(float(a), float(b), float(c), float(d)) for a, b, c, d in pairs]
        )

    said: list[Message] = []
    said += run.node.on(msgspec.structs.replace(ORIGIN, camera=UNCALIBRATED))
    for i in range(flight.frames):
        for message in flight.messages(i):
            said += run.node.on(through_the_lens(message))
    told = [m.lens for m in said if isinstance(m, Prediction)]
    assert told[0] == 0.0
    assert told[-1] == pytest.approx(BEND, abs=0.04)
    learnt = [m for m in said if isinstance(m, SlowErrors)][-1]
    assert abs(learnt.error[LENS] - BEND) < 3.0 * np.sqrt(learnt.cov[LENS * BIAS_SIZE + LENS])
    words = lens_words(UNCALIBRATED, learnt)
    assert words is not None and "k1 = -0.2" in words and "distortion = [-0.2" in words and "focal_sigma = 0.1" in words
    stated = msgspec.structs.replace(UNCALIBRATED, distortion=(-0.1, 0.0, 0.0, 0.0))
    assert "calibrate it again" in (lens_words(stated, learnt) or "")
    straight = msgspec.structs.replace(learnt, error=(*learnt.error[:LENS], -0.01, learnt.error[LENS + 1]))
    assert lens_words(UNCALIBRATED, straight) is None


def test_who_states_a_calibration_keeps_its_claims() -> None:
    stated = msgspec.structs.replace(CAMERA, distortion=(-0.28, 0.09, 0.0, 0.0))
    assert lens_sigma(stated) == lens_sigma(CALIBRATED) < lens_sigma(UNCALIBRATED)
    assert centre_sigma(stated) == centre_sigma(CALIBRATED) == 0.0
    # Who writes down what a flight has learnt of the bend knows no more of the focal length, and of the middle.
    learnt = msgspec.structs.replace(UNCALIBRATED, distortion=stated.distortion)
    assert lens_sigma(learnt) == lens_sigma(stated) and centre_sigma(learnt) == centre_sigma(UNCALIBRATED)
    flight = Flight(12, seed=3)
    claimed = []
    for camera in (CALIBRATED, UNCALIBRATED):
        run = Listener()
        said = list(run.node.on(msgspec.structs.replace(ORIGIN, camera=camera)))
        for i in range(flight.frames):
            for message in flight.messages(i):
                said += run.node.on(message)
        newest = [m for m in said if isinstance(m, NavEstimate)][-1]
        claimed.append(newest.cov[0])
        height_m = newest.agl_m
    assert claimed[1] > claimed[0] + 0.9 * (centre_sigma(UNCALIBRATED) * height_m) ** 2
