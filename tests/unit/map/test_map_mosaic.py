"""Mosaics of several sources: the source and the position of each pixel."""

from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS, Transformer
from rasterio.enums import ColorInterp
from rasterio.transform import Affine

import map_rasters
import map_servers
from terrafix.core.errors import MapError
from terrafix_tools.mapping.area.files import read_area
from terrafix_tools.mapping.area.polygons import Area, Placed
from terrafix_tools.mapping.mosaic.compositing import Mosaic, MosaicPlan
from terrafix_tools.mapping.mosaic.cover import uncovered
from terrafix_tools.mapping.mosaic.grid import grid_for
from terrafix_tools.mapping.source import ImagerySource
from terrafix_tools.mapping.sources.collared import raster_opener
from terrafix_tools.mapping.sources.tiles.grid import tiles_of

WORLD = map_servers.pyramid(3, 4, zoom=16)


def box_of(crs: str, x_min: float, y_min: float, x_max: float, y_max: float) -> Area:
    lon, lat = Transformer.from_crs(crs, 4326, always_xy=True).transform(
        [x_min, x_max, x_max, x_min], [y_min, y_min, y_max, y_max]
    )
    return Area("test", (np.stack([lon, lat], axis=1),))


def mosaic(area: Area, *parts: object, gsd_m: float | None = None) -> Mosaic:
    opened = [part() for part in parts]  # type: ignore[operator]
    plan = MosaicPlan(area, grid_for(area, opened, gsd_m), tuple(parts))  # type: ignore[arg-type]
    for one in opened:
        one.__exit__(None, None, None)
    return Mosaic(plan)


def test_the_first_source_with_a_valid_pixel_is_copied(tmp_path: Path) -> None:
    """Two images of one raster; the first has a hole and covers only half of the area."""
    bands = map_rasters.texture(400, 600, seed=1)
    mask = np.full((1, 400, 300), 255, np.uint8)
    mask[:, 100:200, 50:150] = 0
    colours = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]
    first = map_rasters.utm(tmp_path / "1.tif", np.concatenate([bands[:, :, :300], mask]), colorinterp=colours)
    second = map_rasters.utm(tmp_path / "2.tif", 255 - bands)
    area = box_of("EPSG:32651", 300_010.0, 2_600_000.0 - 190.0, 300_290.0, 2_600_000.0 - 10.0)
    with mosaic(area, lambda: ImagerySource(first), lambda: ImagerySource(second)) as made:
        assert made.crs.to_epsg() == 32651 and made.pixel_x == 0.5
        image, valid = made.read(0, 0, made.width_px, made.height_px)
    column, row = round((made.x_min - 300_000.0) / 0.5), round((2_600_000.0 - made.y_max) / 0.5)
    expected = (255 - bands).copy()
    expected[:, :, :300] = np.where(mask > 0, bands[:, :, :300], expected[:, :, :300])
    expected = expected[::-1, row : row + made.height_px, column : column + made.width_px].transpose(1, 2, 0)
    assert (image[valid > 0] == expected[valid > 0]).all()
    assert valid.mean() > 0.98 * 255  # the whole box, whose sides are slightly rotated against the zone's grid


def test_a_source_in_another_crs_is_reprojected_to_its_position(tmp_path: Path) -> None:
    """A smooth function of position, from Web Mercator tiles of half the resolution, on a UTM grid."""

    def value(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 128 + 60 * np.sin(x / 3.0) + 50 * np.cos(y / 4.0)

    rows, columns = 700, 800
    x, y = np.meshgrid(300_000.0 + (np.arange(columns) + 0.5) * 0.5, 2_600_000.0 - (np.arange(rows) + 0.5) * 0.5)
    first = map_rasters.utm(
        tmp_path / "1.tif", np.repeat(value(x, y)[None].round().astype(np.uint8), 3, axis=0)[:, :60]
    )
    to_mercator = Transformer.from_crs(32651, 3857, always_xy=True)
    corner = to_mercator.transform(299_990.0, 2_600_010.0)
    mx, my = np.meshgrid(corner[0] + (np.arange(1000) + 0.5) * 0.45, corner[1] - (np.arange(900) + 0.5) * 0.45)
    ux, uy = Transformer.from_crs(3857, 32651, always_xy=True).transform(mx, my)
    bands = np.repeat(value(ux, uy)[None].round().astype(np.uint8), 3, axis=0)
    second = map_rasters.write_tif(
        tmp_path / "2.tif", bands, "EPSG:3857", Affine(0.45, 0, corner[0], 0, -0.45, corner[1])
    )
    area = box_of("EPSG:32651", 300_010.0, 2_600_000.0 - 330.0, 300_390.0, 2_600_000.0)
    with mosaic(area, lambda: ImagerySource(first), lambda: ImagerySource(second)) as made:
        image, valid = made.read(0, 0, made.width_px, made.height_px)
        gx = made.x_min + (np.arange(made.width_px) + 0.5) * 0.5
        gy = made.y_max - (np.arange(made.height_px) + 0.5) * 0.5
    error = image[:, :, 0].astype(float) - value(*np.meshgrid(gx, gy))
    assert valid.mean() > 0.97 * 255
    assert (
        np.abs(error[valid > 0]).max() < 2.0
    )  # two roundings and bilinear interpolation; a shift by half a pixel would be 4.5


def test_downsampling_averages_pixels(tmp_path: Path) -> None:
    """A checkerboard of one-pixel squares becomes grey."""
    board = np.indices((1024, 1024)).sum(axis=0) % 2 * 200 + 20
    path = map_rasters.utm(tmp_path / "1.tif", np.repeat(board[None].astype(np.uint8), 3, axis=0))
    area = box_of("EPSG:32651", 300_100.0, 2_599_600.0, 300_400.0, 2_599_900.0)
    with mosaic(area, lambda: ImagerySource(path), gsd_m=2.0) as made:
        assert made.gsd_m == pytest.approx(2.0, rel=0.01)
        image, valid = made.read(0, 0, made.width_px, made.height_px)
    assert np.abs(image[valid > 0].astype(int) - 120).max() <= 2


def test_an_area_without_any_source_is_reported(tmp_path: Path) -> None:
    path = map_rasters.utm(tmp_path / "1.tif", map_rasters.texture(64, 64))
    far = box_of("EPSG:32651", 400_000.0, 2_599_600.0, 400_400.0, 2_599_900.0)
    with ImagerySource(path) as source, pytest.raises(MapError, match="no source covers"):
        grid_for(far, [source], None)
    other_side = read_area("-60.0,23.0,-59.9,23.1", buffer_km=0.0)
    with ImagerySource(path) as source, pytest.raises(MapError, match=r"outside the coordinate system|no source"):
        grid_for(other_side, [source], None)


def test_a_black_collar_is_invalid_in_a_mosaic(tmp_path: Path) -> None:
    """As in scanned maps and reprojected photographs: the second source is used there."""
    bands = map_rasters.texture(800, 800)
    bands[:, :, :300] = 0
    framed = map_rasters.utm(tmp_path / "1.tif", bands)
    whole = map_rasters.utm(tmp_path / "2.tif", np.full((3, 800, 800), 77, np.uint8))
    area = box_of("EPSG:32651", 300_020.0, 2_599_620.0, 300_380.0, 2_599_980.0)

    def bar(_name: str, _total: int | None) -> object:
        return lambda: None

    parts = [raster_opener(path, tmp_path / "cache", bar) for path in (framed, whole)]  # type: ignore[arg-type]
    assert raster_opener(framed, tmp_path / "cache", bar)().has_mask  # type: ignore[arg-type]
    with mosaic(area, *parts) as made:
        image, valid = made.read(0, 0, made.width_px, made.height_px)
        collar = round((300_150.0 - made.x_min) / 0.5)
    assert (image[100:600, 50 : collar - 5] == 77).all() and valid[100:600, 50:-50].all()
    assert image[100:600, collar + 10 :].std() > 10


def test_only_tiles_in_gaps_of_better_sources_are_fetched(tmp_path: Path) -> None:
    """An image that covers tiles 0 to 2 of four columns, with a hole of a few pixels in column 1."""
    span_m = 2 * map_servers.HALF_M / (1 << WORLD.zoom)
    corner = WORLD.column * span_m - map_servers.HALF_M, map_servers.HALF_M - WORLD.row * span_m
    bands = np.concatenate([WORLD.image[:, :800].transpose(2, 0, 1), np.full((1, 768, 800), 255, np.uint8)])
    bands[3, 300:310, 300:310] = 0
    colours = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]
    place = Affine(span_m / 256, 0, corner[0], 0, -span_m / 256, corner[1])
    path = map_rasters.write_tif(tmp_path / "a.tif", bands, "EPSG:3857", place, colorinterp=colours)
    area = read_area(WORLD.box_deg(0.1), buffer_km=0.0)
    tiles = tiles_of(Placed(area, CRS.from_epsg(3857)), WORLD.zoom)
    assert tiles.touched.shape == (3, 4) and tiles.touched.all()
    left = uncovered(area, (lambda: ImagerySource(path),), tiles)
    assert not left.touched[:, 0].any() and left.touched[:, 3].all()
    assert left.touched[:, 1].tolist() == [False, True, False]
    assert uncovered(area, (), tiles) is tiles
