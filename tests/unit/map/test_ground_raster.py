"""Georeferenced images as simulated ground: position of pixels, voids, bands, projections, and errors."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from rasterio.transform import Affine

import map_rasters
from terrafix import messages as m
from terrafix.core.errors import MapError
from terrafix.core.geodesy import LocalFrame
from terrafix_lab.sim.camera.render import Film, Renderer
from terrafix_lab.sim.ground.draped_image import open_ground

CAMERA = m.Camera(width=960, height=540, fx=560.0, fy=560.0, cx=479.5, cy=269.5)
PLAIN = Film(noise=0.0, vignette=0.0, blur_px=0.0, exposure_jitter=0.0, detail=0.0)


def down(yaw_deg: float, tilt_deg: float = 0.0) -> np.ndarray:
    """R_w_c: straight down, image top towards ``yaw_deg``, then rotated about the image's x axis."""
    s, c = np.sin(np.radians(yaw_deg)), np.cos(np.radians(yaw_deg))
    level = np.array([[c, -s, 0.0], [-s, -c, 0.0], [0.0, 0.0, -1.0]])
    ts, tc = np.sin(np.radians(tilt_deg)), np.cos(np.radians(tilt_deg))
    return level @ np.array([[1, 0, 0], [0, tc, -ts], [0, ts, tc]])


def seen_from(path: Path, frame: LocalFrame, p_c: np.ndarray, r_w_c: np.ndarray) -> np.ndarray:
    """Reference rendering over flat ground at 0 m: the ray of each pixel, through WGS84, bicubic interpolation.

    It shares only the definition of the local frame with the project; lens, rays, projection are independent."""
    x, y = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, np.ones(x.shape)], axis=-1) @ r_w_c.T
    at = p_c + rays * (-p_c[2] / rays[..., 2])[..., None]
    tmerc = f"+proj=tmerc +lat_0={frame.lat_deg:.9f} +lon_0={frame.lon_deg:.9f} +k=1 +datum=WGS84 +units=m"
    lon, lat = Transformer.from_crs(tmerc, "EPSG:4326", always_xy=True).transform(at[..., 0], at[..., 1])
    with rasterio.open(path) as file:
        east, north = Transformer.from_crs(4326, file.crs.to_wkt(), always_xy=True).transform(lon, lat)
        columns, rows = pixel_of(file.transform, east, north)
        image = np.moveaxis(file.read([3, 2, 1]), 0, 2)
    columns, rows = (np.float32(v - 0.5) for v in (columns, rows))
    return cv2.remap(image, columns, rows, cv2.INTER_CUBIC)


def pixel_of(transform: Affine, x: Any, y: Any) -> tuple[Any, Any]:
    """Corner-based (column, row) in a north-up raster."""
    return (x - transform.c) / transform.a, (y - transform.f) / transform.e


def shift_px(a: np.ndarray, b: np.ndarray) -> float:
    """Offset between two images of one scene, by windowed phase correlation."""
    a, b = (cv2.cvtColor(v, cv2.COLOR_BGR2GRAY).astype(np.float64) for v in (a, b))
    (dx, dy), response = cv2.phaseCorrelate(a, b, cv2.createHanningWindow(a.shape[::-1], cv2.CV_64F))
    assert response > 0.3
    return float(np.hypot(dx, dy))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("e_m", "n_m", "agl_m", "yaw_deg", "tilt_deg"),
    [(0, 0, 120, 0, 0), (90, -60, 120, 37, 5), (-110, 80, 90, -121, -9), (20, 30, 330, 200, 3), (0, -60, 150, 0, 35)],
)
def test_a_rendered_frame_matches_a_real_map(
    data_set: Callable[[str], Path], e_m: float, n_m: float, agl_m: float, yaw_deg: float, tilt_deg: float
) -> None:
    path = data_set("maps/town.tif")
    with rasterio.open(path) as file:
        middle = (file.bounds.left + file.bounds.right) / 2, (file.bounds.bottom + file.bounds.top) / 2
        lon, lat = Transformer.from_crs(file.crs.to_wkt(), 4326, always_xy=True).transform(*middle)
    frame = LocalFrame(lat, lon)
    p_c, r_w_c = np.array([e_m, n_m, agl_m], dtype=float), down(yaw_deg, tilt_deg)
    frame_bgr = Renderer(open_ground(path, None, frame), CAMERA, film=PLAIN).frame(p_c, r_w_c, 0)
    expected = seen_from(path, frame, p_c, r_w_c)
    parts = [(slice(0, 540), slice(0, 960))] + [
        (slice(y, y + 270), slice(x, x + 320)) for y in (0, 270) for x in (0, 320, 640)
    ]
    shifts = [shift_px(frame_bgr[part], expected[part]) for part in parts]
    assert max(shifts) < 0.5
    assert shifts[0] < 0.1
    off_px = shift_px(frame_bgr[20:520, 20:900], expected[20:520, 23:903])
    assert off_px == pytest.approx(3.0, abs=0.2)  # the metric detects a known offset


def blob_image(lat_deg: float, lon_deg: float, crs: str, transform: Affine, size: int) -> np.ndarray:
    """(1, size, size) uint8: a white blob of 2 m at a WGS84 position, on grey."""
    x, y = Transformer.from_crs(4326, crs, always_xy=True).transform(lon_deg, lat_deg)
    column, row = pixel_of(transform, x, y)
    rows, columns = np.mgrid[:size, :size] + 0.5
    step_m = 0.5
    distance_m = np.hypot(columns - column, rows - row) * step_m
    return (60 + 180 * np.exp(-((distance_m / 2.0) ** 2))).astype(np.uint8)[None]


@pytest.mark.parametrize("crs", ["EPSG:32633", "EPSG:3035", "EPSG:4326"])
@pytest.mark.parametrize("count", [1, 3, 4])
def test_ground_rasters_of_all_projections_and_band_counts_are_georeferenced_correctly(
    tmp_path: Path, crs: str, count: int
) -> None:
    frame, place = LocalFrame(48.1, 14.4), (48.10030, 14.40060)
    x, y = Transformer.from_crs(4326, crs, always_xy=True).transform(frame.lon_deg, frame.lat_deg)
    step = (0.5 / 74_400.0, 0.5 / 111_200.0) if crs == "EPSG:4326" else (0.5, 0.5)
    transform = Affine(step[0], 0, x - 400 * step[0], 0, -step[1], y + 400 * step[1])
    image = np.repeat(blob_image(*place, crs, transform, 800), count, axis=0)
    ground = open_ground(map_rasters.write_tif(tmp_path / "map.tif", image, crs, transform), None, frame)
    p_c = np.array([30.0, 20.0, 100.0])
    picture = Renderer(ground, CAMERA, film=PLAIN).frame(p_c, down(0.0), 0)[..., 1].astype(float)
    e_m, n_m = frame.to_local(*place)
    expected = 479.5 + 5.6 * (e_m - 30.0), 269.5 - 5.6 * (n_m - 20.0)
    weight = np.maximum(picture - 80.0, 0.0)
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    seen = (weight * columns).sum() / weight.sum(), (weight * rows).sum() / weight.sum()
    # GDAL reprojects EPSG:4326 with an error of up to 0.125 px of the image, 0.35 px of the frame
    assert np.hypot(seen[0] - expected[0], seen[1] - expected[1]) < (0.7 if crs == "EPSG:4326" else 0.2)


FRAME = LocalFrame(48.1, 14.4)
HERE = (FRAME.lat_deg, FRAME.lon_deg)


def plain(path: Path, side_px: int = 400) -> Path:
    """An image of one grey around HERE, at 0.5 m."""
    return map_rasters.around(path, np.full((3, side_px, side_px), 90, np.uint8), "EPSG:32633", HERE, 0.5)


def test_voids_and_the_area_outside_have_the_mean_colour(tmp_path: Path) -> None:
    image = np.full((3, 400, 400), 90, np.uint8)
    image[:, :, 100:160] = 0
    path = map_rasters.around(tmp_path / "map.tif", image, "EPSG:32633", HERE, 0.5, nodata=0)
    ground = open_ground(path, None, FRAME)
    picture = Renderer(ground, CAMERA, film=PLAIN).frame(np.array([0.0, 0.0, 200.0]), down(0.0), 0)
    assert picture.min() == picture.max() == 90


def test_elevation_voids_are_filled_from_their_neighbours(tmp_path: Path) -> None:
    posts = np.full((1, 60, 60), 250.0, np.float32)
    posts[:, :, 30:] = 300.0
    posts[:, 20:40, 20:28] = -9999.0
    dem = map_rasters.around(tmp_path / "dem.tif", posts, "EPSG:32633", HERE, 10.0, nodata=-9999.0)
    ground = open_ground(plain(tmp_path / "map.tif"), dem, FRAME)
    assert float(ground.height_amsl_m(np.array(-60.0), np.array(0.0))) == pytest.approx(250.0)
    assert float(ground.height_amsl_m(np.array(60.0), np.array(0.0))) == pytest.approx(300.0)
    assert float(ground.height_amsl_m(np.array(5000.0), np.array(0.0))) == pytest.approx(300.0)  # the edge is extended


def test_mistakes_are_one_clear_line(tmp_path: Path) -> None:
    image = plain(tmp_path / "map.tif", 64)
    heights = np.full((1, 64, 64), 90, np.float32)
    far = map_rasters.around(tmp_path / "far.tif", heights, "EPSG:32633", (48.1, 15.7), 10.0)
    with pytest.raises(MapError, match="no such file"):
        open_ground(tmp_path / "none.tif", None, FRAME)
    with pytest.raises(MapError, match="no elevation under"):
        open_ground(image, far, FRAME)
    with pytest.raises(MapError, match="is not near the flight"):
        open_ground(image, None, LocalFrame(-20.0, -120.0))
