"""Windows of a map package, compared with an independent rendering by GDAL in the same local CRS."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from rasterio.enums import Resampling
from rasterio.transform import Affine
from rasterio.vrt import WarpedVRT

import map_rasters
from map_packages import bound, centre_of
from terrafix.core.geodesy import LocalFrame, local_crs
from terrafix.map.package import LocalMap, MapPackage
from terrafix_tools.mapping.build import build

SIDE_PX = 900


def reference(tif: Path, frame: LocalFrame, e_min_m: float, n_max_m: float, side_px: int, gsd_m: float) -> np.ndarray:
    """(side, side, 3) BGR by GDAL."""
    with (
        rasterio.open(tif) as file,
        WarpedVRT(
            file,
            crs=local_crs(frame.lat_deg, frame.lon_deg).to_wkt(),
            transform=Affine(gsd_m, 0, e_min_m, 0, -gsd_m, n_max_m),
            width=side_px,
            height=side_px,
            resampling=Resampling.bilinear if gsd_m < 1.1 * file.transform.a else Resampling.average,
            tolerance=0.01,
        ) as warped,
    ):
        return warped.read([3, 2, 1]).transpose(1, 2, 0)


def shift_px(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Displacement (dx, dy) of a relative to b, by least squares on the gradient."""
    a, b = (cv2.GaussianBlur(image, (0, 0), 2.0).astype(np.float64).mean(axis=2)[8:-8, 8:-8] for image in (a, b))
    gradient = np.stack(
        [cv2.Sobel(b, cv2.CV_64F, 1, 0).ravel() / 8, cv2.Sobel(b, cv2.CV_64F, 0, 1).ravel() / 8], axis=1
    )
    return np.linalg.lstsq(gradient, (b - a).ravel(), rcond=None)[0]


def render(local: LocalMap, gsd_m: float, side_px: int) -> tuple[np.ndarray, float, float]:
    e_min_m, n_max_m = -0.5 * side_px * gsd_m + 3.21, 0.5 * side_px * gsd_m - 1.77
    image, valid = local.window(e_min_m, n_max_m, side_px, side_px, gsd_m)
    assert valid.all()
    return image, e_min_m, n_max_m


@pytest.mark.slow
@pytest.mark.parametrize(
    ("crs", "lat_deg", "lon_deg"),
    [
        ("EPSG:32651", 24.1, 120.6),
        ("EPSG:32722", -25.3, -53.9),
        ("EPSG:32633", 68.0, 17.4),
        ("EPSG:3857", 60.2, 25.0),
        ("EPSG:2056", 46.9, 7.4),
        ("EPSG:2263", 40.7, -74.0),  # feet
    ],
)
def test_a_window_has_the_position_that_gdal_computes(tmp_path: Path, crs: str, lat_deg: float, lon_deg: float) -> None:
    pixel = 0.5 / 0.3048 if crs == "EPSG:2263" else 0.5
    texture = map_rasters.texture(SIDE_PX, SIDE_PX)
    tif = map_rasters.around(tmp_path / "image.tif", texture, crs, (lat_deg, lon_deg), pixel)
    package = MapPackage.open(build(tif, tmp_path / "map.gpkg"), verify=True)
    scale = math.cos(math.radians(lat_deg)) if crs == "EPSG:3857" else 1.0
    assert package.manifest.gsd_m == pytest.approx(0.5 * scale, rel=5e-3)
    frame = LocalFrame(lat_deg + 1e-4, lon_deg - 1e-4)
    local = package.bind(frame)
    for factor, side_px in ((1.0, 500), (2.0, 300)):
        gsd_m = local.gsd_m * factor
        image, e_min_m, n_max_m = render(local, gsd_m, side_px)
        expected = reference(tif, frame, e_min_m, n_max_m, side_px, gsd_m)
        assert np.abs(shift_px(image, expected)).max() * factor < 0.05
        difference = image.astype(float).mean(axis=2) - expected.mean(axis=2)
        assert np.abs(difference).mean() < 3.0
    package.close()


def test_the_position_of_a_dot_is_exact_by_pyproj(tmp_path: Path) -> None:
    """Gaussian dots far from the frame's origin, in EPSG:3857 at 60 degrees north, where its curvature is large."""
    x_0, y_0 = Transformer.from_crs(4326, 3857, always_xy=True).transform(25.0, 60.2)
    bands = np.full((3, 2000, 2000), 60, np.uint8)
    rows, columns = np.mgrid[0:2000, 0:2000]
    dots = [(200, 300), (1700, 250), (1000, 1800), (1850, 1850)]
    for row, column in dots:
        here = np.s_[row - 15 : row + 16, column - 15 : column + 16]
        bump = 150 * np.exp(-((rows[here] - row) ** 2 + (columns[here] - column) ** 2) / (2 * 3.0**2))
        bands[:, here[0], here[1]] += bump.astype(np.uint8)
    tif = map_rasters.write_tif(tmp_path / "dots.tif", bands, "EPSG:3857", Affine(1.0, 0, x_0, 0, -1.0, y_0))
    package = MapPackage.open(build(tif, tmp_path / "dots.gpkg"))
    frame = LocalFrame(60.2, 25.0)
    local = package.bind(frame)
    e_min, n_min, e_max, n_max = local.bounds_m
    gsd_m = local.gsd_m
    image, valid = local.window(
        e_min, n_max, math.ceil((e_max - e_min) / gsd_m), math.ceil((n_max - n_min) / gsd_m), gsd_m
    )
    to_wgs84 = Transformer.from_crs(3857, 4326, always_xy=True)
    for row, column in dots:
        lon_deg, lat_deg = to_wgs84.transform(x_0 + column + 0.5, y_0 - row - 0.5)
        e_m, n_m = frame.to_local(lat_deg, lon_deg)
        c, r = (e_m - e_min) / gsd_m - 0.5, (n_max - n_m) / gsd_m - 0.5
        top, left = round(r) - 14, round(c) - 14
        patch = image[top : top + 29, left : left + 29, 1].astype(float) - 60
        assert valid[top : top + 29, left : left + 29].all()
        patch[patch < 4] = 0
        yy, xx = np.mgrid[0:29, 0:29]
        found = left + (patch * xx).sum() / patch.sum(), top + (patch * yy).sum() / patch.sum()
        assert found == pytest.approx((c, r), abs=0.06)
    package.close()


def test_downsampled_windows_do_not_alias(tmp_path: Path) -> None:
    """A pattern finer than the window's pixels becomes grey, at every scale."""
    rows, columns = np.mgrid[0:1024, 0:1024]
    bands = np.repeat(np.where((rows + columns) % 2, 200, 56).astype(np.uint8)[None], 3, axis=0)
    local = bound(build(map_rasters.utm(tmp_path / "fine.tif", bands), tmp_path / "fine.gpkg"))
    for factor in (1.5, 1.8, 2.5, 4.0, 7.3):
        image, valid = local.window(-100.0, 100.0, round(400 / factor), round(400 / factor), local.gsd_m * factor)
        assert valid.all()
        assert image.std() < 12
        assert image.mean() == pytest.approx(128, abs=2)


@pytest.mark.parametrize(("height", "width"), [(300, 400), (512, 512), (256, 256)])
def test_the_area_outside_is_zero_and_invalid_with_sharp_edges(tmp_path: Path, height: int, width: int) -> None:
    package = MapPackage.open(
        build(map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(height, width)), tmp_path / "i.gpkg")
    )
    (west, south, _, _), centre = package.manifest.bounds_wgs84, centre_of(package)
    local = package.bind(centre)
    e_min, n_min, e_max, n_max = local.bounds_m
    image, valid = local.window(e_min - 50, n_max + 50, 740, 740, 0.5)
    assert not image[~valid].any()
    assert (image[valid].max(axis=1) > 0).all()
    area_m2 = valid.sum() * 0.25
    assert area_m2 == pytest.approx(height * width * 0.25, rel=0.03)
    assert (e_max - e_min, n_max - n_min) == pytest.approx((width / 2, height / 2), abs=6)
    far, nothing = local.window(1e6, 1e6, 64, 32, 0.5)
    assert far.shape == (32, 64, 3) and not far.any() and not nothing.any()
    assert package.covers(centre.lat_deg, centre.lon_deg)
    assert not package.covers(south - 0.01, west)
    assert not package.covers(-80.0, 10.0)
    beyond = centre.to_wgs84(0.0, n_max + 80.0)
    assert not package.covers(*beyond)
    assert not package.covers_start(*beyond, 25.0)  # three sigma are 75 m, the map is 80 m away
    assert all(package.covers_start(*beyond, sigma_m) for sigma_m in (28.0, 45.0, 90.0))  # by the 3rd, 2nd, 1st ring
    package.close()


def test_the_tile_cache_does_not_change_a_window(tmp_path: Path) -> None:
    local = bound(build(map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(600, 600)), tmp_path / "i.gpkg"))
    first = local.window(-100.0, 100.0, 300, 300, 0.61)
    local.window(-60.0, 90.0, 200, 200, 1.3)
    second = local.window(-100.0, 100.0, 300, 300, 0.61)
    assert np.array_equal(first[0], second[0]) and np.array_equal(first[1], second[1])
