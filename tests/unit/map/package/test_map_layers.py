"""Several layers of different dates in one package."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

import map_rasters
from terrafix.core.errors import MapError
from terrafix.core.geodesy import LocalFrame
from terrafix.map.package import MapPackage
from terrafix_tools.mapping.build import build_package, layer_of
from terrafix_tools.mapping.layers import ElevationInput
from terrafix_tools.mapping.package.dem import DemSource

LAT_DEG, LON_DEG = 23.4986, 121.0426


def placed(path: Path, seed: int, crs: str, pixel: float, side_px: int) -> Path:
    """A texture around the same WGS84 position."""
    return map_rasters.around(path, map_rasters.texture(side_px, side_px, seed), crs, (LAT_DEG, LON_DEG), pixel)


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("layers")
    old = placed(folder / "old.tif", 1, "EPSG:32651", 0.5, 700)
    new = placed(folder / "new.tif", 2, "EPSG:3857", 1.0, 400)
    undated = placed(folder / "undated.tif", 3, "EPSG:32651", 2.0, 300)
    layers = [
        layer_of(undated),
        layer_of(old, date="2014-03-01", licence="CC BY 4.0", ce90_m=8.0),
        layer_of(new, date="2023-06-01", licence="CC0", ce90_m=3.0),
    ]
    return build_package(layers, folder / "m.gpkg")


@pytest.fixture
def opened(package: Path) -> Iterator[MapPackage]:
    opened = MapPackage.open(package, verify=True)
    yield opened
    opened.close()


def test_layers_are_ordered_by_date_with_their_metadata(opened: MapPackage) -> None:
    manifest = opened.manifest
    assert [(x.table, x.date, x.source, x.ce90_m) for x in manifest.layers] == [
        ("imagery", "2023-06-01", "new.tif", 3.0),
        ("imagery_2", "2014-03-01", "old.tif", 8.0),
        ("imagery_3", "", "undated.tif", None),
    ]
    assert (manifest.date, manifest.licence, manifest.ce90_m) == ("2023-06-01", "CC0", 3.0)
    assert (manifest.crs, manifest.layers[1].crs) == ("EPSG:3857", "EPSG:32651")
    assert manifest.layers[0].gsd_m == pytest.approx(np.cos(np.radians(LAT_DEG)), rel=5e-3)
    described = [layer.descriptors.tiles for layer in manifest.layers if layer.descriptors]
    assert manifest.tiles == sum(layer.tiles for layer in manifest.layers) + sum(described)


def test_a_window_shows_the_requested_layer_at_the_same_position(opened: MapPackage) -> None:
    frame = LocalFrame(LAT_DEG, LON_DEG)
    local = opened.bind(frame)
    newest, _ = local.window(-50, 50, 100, 100, 1.0)
    assert np.array_equal(newest, local.window(-50, 50, 100, 100, 1.0, "imagery")[0])
    old, valid = local.window(-50, 50, 100, 100, 1.0, layer="imagery_2")
    assert valid.all() and not np.array_equal(old, newest)
    bound = opened.bind(frame, "imagery_2")
    assert np.array_equal(bound.window(-50, 50, 100, 100, 1.0)[0], old)
    assert bound.gsd_m == pytest.approx(0.5, rel=1e-3) and bound.bounds_m != local.bounds_m
    # The texture of seed 1 at full resolution: the central 100 m of an image of 350 m.
    texture = map_rasters.texture(700, 700, 1)[::-1, 250:450, 250:450].transpose(1, 2, 0).astype(np.float64)
    expected = texture.reshape(100, 2, 100, 2, 3).mean(axis=(1, 3))
    turned = old.astype(np.float64)  # grid north is within half a degree of true north here
    inner = np.s_[10:90, 10:90]
    assert np.corrcoef(expected[inner].ravel(), turned[inner].ravel())[0, 1] > 0.9


def test_coverage_is_that_of_the_layer(opened: MapPackage) -> None:
    lat_deg, lon_deg = LocalFrame(LAT_DEG, LON_DEG).to_wgs84(280.0, 0.0)
    assert not opened.covers(lat_deg, lon_deg) and not opened.covers(lat_deg, lon_deg, "imagery_2")
    assert opened.covers(lat_deg, lon_deg, "imagery_3")
    with pytest.raises(MapError, match="has no layer 'spring'; it has imagery, imagery_2, imagery_3"):
        opened.covers(lat_deg, lon_deg, "spring")


def test_gdal_reads_every_layer_with_its_grid(package: Path) -> None:
    for table, crs, pixel in (("imagery", 3857, 1.0), ("imagery_2", 32651, 0.5), ("imagery_3", 32651, 2.0)):
        with rasterio.open(f"GPKG:{package}:{table}") as file:
            assert file.crs.to_epsg() == crs and file.transform.a == pytest.approx(pixel)
            assert file.dataset_mask().mean() > 250


def test_elevation_is_built_for_the_newest_layer(tmp_path: Path) -> None:
    new = placed(tmp_path / "new.tif", 2, "EPSG:3857", 1.0, 300)
    old = placed(tmp_path / "old.tif", 1, "EPSG:32651", 0.5, 300)
    height = np.full((1, 60, 60), 321.5, np.float32)
    corner = Affine(0.001, 0, LON_DEG - 0.03, 0, -0.001, LAT_DEG + 0.03)
    dem = map_rasters.write_tif(tmp_path / "d.tif", height, "EPSG:4326", corner)
    layers = [layer_of(old, date="2001-01-01"), layer_of(new, date="2020-01-01")]
    elevation = ElevationInput(partial(DemSource, dem), source="d.tif", licence="open")
    out = build_package(layers, tmp_path / "m.gpkg", elevation=elevation)
    opened = MapPackage.open(out, verify=True)
    assert opened.ground_amsl_m(LAT_DEG, LON_DEG) == pytest.approx(321.5, abs=0.01)
    assert opened.manifest.dem is not None
    assert (opened.manifest.dem.source, opened.manifest.dem.licence) == ("d.tif", "open")
    opened.close()
