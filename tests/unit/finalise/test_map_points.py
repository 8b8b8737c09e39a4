"""2D-3D matches of a map match as observations of the pose, the lens and the map."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from terrafix.core.geodesy import quat_from_rot
from terrafix.core.pnp import outlier_inflation, random_inlier_probability, solved
from terrafix.core.pose import exp_so3, project_with_jacobian
from terrafix.estimator.models.terrain import Terrain
from terrafix.messages import MapMatch, PnpInput, Verdict
from terrafix_tools.finalise.lens import Lens, as_described
from terrafix_tools.finalise.map_points import FOCAL, K1, POSE, ROWS, MatchedPoints

LENS = Lens(k1=-0.04, log_focal=0.05)
HEIGHT_M, NOISE = 100.0, 5e-4
DOWN = np.diag([1.0, -1.0, -1.0])
R_W_C = DOWN @ exp_so3(np.array([0.15, -0.1, 0.4]))
P_M = np.array([3.0, -2.0, HEIGHT_M])


def matched(seed: int = 1, *, wrong: int = 0, points: int = 40, roofs_m: float = 1.0) -> MatchedPoints:
    """Points over relief of 6 m (1-sigma), seen through LENS and normalised by the description; the first ``wrong`` of
    them are elsewhere. PnP's pose is off, as through the described lens."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-60, 60, 400), rng.uniform(-40, 40, 400), rng.normal(0.0, 6.0, 400)])
    in_c = (ground - P_M) @ R_W_C
    rays = in_c[:, :2] / in_c[:, 2:]
    inside = np.flatnonzero((np.abs(rays) < (0.7, 0.45)).all(axis=1))[:points]
    ground, rays = ground[inside], rays[inside] + NOISE * rng.normal(size=(points, 2))
    ground[:wrong, 0] += 15.0
    described = as_described(rays, LENS.k1) * np.exp(LENS.log_focal)
    given = PnpInput(
        q_w_c=quat_from_rot(R_W_C), agl_m=HEIGHT_M, sigma_floor=NOISE, threshold=0.03, search_radius=0.08, min_inliers=8
    )
    off = R_W_C @ exp_so3(np.array([0.01, -0.01, 0.01])), P_M - (1.0, -1.0, 5.0)
    return MatchedPoints(
        described, ground, np.ones(points), given, *off, k1=0.0, local_m=0.5, roofs_m=roofs_m, slope=0.01
    )


def test_the_points_give_the_pose_through_the_true_lens_and_their_heights() -> None:
    """With all heights at one level the pose would be metres off: the relief is 6 m."""
    fit = matched().fit(LENS)
    assert fit is not None and fit.inliers.all()
    assert np.linalg.norm(fit.p_m - P_M) < 0.5
    assert float(np.linalg.norm(fit.residual, axis=1).mean()) < 2.0 * NOISE
    described = matched().fit(Lens())
    assert described is not None
    assert float(np.linalg.norm(described.residual, axis=1).mean()) > 3.0 * NOISE
    assert described.p_m[2] < P_M[2] - 3.0  # seen through a shorter focal length, the ground looks nearer


def test_a_match_keeps_the_heights_of_its_points_and_the_rays_of_the_description() -> None:
    """As received, with rays undistorted in flight by another coefficient than the true one, and a wrong point."""
    points, in_flight = matched(wrong=1), Lens(k1=-0.03)
    rows = np.column_stack([in_flight.rays(points.xy), points.points_m, points.weights]).tolist()
    received = MapMatch(
        t_ns=0, frame_id=0, verdict=Verdict.ACCEPTED, matcher="gradient", matches=[tuple(row) for row in rows],
        pnp=points.given, radial_k1=in_flight.k1, map_sigma_m=3.0,
    )  # fmt: skip
    kept = MatchedPoints.of(received, solved(received), Terrain(0.0))
    assert kept is not None and len(kept.xy) == len(points.xy)  # also those that PnP rejects
    assert kept.points_m == pytest.approx(points.points_m) and np.ptp(kept.points_m[:, 2]) > 15.0
    assert kept.xy == pytest.approx(points.xy, abs=1e-9)
    assert kept.local_m == pytest.approx(0.99) and kept.roofs_m == pytest.approx(0.03 * kept.p_m[2])
    assert MatchedPoints.of(msgspec.structs.replace(received, pnp=None), solved(received), Terrain(0.0)) is None


def test_wrong_points_are_left_out_and_widen_the_pose_and_too_few_give_none() -> None:
    points = replace(matched(wrong=9), local_m=0.0, roofs_m=0.0, slope=0.0)
    right = replace(points, xy=points.xy[9:], points_m=points.points_m[9:], weights=points.weights[9:])
    fit, alone = points.fit(LENS), right.fit(LENS)
    assert fit is not None and not fit.inliers[:9].any() and fit.inliers[9:].all()
    assert alone is not None and np.linalg.norm(fit.p_m - P_M) < 0.5
    more, less = (np.trace(rows.T @ rows) for rows in (right.rows(alone).rows, points.rows(fit).rows))
    assert more / less == pytest.approx(outlier_inflation(40, 31, random_inlier_probability(points.given)), rel=0.01)
    assert matched(points=7).fit(LENS) is None


def test_the_rows_predict_how_the_pose_changes_with_the_lens() -> None:
    points, change = replace(matched(), local_m=0.0, roofs_m=0.0, slope=0.0), (0.002, 0.004)
    fit, other = points.fit(LENS), points.fit(Lens(LENS.k1 + change[0], LENS.log_focal + change[1]))
    assert fit is not None and other is not None
    rows = points.rows(fit).rows
    assert rows.shape == (ROWS, 9) and np.abs(rows[:, -1]).max() < 1.0  # at its own fit
    predicted = -np.linalg.solve(rows[:, POSE], rows[:, K1] * change[0] + rows[:, FOCAL] * change[1])
    moved = np.concatenate([np.zeros(3), fit.r_w_c.T @ (other.p_m - fit.p_m)])
    assert predicted[5] == pytest.approx(moved[5], abs=0.08) and abs(moved[5]) > 0.3


def test_a_slope_of_the_ground_moves_no_point_below_the_camera() -> None:
    points = matched()
    fit = points.fit(LENS)
    assert fit is not None
    ground = fit.p_m * (1.0, 1.0, 0.0) + np.array([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0]])
    _, by_pose, _ = project_with_jacobian(fit.r_w_c, fit.p_m, ground)
    below, aside = np.abs(points._common(by_pose, ground, fit)[:, -2:]).reshape(2, -1).max(axis=1)
    assert below == 0.0 < aside


def test_what_the_points_have_in_common_widens_the_pose() -> None:
    """Roofs above the map's ground by 5 m (1-sigma) leave the height of the camera as uncertain."""
    sigmas = []
    for roofs_m in (0.01, 5.0):
        points = matched(roofs_m=roofs_m)
        fit = points.fit(LENS)
        assert fit is not None
        rows = points.rows(fit).rows[:, POSE]
        cov = np.linalg.inv(rows.T @ rows)[3:, 3:]
        sigmas.append(float(np.sqrt((fit.r_w_c @ cov @ fit.r_w_c.T)[2, 2])))
    assert sigmas[0] < 1.5 and sigmas[1] == pytest.approx(5.0, rel=0.15)


def test_the_lens_undoes_the_description() -> None:
    rays = np.array([[0.5, -0.3], [0.0, 0.2]])
    assert LENS.rays(as_described(rays, LENS.k1) * np.exp(LENS.log_focal)) == pytest.approx(rays)
