"""Uncalibrated lens: estimated in flight, in the covariance until then, and used for orthorectification."""

import gtsam
import msgspec
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, C

from simulated_flight import CAMERA, ORIGIN, EstimatorRun, Flight, with_distortion
from terrafix.anchor.matching.orthorectify import rectify
from terrafix.core.camera import CameraCalibration, distort_division, undistort_division
from terrafix.core.geodesy import quat_from_rot, rot_from_quat
from terrafix.core.pose import fit_pose
from terrafix.estimator.factors.map_pose import map_pose_factor
from terrafix.estimator.measurements.map_pose import moved_by_k1
from terrafix.estimator.models.lens_prior import principal_point_sigma, radial_k1_sigma
from terrafix.estimator.state import CALIBRATION_SIZE, RADIAL_K1
from terrafix.messages import (
    CalibrationEstimate,
    MapMatch,
    MapPose,
    Message,
    NavEstimate,
    Prediction,
    Verdict,
)
from terrafix_tools.lens_report import lens_words

ACTION_CAMERA_K1 = -0.28  # an action camera
UNCALIBRATED, CALIBRATED = msgspec.structs.replace(CAMERA, focal_sigma=0.1), CAMERA
DOWN = np.diag([1.0, -1.0, -1.0])


def test_undistortion_inverts_distortion() -> None:
    xy = np.random.default_rng(1).uniform(-0.9, 0.9, (50, 2))
    for k1 in (-0.35, -0.05, 0.1):
        assert np.allclose(undistort_division(distort_division(xy, k1), k1), xy)
    near = 0.01 * xy
    assert np.allclose(
        distort_division(near, ACTION_CAMERA_K1),
        near * (1.0 + ACTION_CAMERA_K1 * np.sum(near**2, axis=1, keepdims=True)),
        atol=1e-9,
    )


@pytest.mark.parametrize("distortion", [(), (-0.1, 0.02, 0.0, 0.0)])
def test_projection_inverts_normalisation_with_a_radial_coefficient(distortion: tuple[float, ...]) -> None:
    camera = CameraCalibration(960, 540, 560.0, 560.0, 479.5, 269.5, distortion, -0.1)
    px = np.array([[30.0, 20.0], [480.0, 270.0], [900.0, 500.0]])
    rays = np.column_stack([camera.normalise(px), np.ones(3)])
    assert np.allclose(camera.project(2.0 * rays), px, atol=0.01)
    assert camera.scaled(0.5).radial_k1 == camera.radial_k1


def test_orthorectification_uses_the_radial_coefficient() -> None:
    camera = CameraCalibration(960, 540, 560.0, 560.0, 479.5, 269.5, (), ACTION_CAMERA_K1)
    across = np.tile(np.linspace(0, 255, 960, dtype=np.float32)[None, :, None], (540, 1, 3)).astype(np.uint8)
    flat = rectify(across, camera, DOWN, 100.0, 1.0)
    assert flat is not None
    row, column = flat.image.shape[0] // 2, flat.image.shape[1] // 2 + 60
    ground = np.array([flat.e_min_m + column + 0.5, flat.n_max_m - row - 0.5, -100.0])
    x, y = camera.project((ground @ DOWN)[None])[0]
    assert flat.mask[row, column]
    assert abs(float(flat.image[row, column, 0]) - float(across[round(y), round(x), 0])) < 2.0


def seen_through(k1: float, aside_m: float) -> MapMatch:
    """PnP pose from 100 m of ground beside the nadir, with a distortion that is neglected."""
    ground = np.random.default_rng(2).uniform((aside_m - 40.0, -40.0), (aside_m + 40.0, 40.0), (40, 2))
    points = np.column_stack([ground, np.zeros(40)])
    xy = distort_division(np.column_stack([ground[:, 0], -ground[:, 1]]) / 100.0, k1)
    fit = fit_pose(points, xy, DOWN, np.array([0.0, 0.0, 100.0]), 1e-3)
    assert fit is not None
    p = fit.p_c_in_w_m
    return MapMatch(
        t_ns=0,
        frame_id=0,
        verdict=Verdict.ACCEPTED,
        matcher="gradient",
        matches=[(float(a), float(b), float(c), float(d), 0.0, 1.0) for (a, b), (c, d) in zip(xy, ground, strict=True)],
        pose=MapPose(
            p_c_in_w_m=(float(p[0]), float(p[1]), float(p[2])),
            q_w_c=quat_from_rot(fit.r_w_c),
            cov=tuple(np.eye(6).ravel()),
        ),
    )


@pytest.mark.parametrize("aside_m", [0.0, 45.0])
def test_the_jacobian_of_a_map_pose_by_the_radial_coefficient_corrects_it(aside_m: float) -> None:
    k1 = -0.03
    match = seen_through(k1, aside_m)
    assert match.pose is not None
    wrong_m = float(np.linalg.norm(np.array(match.pose.p_c_in_w_m) - (0.0, 0.0, 100.0)))
    by_k1 = moved_by_k1(match)
    assert by_k1 is not None
    pose = gtsam.Pose3(gtsam.Rot3(rot_from_quat(match.pose.q_w_c)), np.array(match.pose.p_c_in_w_m))
    corrected = pose.retract(by_k1 * k1).translation()
    assert float(np.linalg.norm(corrected - (0.0, 0.0, 100.0))) < 0.25 * wrong_m
    assert moved_by_k1(msgspec.structs.replace(match, matches=[])) is None


def test_the_lens_uncertainty_of_map_poses_does_not_average_out() -> None:
    pose, by_k1 = gtsam.Pose3(gtsam.Rot3(DOWN), np.array([0.0, 0.0, 100.0])), np.zeros(6)
    by_k1[3] = 50.0  # m per unit of the radial coefficient
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(
        gtsam.PriorFactorVector(
            B(0), np.zeros(CALIBRATION_SIZE), gtsam.noiseModel.Isotropic.Sigma(CALIBRATION_SIZE, 0.15)
        )
    )
    for _ in range(100):
        graph.add(map_pose_factor(C(0), B(0), pose, np.eye(6), by_k1, 0.0))
    values.insert(C(0), pose)
    values.insert(B(0), np.zeros(CALIBRATION_SIZE))
    sigmas_m = np.sqrt(np.diag(gtsam.Marginals(graph, values).marginalCovariance(C(0))))
    assert sigmas_m[3] == pytest.approx(0.15 * 50.0, rel=0.05)
    assert sigmas_m[4] == pytest.approx(0.1, rel=0.05)


def test_an_undescribed_lens_is_estimated_within_a_few_frames() -> None:
    flight, run = Flight(24, seed=3), EstimatorRun()
    published: list[Message] = []
    published += run.node.on(msgspec.structs.replace(ORIGIN, camera=UNCALIBRATED))
    for i in range(flight.frames):
        for message in flight.messages(i):
            published += run.node.on(with_distortion(message, ACTION_CAMERA_K1))
    published_k1 = [m.radial_k1 for m in published if isinstance(m, Prediction)]
    assert published_k1[0] == 0.0
    assert published_k1[-1] == pytest.approx(ACTION_CAMERA_K1, abs=0.04)
    learnt = [m for m in published if isinstance(m, CalibrationEstimate)][-1]
    assert abs(learnt.state[RADIAL_K1] - ACTION_CAMERA_K1) < 3.0 * np.sqrt(
        learnt.cov[RADIAL_K1 * CALIBRATION_SIZE + RADIAL_K1]
    )
    words = lens_words(UNCALIBRATED, learnt)
    assert words is not None and "k1 = -0.2" in words and "distortion = [-0.2" in words and "focal_sigma = 0.1" in words
    stated = msgspec.structs.replace(UNCALIBRATED, distortion=(-0.1, 0.0, 0.0, 0.0))
    assert "calibrate it again" in (lens_words(stated, learnt) or "")
    straight = msgspec.structs.replace(learnt, state=(*learnt.state[:RADIAL_K1], -0.01, learnt.state[RADIAL_K1 + 1]))
    assert lens_words(UNCALIBRATED, straight) is None


def test_a_described_calibration_has_a_smaller_position_sigma() -> None:
    stated = msgspec.structs.replace(CAMERA, distortion=(-0.28, 0.09, 0.0, 0.0))
    assert radial_k1_sigma(stated) == radial_k1_sigma(CALIBRATED) < radial_k1_sigma(UNCALIBRATED)
    assert principal_point_sigma(stated) == principal_point_sigma(CALIBRATED) == 0.0
    # A description with the coefficient of a flight has no better focal length and principal point.
    learnt = msgspec.structs.replace(UNCALIBRATED, distortion=stated.distortion)
    assert radial_k1_sigma(learnt) == radial_k1_sigma(stated) and principal_point_sigma(
        learnt
    ) == principal_point_sigma(UNCALIBRATED)
    flight = Flight(12, seed=3)
    claimed = []
    for camera in (CALIBRATED, UNCALIBRATED):
        run = EstimatorRun()
        published = list(run.node.on(msgspec.structs.replace(ORIGIN, camera=camera)))
        for i in range(flight.frames):
            for message in flight.messages(i):
                published += run.node.on(message)
        newest = [m for m in published if isinstance(m, NavEstimate)][-1]
        claimed.append(newest.cov[0])
        height_m = newest.agl_m
    assert claimed[1] > claimed[0] + 0.9 * (principal_point_sigma(UNCALIBRATED) * height_m) ** 2
