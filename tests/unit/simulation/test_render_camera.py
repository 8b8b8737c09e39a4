"""Fisheye, rolling shutter, ridges and weather, each against an independent computation."""

import math

import cv2
import numpy as np
import pytest
from pyproj import CRS
from rasterio.transform import Affine

from terrafix import messages as m
from terrafix.core.camera import Mount
from terrafix.core.geodesy import LocalFrame
from terrafix_lab.sim.camera.lens import Fisheye
from terrafix_lab.sim.camera.mount import CameraMotion, Fixed, Gimbal
from terrafix_lab.sim.camera.render import Film, Renderer
from terrafix_lab.sim.camera.weather import Weather
from terrafix_lab.sim.ground.draped_image import Ground, drape
from terrafix_lab.sim.interfaces import State

FRAME = LocalFrame(48.0, 15.0)  # on the central meridian of UTM 33
PLAIN = Film(noise=0.0, vignette=0.0, blur_px=0.0, exposure_jitter=0.0, detail=0.0)
CAMERA = m.Camera(width=960, height=540, fx=560.0, fy=560.0, cx=479.5, cy=269.5)
LENS = Fisheye(800, 800, 260.0, 262.0, 401.0, 398.0, (0.03, -0.006, 0.001, -0.0002))
SIZE_PX, GSD_M = 2000, 0.4
DOWN = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])  # R_w_c: image top north


def local_crs() -> CRS:
    return CRS.from_proj4("+proj=tmerc +lat_0=48 +lon_0=15 +k=1 +datum=WGS84 +units=m")


def dotted(places_m: np.ndarray) -> np.ndarray:
    """White dots of 0.8 m at local positions (N, 2) on black; the image centre is the origin."""
    image = np.zeros((SIZE_PX, SIZE_PX), np.float32)
    for e_m, n_m in places_m:
        x, y = SIZE_PX / 2 + e_m / GSD_M - 0.5, SIZE_PX / 2 - n_m / GSD_M - 0.5
        cx, cy = round(float(x)), round(float(y))
        yy, xx = np.mgrid[cy - 8 : cy + 9, cx - 8 : cx + 9]
        image[cy - 8 : cy + 9, cx - 8 : cx + 9] += 250.0 * np.exp(-((xx - x) ** 2 + (yy - y) ** 2) / 8.0)
    return cv2.merge([np.round(image).clip(0, 255).astype(np.uint8)] * 3)


def ground_of(image: np.ndarray, height: object, post_m: float) -> Ground:
    """Ground with ``height(e, n)`` on posts every ``post_m``."""
    assert callable(height)
    posts = np.arange(-480.0, 480.0 + post_m / 2, post_m)
    dem = height(posts[None, :], -posts[:, None]) + np.zeros((len(posts), len(posts)))
    half = SIZE_PX * GSD_M / 2
    from_dem = Affine(post_m, 0, -480.0 - post_m / 2, 0, -post_m, 480.0 + post_m / 2)
    return drape(image, Affine(GSD_M, 0, -half, 0, -GSD_M, half), dem, from_dem, local_crs(), FRAME)


def lattice(step_m: float = 24.0) -> np.ndarray:
    ticks = np.arange(-340.0, 341.0, step_m)
    grid = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    return grid + np.random.default_rng(5).uniform(-5.0, 5.0, grid.shape)


def hills(e_m: np.ndarray, n_m: np.ndarray) -> np.ndarray:
    return 200.0 + 14.0 * np.sin(e_m / 80.0) * np.cos(n_m / 95.0)


def dot_at(frame: np.ndarray, place: np.ndarray, reach: int = 7) -> np.ndarray | None:
    """Centroid (x, y) of the dot near a pixel; None if there is none."""
    cx, cy = round(float(place[0])), round(float(place[1]))
    patch = np.maximum(frame[cy - reach : cy + reach + 1, cx - reach : cx + reach + 1].astype(float) - 15.0, 0.0)
    if patch.sum() < 300.0:
        return None
    yy, xx = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return np.array([(patch * xx).sum(), (patch * yy).sum()]) / patch.sum() + (cx, cy)


def fisheye_px(in_c: np.ndarray) -> np.ndarray:
    """Kannala-Brandt by OpenCV's own implementation."""
    k = np.array([[LENS.fx, 0, LENS.cx], [0, LENS.fy, LENS.cy], [0, 0, 1.0]])
    points = np.ascontiguousarray(in_c / in_c[:, 2:]).reshape(-1, 1, 3)
    px, _ = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), k, np.array(LENS.distortion))
    return px.reshape(-1, 2)


def test_fisheye_rays_and_pixels_are_those_of_opencv() -> None:
    px = np.random.default_rng(1).uniform(100.0, 700.0, (500, 2))
    rays = LENS.rays(px)
    assert np.allclose(np.linalg.norm(rays, axis=1), 1.0)
    assert np.abs(fisheye_px(rays) - px).max() < 1e-6
    assert np.abs(LENS.project(rays * 7.0) - px).max() < 1e-6


@pytest.mark.slow
def test_dots_on_hills_appear_at_their_fisheye_projection() -> None:
    places = lattice()
    ground = ground_of(dotted(places), hills, 8.0)
    p_c, r_w_c = np.array([10.0, -15.0, 290.0]), DOWN @ cv2.Rodrigues(np.array([0.12, -0.08, 0.5]))[0]
    frame = Renderer(ground, LENS, film=PLAIN).frame(p_c, r_w_c, 0)[..., 0]
    points = np.column_stack([places, hills(places[:, 0], places[:, 1])])
    expected = fisheye_px((points - p_c) @ r_w_c)
    inside = (np.hypot(*(expected - 400.0).T) < 250.0).nonzero()[0]  # farther out a dot is less than a pixel
    seen = [(dot_at(frame, expected[i], 5), expected[i]) for i in inside]
    errors = [float(np.hypot(*(at - place))) for at, place in seen if at is not None]
    assert len(errors) > 0.9 * len(inside) and len(errors) > 80
    assert float(np.median(errors)) < 0.25 and float(np.quantile(errors, 0.95)) < 0.6


def test_a_rolling_shutter_renders_each_row_at_its_time() -> None:
    places = lattice()
    ground = ground_of(dotted(places), hills, 8.0)
    readout_s = 0.05
    film = Film(noise=0.0, vignette=0.0, blur_px=0.0, exposure_jitter=0.0, detail=0.0, readout_s=readout_s)
    velocity, rates = np.array([14.0, 20.0, -1.0]), np.array([0.3, -0.2, 0.6])
    p_c, r_w_c = np.array([0.0, 0.0, 320.0]), DOWN @ cv2.Rodrigues(np.array([0.05, 0.1, 0.4]))[0]
    frame = Renderer(ground, CAMERA, film=film).frame(p_c, r_w_c, 0, motion=CameraMotion(velocity, rates))[..., 0]
    errors, still = [], []
    for point in np.column_stack([places, hills(places[:, 0], places[:, 1])]):
        row = 269.5
        for _ in range(20):  # row and time depend on each other
            t_s = (row / 539.0 - 0.5) * readout_s
            turned = r_w_c @ cv2.Rodrigues(rates * t_s)[0]
            in_c = turned.T @ (point - p_c - velocity * t_s)
            x, row = CAMERA.fx * in_c[0] / in_c[2] + CAMERA.cx, CAMERA.fy * in_c[1] / in_c[2] + CAMERA.cy
        if not (15 < x < 945 and 15 < row < 525):
            continue
        at = dot_at(frame, np.array([x, row]))
        assert at is not None
        errors.append(float(np.hypot(*(at - (x, row)))))
        in_c = r_w_c.T @ (point - p_c)
        still.append(
            float(
                np.hypot(*(at - (CAMERA.fx * in_c[0] / in_c[2] + CAMERA.cx, CAMERA.fy * in_c[1] / in_c[2] + CAMERA.cy)))
            )
        )
    assert len(errors) > 30
    assert float(np.median(errors)) < 0.2 and max(errors) < 0.6
    assert max(still) > 4.0  # with a global shutter it would be elsewhere


def ridge(e_m: np.ndarray, n_m: np.ndarray) -> np.ndarray:
    """A wall of 90 m from west to east at n = 60 m; its slopes are 63 degrees steep."""
    return 100.0 + np.maximum(0.0, 90.0 - 2.0 * np.abs(n_m - 60.0)) + 0.0 * e_m


def test_a_ridge_occludes_the_ground_behind_it() -> None:
    places = lattice(16.0)
    ground = ground_of(dotted(places), ridge, 5.0)
    p_c = np.array([0.0, -120.0, 260.0])
    tilt = math.radians(-55.0)
    r_w_c = DOWN @ np.array([[1, 0, 0], [0, math.cos(tilt), math.sin(tilt)], [0, -math.sin(tilt), math.cos(tilt)]])
    assert (r_w_c @ (0.0, 0.0, 1.0))[1] > 0.5  # the camera looks north
    frame = Renderer(ground, CAMERA, film=PLAIN).frame(p_c, r_w_c, 0)[..., 0]
    points = np.column_stack([places, ridge(places[:, 0], places[:, 1])])
    in_c = (points - p_c) @ r_w_c
    px = in_c[:, :2] / in_c[:, 2:] * 560.0 + (479.5, 269.5)
    inside = (in_c[:, 2] > 1.0) & (np.abs(px - (479.5, 269.5)) < (460, 250)).all(axis=1)
    along = np.linspace(0.0, 0.995, 4000)[:, None]
    errors, hidden, wrong = [], 0, 0
    for i in np.flatnonzero(inside):
        line = p_c + along * (points[i] - p_c)
        clearance_m = float((line[:, 2] - ridge(line[:, 0], line[:, 1])).min())
        if np.sort(np.hypot(*(px[inside] - px[i]).T))[1] < 18.0:
            continue  # another dot would be in the patch
        at = dot_at(frame, px[i])
        if clearance_m > 0.5:
            assert at is not None
            errors.append(float(np.hypot(*(at - px[i]))))
        elif clearance_m < -5.0:
            hidden += 1
            wrong += at is not None
    assert len(errors) > 40 and hidden > 15
    assert float(np.median(errors)) < 0.35 and float(np.quantile(errors, 0.9)) < 1.0
    assert wrong == 0  # no dot behind the ridge is visible


@pytest.mark.slow
def test_haze_light_and_clouds_follow_their_formulas() -> None:
    image = np.full((SIZE_PX, SIZE_PX, 3), 100, np.uint8)

    def slope(e_m: np.ndarray, n_m: np.ndarray) -> np.ndarray:
        return 500.0 + 0.3 * e_m + 0.0 * n_m

    ground = ground_of(image, slope, 10.0)
    p_c = np.array([0.0, 0.0, 800.0])

    def mean(weather: Weather, t_s: float = 0.0) -> np.ndarray:
        frame = Renderer(ground, CAMERA, film=PLAIN, weather=weather).frame(p_c, DOWN, 0, t_s=t_s)
        return frame[200:340, 400:560].reshape(-1, 3).mean(axis=0)

    hazy = mean(Weather(visibility_m=2000.0))
    share = 1.0 - math.exp(-3.912 * 300.0 / 2000.0)
    assert hazy == pytest.approx(100 * (1 - share) + share * np.array([226, 214, 204]), abs=3.0)
    lit = mean(Weather(relight=True, sun_azimuth_deg=270.0, sun_elevation_deg=40.0))
    away = mean(Weather(relight=True, sun_azimuth_deg=90.0, sun_elevation_deg=40.0))
    assert lit[0] > 105.0 and away[0] < 80.0  # the slope falls to the west
    facing = (
        (math.sin(math.radians(40)) + 0.3 * math.cos(math.radians(40))) / math.sqrt(1.09) / math.sin(math.radians(40))
    )
    assert lit[0] == pytest.approx(100 * (0.35 + 0.65 * facing), abs=1.5)
    overcast = mean(Weather(cloud_cover=1.0, cloud_base_amsl_m=700.0, cloud_opacity=1.0))
    assert overcast.min() > 180.0
    broken = Weather(cloud_cover=0.5, cloud_base_amsl_m=2000.0, wind_enu_mps=(10.0, 0.0))
    assert 50.0 < mean(broken)[0] <= 100.0
    shades = {round(float(mean(broken, t_s)[0])) for t_s in (0.0, 30.0, 60.0, 120.0, 240.0)}
    assert len(shades) > 1  # shadows move


def state(roll_rad: float, rates: np.ndarray) -> State:
    return State(3.0, np.zeros(3), np.array([15.0, 0.0, 0.0]), 1.2, 0.1, roll_rad, 100.0, rates, np.zeros(3), 15.0)


def test_a_gimbal_is_stabilised_and_a_fixed_camera_is_not() -> None:
    banked = state(0.5, np.zeros(3))
    axis = Fixed().r_w_c(banked) @ (0.0, 0.0, 1.0)
    assert math.degrees(math.acos(-axis[2])) == pytest.approx(math.degrees(math.acos(math.cos(0.1) * math.cos(0.5))))
    held = Gimbal(error_deg=0.0).r_w_c(banked)
    assert held @ (0.0, 0.0, 1.0) == pytest.approx([0.0, 0.0, -1.0], abs=1e-12)
    assert held @ (0.0, -1.0, 0.0) == pytest.approx([math.sin(1.2), math.cos(1.2), 0.0], abs=1e-12)  # top: ahead
    oblique = Gimbal(Mount(pitch_deg=-45.0), error_deg=0.0).r_w_c(banked) @ (0.0, 0.0, 1.0)
    assert oblique[2] == pytest.approx(-math.sqrt(0.5))
    tilts = []
    for t_s in range(200):
        now = State(float(t_s), *[getattr(banked, f) for f in list(State.__dataclass_fields__)[1:]])
        tilts.append(math.degrees(math.acos(min(1.0, -float((Gimbal(error_deg=0.5).r_w_c(now) @ (0.0, 0.0, 1.0))[2])))))
    assert math.sqrt(float(np.mean(np.square(tilts))) / 2) == pytest.approx(0.5, rel=0.3)


@pytest.mark.parametrize("mount", [Fixed(Mount(pitch_deg=-70.0)), Gimbal(Mount(pitch_deg=-60.0), error_deg=0.0)])
def test_the_motion_of_the_camera_is_the_derivative_of_its_pose(mount: Fixed | Gimbal) -> None:
    rates = np.array([0.2, -0.1, 0.3])
    now = state(0.3, rates)
    dt_s = 1e-5
    turned = now.r_w_b() @ cv2.Rodrigues(rates * dt_s)[0]
    yaw = math.atan2(turned[0, 0], turned[1, 0])
    pitch = math.asin(turned[2, 0])
    roll = math.atan2(-turned[2, 1], -turned[2, 2])
    then = State(3.0, np.zeros(3), now.velocity_enu_mps, yaw, pitch, roll, 100.0, rates, np.zeros(3), 15.0)
    step = mount.r_w_c(now).T @ mount.r_w_c(then)
    measured = np.array([step[2, 1] - step[1, 2], step[0, 2] - step[2, 0], step[1, 0] - step[0, 1]]) / 2 / dt_s
    assert mount.motion(now).rates_c_radps == pytest.approx(measured, abs=1e-4)
