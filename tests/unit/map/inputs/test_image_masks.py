"""Masks of images: alpha beside nodata, values that the pixels cannot hold, and collars on any grid."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import rasterio.warp
from rasterio.enums import ColorInterp
from rasterio.transform import Affine

import map_rasters
from field_case import made
from terrafix.map.package import MapPackage
from terrafix_tools.mapping.build import build
from terrafix_tools.mapping.source import ImagerySource
from terrafix_tools.mapping.sources.collared import raster_opener

SIDE_PX, COLLAR_PX = 400, 100
RGBA = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]
UTM = Affine(0.5, 0, 300_000, 0, -0.5, 2_600_000)
TURNED = Affine.translation(300_000, 2_600_000) @ Affine.rotation(20) @ Affine.scale(0.5, -0.5)
GRIDS = {
    "upright": ("EPSG:32651", UTM),
    "degrees": ("EPSG:4326", Affine(5e-6, 0, 121.0, 0, -4.5e-6, 23.5)),
    "rotated": ("EPSG:32651", TURNED),
    "south-up": ("EPSG:32651", Affine(0.5, 0, 300_000, 0, 0.5, 2_600_000)),
    "mirrored": ("EPSG:32651", Affine(-0.5, 0, 300_000, 0, -0.5, 2_600_000)),
    "degrees, rotated": ("EPSG:4326", Affine(5e-6, 1e-6, 121.0, 1e-6, -4.5e-6, 23.5)),
    "ETRS89 degrees": ("EPSG:4258", Affine(5e-6, 0, 13.0, 0, -4.5e-6, 48.0)),
}


def picture(empty: int = 0) -> np.ndarray:
    """RGB with an empty collar in the first rows."""
    rgb = map_rasters.texture(SIDE_PX, SIDE_PX)
    rgb[:, :COLLAR_PX] = empty
    return rgb


def place(grid: str, column: float, row: float) -> tuple[float, float]:
    """Latitude and longitude of a pixel of the image."""
    crs, transform = GRIDS[grid]
    x, y = transform @ (column, row)
    lon_deg, lat_deg = rasterio.warp.transform(crs, "EPSG:4326", [x], [y])
    return lat_deg[0], lon_deg[0]


def written(path: Path, bands: np.ndarray, grid: str, nodata: str | None = None, **profile: Any) -> Path:
    """``nodata``: the text of the tag, which GDAL writes for no such value."""
    crs, transform = GRIDS[grid]
    if nodata is None:
        return map_rasters.write_tif(path, bands, crs, transform, **profile)
    map_rasters.write_tif(path, bands, crs, transform, nodata=222, **profile)
    data = path.read_bytes()
    tag = b"222\x00"
    assert data.count(tag) == 1 and len(nodata) <= 3
    path.write_bytes(data.replace(tag, nodata.encode().ljust(4, b"\x00")))
    return path


def built_without_its_collar(path: Path, grid: str, tmp_path: Path) -> MapPackage:
    """The package of ``path``, which covers the picture and not its collar."""
    package = MapPackage.open(build(path, tmp_path / "m.gpkg"))
    inside = [package.covers(*place(grid, column, row)) for column, row in ((50, 130), (200, 250), (370, 370))]
    collar = [package.covers(*place(grid, column, row)) for column, row in ((30, 30), (200, 50), (370, 90))]
    assert all(inside) and not any(collar)
    return package


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("empty", [0, 255])
def test_a_collar_is_found_on_every_grid(tmp_path: Path, grid: str, empty: int) -> None:
    built_without_its_collar(written(tmp_path / "i.tif", picture(empty), grid), grid, tmp_path)


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("nodata", ["255", "-99", "nan", "256", "0"])
def test_alpha_wins_over_nodata(tmp_path: Path, grid: str, nodata: str) -> None:
    """The picture holds pixels of 255 and of 0, which alpha says are valid."""
    rgb = picture()
    rgb[:, 200:220, 190:210] = 255
    rgb[:, 240:260, 190:210] = 0
    alpha = np.full((1, SIDE_PX, SIDE_PX), 255, np.uint8)
    alpha[:, :COLLAR_PX] = 0
    path = written(tmp_path / "i.tif", np.concatenate([rgb, alpha]), grid, nodata, colorinterp=RGBA)
    package = built_without_its_collar(path, grid, tmp_path)
    assert package.covers(*place(grid, 200, 210)) and package.covers(*place(grid, 200, 250))
    text = package.manifest.inputs[0].text()
    assert ("alpha band is the mask" in text) if nodata in ("255", "0") else (f"{nodata} ignored, uint8 cannot" in text)


@pytest.mark.parametrize("grid", ["upright", "rotated"])
@pytest.mark.parametrize("order", ["RGBNA", "ARGB", "RGBAN"])
def test_an_alpha_band_in_any_place_is_the_mask(tmp_path: Path, grid: str, order: str) -> None:
    """With a near infrared band GDAL itself reports no mask; the collar is grey, so that no search finds it."""
    rgb, alpha = picture(77), np.full((SIDE_PX, SIDE_PX), 255, np.uint8)
    alpha[:COLLAR_PX] = 0
    bands = {"R": rgb[0], "G": rgb[1], "B": rgb[2], "N": rgb[0], "A": alpha}
    names = {"R": RGBA[0], "G": RGBA[1], "B": RGBA[2], "N": ColorInterp.undefined, "A": RGBA[3]}
    path = written(tmp_path / "i.tif", np.stack([bands[b] for b in order]), grid, colorinterp=[names[b] for b in order])
    built_without_its_collar(path, grid, tmp_path)


@pytest.mark.parametrize("grid", ["upright", "degrees", "rotated"])
@pytest.mark.parametrize("nodata", ["-99", "nan", "256", "0.5"])
def test_nodata_that_8_bits_cannot_hold_is_ignored_with_a_word(tmp_path: Path, grid: str, nodata: str) -> None:
    path = written(tmp_path / "i.tif", picture(), grid, nodata)
    package = built_without_its_collar(path, grid, tmp_path)  # by the search for a collar
    assert f"nodata value {nodata} ignored, uint8 cannot hold it" in package.manifest.inputs[0].text()


def test_a_nodata_value_that_16_bits_can_hold_counts(tmp_path: Path) -> None:
    bands = picture().astype(np.uint16) * 200
    path = map_rasters.write_tif(tmp_path / "i.tif", bands, *GRIDS["upright"], nodata=0)
    built_without_its_collar(path, "upright", tmp_path)


@pytest.mark.parametrize("grid", ["degrees", "rotated", "south-up"])
def test_a_warped_source_of_a_mosaic_has_no_collar_either(tmp_path: Path, grid: str) -> None:
    path = written(tmp_path / "i.tif", picture(), grid)
    for _ in range(2):  # found, then cached
        with raster_opener(path, tmp_path / "cache", lambda *_: lambda: None)() as source:
            image, mask = source.read(0, 0, source.width_px, source.height_px)
        black = (image == 0).all(axis=2) & (mask > 0)
        assert black.mean() < 1e-4
    assert len(list((tmp_path / "cache").glob("hidden-*.tif"))) == 1


@pytest.mark.parametrize("grid", ["degrees", "rotated"])
def test_a_warped_image_without_a_collar_keeps_its_edge(tmp_path: Path, grid: str) -> None:
    path = written(tmp_path / "i.tif", map_rasters.texture(SIDE_PX, SIDE_PX), grid)
    opener = raster_opener(path, tmp_path / "cache", lambda *_: lambda: None)
    with opener() as found, ImagerySource(path) as plain:
        for a, b in zip(found.read(0, 0, found.width_px, 50), plain.read(0, 0, plain.width_px, 50), strict=True):
            assert np.array_equal(a, b)


def test_the_masks_of_the_field(data_set: Callable[[str], Path], tmp_path: Path) -> None:
    made(data_set, "nodata-range", tmp_path)
    paths = sorted(tmp_path.glob("*.tif"))
    assert len(paths) == 18
    for path in paths:
        package = MapPackage.open(build(path, tmp_path / f"{path.stem}.gpkg"))
        with rasterio.open(path) as file:
            for row, valid in ((20, False), (50, False), (80, False), (150, True), (300, True)):
                x, y = file.transform @ (200, row)
                lon_deg, lat_deg = rasterio.warp.transform(file.crs, "EPSG:4326", [x], [y])
                assert package.covers(lat_deg[0], lon_deg[0]) == valid, f"{path.name} row {row}"
        package.close()
