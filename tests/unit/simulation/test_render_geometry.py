"""The rendered frame against an independent projection of points on the ground."""

import math

import cv2
import numpy as np
import pytest
from pyproj import CRS, Transformer
from rasterio.transform import Affine

from terrafix import messages as m
from terrafix.core.geodesy import LocalFrame
from terrafix_lab.sim.camera.render import Film, Renderer, drape

UTM = 32633
WEST_M, NORTH_M, GSD_M = 452_000.0, 5_333_000.0, 0.5
SIZE_PX = 1600
POST_M = 10.0
ORIGIN = LocalFrame(48.1445, 14.3590)  # inside the image; grid north is half a degree off true north here
PLAIN = Film(noise=0.0, vignette=0.0, blur_px=0.0, exposure_jitter=0.0, detail=0.0)
PINHOLE = m.Camera(width=960, height=540, fx=560.0, fy=560.0, cx=479.5, cy=269.5)
WIDE = m.Camera(width=960, height=540, fx=520.0, fy=525.0, cx=470.0, cy=275.0, distortion=(-0.12, 0.03, 0.001, -0.0008))


def hills(east_m: np.ndarray, north_m: np.ndarray) -> np.ndarray:
    """Ground AMSL as a function of UTM: 30 m of relief."""
    return 300.0 + 15.0 * np.sin((east_m - WEST_M) / 90.0) * np.cos((north_m - NORTH_M) / 110.0)


def flat(east_m: np.ndarray, north_m: np.ndarray) -> np.ndarray:
    return 300.0 + 0.0 * (east_m + north_m)


def dots() -> np.ndarray:
    """Pixels (N, 2) of white dots on black, far apart."""
    rng = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(np.arange(40, SIZE_PX - 40, 45), np.arange(40, SIZE_PX - 40, 45)), axis=-1)
    return grid.reshape(-1, 2) + rng.uniform(-8.0, 8.0, (grid.size // 2, 2))


def painted(px: np.ndarray) -> np.ndarray:
    image = np.zeros((SIZE_PX, SIZE_PX), np.float32)
    for x, y in px:
        cx, cy = round(float(x)), round(float(y))
        yy, xx = np.mgrid[cy - 6 : cy + 7, cx - 6 : cx + 7]
        image[cy - 6 : cy + 7, cx - 6 : cx + 7] += 250.0 * np.exp(-((xx - x) ** 2 + (yy - y) ** 2) / 4.5)
    return cv2.merge([np.round(image).clip(0, 255).astype(np.uint8)] * 3)


def rotation(yaw_deg: float, pitch_deg: float, roll_deg: float) -> np.ndarray:
    """R_w_c of a nadir camera with its top forward, body angles Z-Y-X, implemented independently."""
    y, p, r = (math.radians(v) for v in (yaw_deg, pitch_deg, roll_deg))
    rz = np.array([[math.cos(y), -math.sin(y), 0], [math.sin(y), math.cos(y), 0], [0, 0, 1]])
    ry = np.array([[math.cos(p), 0, math.sin(p)], [0, 1, 0], [-math.sin(p), 0, math.cos(p)]])
    rx = np.array([[1, 0, 0], [0, math.cos(r), -math.sin(r)], [0, math.sin(r), math.cos(r)]])
    body_from_camera = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])  # right is y, image down is backward
    enu_from_ned = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    return enu_from_ned @ rz @ ry @ rx @ body_from_camera


def projected(camera: m.Camera, p_c: np.ndarray, r_w_c: np.ndarray, points: np.ndarray) -> np.ndarray:
    """World points (N, 3) -> pixels (N, 2); NaN behind the camera."""
    in_c = (points - p_c) @ r_w_c
    x, y = in_c[:, 0] / in_c[:, 2], in_c[:, 1] / in_c[:, 2]
    k1, k2, p1, p2 = camera.distortion or (0.0, 0.0, 0.0, 0.0)
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    px = np.column_stack([camera.fx * xd + camera.cx, camera.fy * yd + camera.cy])
    px[(in_c[:, 2] < 1.0) | (r2 > 2.0)] = np.nan
    return px


@pytest.mark.parametrize("camera", [PINHOLE, WIDE], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("terrain", [flat, hills])
@pytest.mark.parametrize(("yaw", "pitch", "roll"), [(0.0, 0.0, 0.0), (37.0, 3.0, 0.0), (-120.0, -4.0, 26.0)])
def test_points_on_the_ground_appear_at_their_projection(
    camera: m.Camera, terrain: object, yaw: float, pitch: float, roll: float
) -> None:
    assert callable(terrain)
    px = dots()
    east, north = WEST_M + (px[:, 0] + 0.5) * GSD_M, NORTH_M - (px[:, 1] + 0.5) * GSD_M
    posts = np.arange(-300.0, 1110.0, POST_M)
    dem = terrain(WEST_M + posts[None, :], NORTH_M - posts[:, None]).astype(np.float32)
    crs_from_dem = Affine(POST_M, 0, WEST_M - 300.0 - POST_M / 2, 0, -POST_M, NORTH_M + 300.0 + POST_M / 2)
    crs = CRS.from_epsg(UTM)
    ground = drape(painted(px), Affine(GSD_M, 0, WEST_M, 0, -GSD_M, NORTH_M), dem, crs_from_dem, crs, ORIGIN)
    lon, lat = Transformer.from_crs(crs, CRS.from_epsg(4326), always_xy=True).transform(east, north)
    local = np.array([ORIGIN.to_local(float(a), float(o)) for a, o in zip(lat, lon, strict=True)])
    points = np.column_stack([local, terrain(east, north)])

    p_c, r_w_c = np.array([12.0, -20.0, 300.0 + 140.0]), rotation(yaw, pitch, roll)
    frame = Renderer(ground, camera, film=PLAIN).frame(p_c, r_w_c, 0)[..., 0].astype(np.float64)
    expected = projected(camera, p_c, r_w_c, points)
    errors = []
    for x, y in expected:
        if not (20 < x < camera.width - 20 and 20 < y < camera.height - 20):
            continue
        cx, cy = round(float(x)), round(float(y))
        patch = np.maximum(frame[cy - 9 : cy + 10, cx - 9 : cx + 10] - 20.0, 0.0)
        assert patch.sum() > 500.0, "no dot where one must be"
        yy, xx = np.mgrid[-9:10, -9:10]
        seen = np.array([(patch * xx).sum(), (patch * yy).sum()]) / patch.sum() + (cx, cy)
        errors.append(np.hypot(*(seen - (x, y))))
    assert len(errors) > 40
    assert float(np.median(errors)) < 0.2
    assert float(np.quantile(errors, 0.98)) < 0.5


def test_a_frame_is_a_function_of_pose_index_and_seed() -> None:
    rng = np.random.default_rng(1)
    image = rng.integers(0, 255, (400, 400, 3), dtype=np.uint8)
    dem = np.full((40, 40), 300.0, np.float32)
    corner = Affine(GSD_M, 0, WEST_M, 0, -GSD_M, NORTH_M)
    crs = CRS.from_epsg(UTM)
    ground = drape(image, corner, dem, Affine(POST_M, 0, WEST_M, 0, -POST_M, NORTH_M), crs, ORIGIN)
    pose = np.array([0.0, 0.0, 420.0]), rotation(10.0, 0.0, 5.0)
    first, same, later = Renderer(ground, PINHOLE, seed=4), Renderer(ground, PINHOLE, seed=4), 8
    later_frame = first.frame(*pose, later)
    assert np.array_equal(first.frame(*pose, 3), same.frame(*pose, 3))
    assert np.array_equal(later_frame, same.frame(*pose, later))
    assert not np.array_equal(later_frame, first.frame(*pose, 3))
