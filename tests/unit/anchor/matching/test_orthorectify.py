"""Orthorectification: alignment with the map to a fraction of a pixel for several attitudes and lenses."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from terrafix.anchor.matching.orthorectify import footprint, patch_centres, rectify
from terrafix.core.camera import CameraCalibration, Readout
from textured_ground import LENS, PINHOLE, FlatMap, rotation, texture, view

GSD_M = 0.5
ATTITUDES = [(0.0, 0.0, 0.0), (137.0, 0.0, 0.0), (20.0, 12.0, -9.0), (-75.0, -6.0, 15.0)]
IN_A_TURN, SLOPE, LEVEL = (50.0, 3.0, 40.0), (0.2, -0.1), (0.0, 0.0)


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return texture(6, 460.0)


@pytest.mark.parametrize("rolling", [False, True])
@pytest.mark.parametrize("camera", [PINHOLE, LENS])
@pytest.mark.parametrize(("attitude", "slope"), [*((one, LEVEL) for one in ATTITUDES), (IN_A_TURN, SLOPE)])
def test_the_orthorectified_frame_is_aligned_with_the_map(
    ground: np.ndarray,
    camera: CameraCalibration,
    attitude: tuple[float, ...],
    slope: tuple[float, float],
    rolling: bool,
) -> None:
    r, p = rotation(*attitude), np.array([14.3, -22.7, 90.0])
    relief = None if slope == LEVEL else lambda points_m: points_m @ slope
    above_m = np.array([0.0, 0.0, np.dot(slope, p[:2])])
    if rolling:
        moved = np.array([0.4, 0.3, -0.5]), r.T @ np.array([15.0, 5.0, 0.0]) / 90.0
        camera = replace(camera, readout=Readout(0.05 / 359, 179.5, *moved, -r[2]))
    flat = rectify(view(ground, camera, r, p + above_m, slope), camera, r, 90.0, GSD_M, relief=relief)
    assert flat is not None
    h, w = flat.mask.shape
    shown, valid = FlatMap(ground).window(p[0] + flat.e_min_m, p[1] + flat.n_max_m, w, h, GSD_M)
    assert valid.all()
    inner = cv2.erode(flat.mask.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    shifts = []
    for y in range(0, h - 64, 48):
        for x in range(0, w - 64, 48):
            tile = np.s_[y : y + 64, x : x + 64]
            if inner[tile].all():
                mine, theirs = (
                    cv2.cvtColor(i[tile], cv2.COLOR_BGR2GRAY).astype(np.float64) for i in (flat.image, shown)
                )
                shift, response = cv2.phaseCorrelate(mine - mine.mean(), theirs - theirs.mean())
                if response > 0.2:
                    shifts.append(shift)
    assert len(shifts) >= 4
    assert np.linalg.norm(np.median(shifts, axis=0)) < 0.15
    assert np.median(np.linalg.norm(shifts, axis=1)) < 0.5
    difference = np.abs(flat.image.astype(float) - shown)[inner].mean()
    assert difference < 6.0  # grey levels, for an image with a contrast of 50


def test_the_mask_covers_the_visible_ground(ground: np.ndarray) -> None:
    r, p = rotation(45.0), np.array([0.0, 0.0, 90.0])
    flat = rectify(view(ground, PINHOLE, r, p), PINHOLE, r, 90.0, GSD_M)
    assert flat is not None
    seen_m2 = flat.mask.sum() * GSD_M**2
    true_m2 = (PINHOLE.width - 1) * (PINHOLE.height - 1) * (90.0 / PINHOLE.fx) ** 2
    assert seen_m2 == pytest.approx(true_m2, rel=0.02)
    # the corners of the bounding box lie outside of a rotated frame
    assert not flat.mask[0, 0] and not flat.mask[-1, -1]


@pytest.mark.parametrize("stride", [1, 8])
def test_sides_are_multiples_of_the_stride(ground: np.ndarray, stride: int) -> None:
    r = rotation(10.0)
    flat = rectify(view(ground, PINHOLE, r, np.array([0.0, 0.0, 90.0])), PINHOLE, r, 90.0, GSD_M, stride)
    assert flat is not None
    assert flat.image.shape[:2] == flat.mask.shape and not any(s % stride for s in flat.mask.shape)


def test_the_footprint_is_that_of_a_pinhole() -> None:
    e_min, n_min, e_max, n_max = footprint(PINHOLE, rotation(0.0), 100.0) or (0.0,) * 4
    assert (e_min, e_max) == pytest.approx((-319.5 / 3.8, 319.5 / 3.8))
    assert (n_min, n_max) == pytest.approx((-179.5 / 3.8, 179.5 / 3.8))


@pytest.mark.parametrize("pitch_deg", [80.0, 120.0, 180.0])
def test_without_visible_ground_the_result_is_none(pitch_deg: float) -> None:
    image = np.zeros((PINHOLE.height, PINHOLE.width, 3), np.uint8)
    assert footprint(PINHOLE, rotation(0.0, pitch_deg), 100.0) is None
    assert rectify(image, PINHOLE, rotation(0.0, pitch_deg), 100.0, GSD_M) is None


def test_an_oblique_view_has_a_bounded_footprint() -> None:
    image = np.full((PINHOLE.height, PINHOLE.width, 3), 128, np.uint8)
    flat = rectify(image, PINHOLE, rotation(0.0, 60.0), 100.0, GSD_M)
    assert flat is not None
    assert max(flat.mask.shape) <= 2 * 1.6 * 100.0 / GSD_M + 1


@pytest.mark.parametrize("attitude", ATTITUDES)
def test_the_lens_between_the_evaluated_pixels_is_interpolated_to_a_twentieth_of_a_pixel(
    attitude: tuple[float, ...],
) -> None:
    camera = CameraCalibration(1280, 720, 760.0, 760.0, 640.0, 360.0, radial_k1=-0.2)
    columns, rows = np.meshgrid(np.arange(1280, dtype=np.float32), np.arange(720, dtype=np.float32))
    gsd_m, agl_m, r_w_c = 0.9, 90.0, rotation(*attitude)
    where = [rectify(pixels, camera, r_w_c, agl_m, gsd_m) for pixels in (columns, rows)]
    shown = where[0]
    assert shown is not None and where[1] is not None
    h, w = shown.mask.shape
    x, y = np.meshgrid(np.arange(w), np.arange(h))
    ground = np.column_stack([shown.e_min_m + (x.ravel() + 0.5) * gsd_m, shown.n_max_m - (y.ravel() + 0.5) * gsd_m])
    px = camera.project(np.column_stack([ground, np.full(w * h, -agl_m)]) @ r_w_c).reshape(h, w, 2)
    inner = cv2.erode(shown.mask.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    off_px = np.hypot(shown.image - px[..., 0], where[1].image - px[..., 1])[inner]
    assert inner.sum() > 2000
    assert off_px.max() * (agl_m / camera.fx) / gsd_m < 0.05


def test_ground_behind_the_camera_is_not_inside_of_the_frame() -> None:
    tilted = rotation(0.0, -60.0, -50.0)  # a corner of the bounding box of its ground lies behind it
    flat = rectify(np.full((360, 640, 3), 200, np.uint8), LENS, tilted, 90.0, 2.0)
    assert flat is not None
    h, w = flat.mask.shape
    x, y = np.meshgrid(np.arange(w), np.arange(h))
    ground = np.column_stack([flat.e_min_m + (x.ravel() + 0.5) * 2.0, flat.n_max_m - (y.ravel() + 0.5) * 2.0])
    depth = (np.column_stack([ground, np.full(w * h, -90.0)]) @ tilted)[:, 2].reshape(h, w)
    assert (depth <= 0).any() and not flat.mask[depth <= 0].any()
    assert flat.mask.any()


@pytest.mark.parametrize("camera", [PINHOLE, LENS])
def test_patches_are_at_the_same_points_of_the_image_whatever_the_pose(camera: CameraCalibration) -> None:
    """Those of a grid that begins at the border of the rectified frame moved with height and attitude."""
    grey = np.zeros((camera.height, camera.width), np.uint8)
    seen = []
    for attitude, agl_m in (((20.0, 0.0, 0.0), 90.0), ((21.0, 1.0, -2.0), 97.0)):
        r = rotation(*attitude)
        frame = rectify(grey, camera, r, agl_m, GSD_M)
        assert frame is not None
        cells = patch_centres(camera, r, agl_m, frame, GSD_M, 0.125)
        ground_m = np.array([frame.e_min_m, frame.n_max_m]) + cells[:, ::-1] * (GSD_M, -GSD_M)
        rays = np.column_stack([ground_m, np.full(len(cells), -agl_m)]) @ r
        seen.append(rays[:, :2] / rays[:, 2:])
    assert len(seen[0]) >= 20
    assert seen[0] == pytest.approx(seen[1], abs=1e-9)
    assert seen[0] / 0.125 == pytest.approx(np.rint(seen[0] / 0.125), abs=1e-9)
