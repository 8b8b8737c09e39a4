"""Descriptors in a package: equal to those computed in flight, in any CRS; integrity; the GeoPackage standard."""

import math
from pathlib import Path

import numpy as np
import pytest

import map_rasters
from map_packages import alter
from map_standard import violations
from terrafix.anchor.matching.descriptor_cache import MapFeatures
from terrafix.anchor.matching.frame_matcher import FrameMatcher
from terrafix.anchor.relocalization.coarse_descriptors import CoarseDescriptors
from terrafix.core.errors import MapError
from terrafix.core.geodesy import LocalFrame
from terrafix.map.package import LocalMap, MapPackage
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_engines.retrieval.pooled import POOL, PooledGradientDescriber
from terrafix_tools.mapping.build import build, build_package, layer_of
from terrafix_tools.mapping.check import suitability
from terrafix_tools.mapping.choices import Descriptors

SIDE_PX, LAT_DEG, LON_DEG = 800, 68.0, 17.4


def placed(path: Path, crs: str, pixel_m: float = 2.0) -> Path:
    """A generated GeoTIFF around the position, with a hole near its centre."""
    bands = np.tile(map_rasters.texture(SIDE_PX // 2, SIDE_PX // 2, seed=4), (1, 2, 2))
    bands[:, 450:490, 380:440] = 0
    pixel = pixel_m / math.cos(math.radians(LAT_DEG)) if crs == "EPSG:3857" else pixel_m
    return map_rasters.around(path, bands, crs, (LAT_DEG, LON_DEG), pixel, nodata=0)


@pytest.fixture(params=["EPSG:32634", "EPSG:32632", "EPSG:3857"])
def local(tmp_path: Path, request: pytest.FixtureRequest) -> LocalMap:
    """Meridian convergence of -3.3 and 7.8 degrees; a projection with a scale factor of two."""
    package = build(placed(tmp_path / "i.tif", request.param), tmp_path / "m.gpkg")
    return MapPackage.open(package, verify=True).bind(LocalFrame(LAT_DEG + 1e-3, LON_DEG - 1e-3))


def test_stored_descriptors_equal_computed_ones(local: LocalMap) -> None:
    """In the local frame, which is rotated against the map: cell by cell and orientation by orientation."""
    describer = PooledGradientDescriber()
    index, computed = CoarseDescriptors(local, describer), MapFeatures(local, describer)
    gsd_m = index.gsd_m(2.1)
    assert gsd_m == pytest.approx(2.0, rel=0.01) and local.descriptors(describer.name) is not None
    window = (-600.0, 600.0, 135, 140, gsd_m)
    (ours, valid, *corner), (theirs, known, *other) = index.window(*window), computed.window(*window)
    assert corner == other and valid.mean() > 0.9
    assert known[~valid].mean() < 0.3  # the hole is invalid, with a margin of one cell
    both = valid & known
    for k in range(describer.channels):
        agree = [float(np.corrcoef(ours[k][both], theirs[j][both])[0, 1]) for j in range(describer.channels)]
        assert agree[k] > 0.85 and int(np.argmax(agree)) == k  # below 1 because of the interpolation
    assert ours[:, both].mean() == pytest.approx(theirs[:, both].mean(), rel=0.05)
    assert not ours[:, ~valid].any()


def test_a_scale_without_stored_descriptors_is_computed(tmp_path: Path) -> None:
    package = MapPackage.open(build(placed(tmp_path / "i.tif", "EPSG:32634"), tmp_path / "m.gpkg"))
    local, describer = package.bind(LocalFrame(LAT_DEG, LON_DEG)), PooledGradientDescriber()
    index = CoarseDescriptors(local, describer)
    assert index.gsd_m(0.7) == 0.7
    window = (0.0, 300.0, 60, 50, 2.5)
    ours, theirs = index.window(*window), MapFeatures(local, describer).window(*window)  # with other surroundings
    assert np.array_equal(ours[1], theirs[1])
    assert np.abs(ours[0] - theirs[0]).max() < 0.05 and np.abs(ours[0] - theirs[0]).mean() < 1e-4


def search_warnings(local: LocalMap) -> list[str]:
    matcher = FrameMatcher(suitability.DEFAULT_CAMERA, local, GradientDescriber())
    return list(suitability._search_warnings(local, matcher, 110.0))


def test_a_package_without_descriptors_is_valid_and_the_check_reports_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(suitability, "SEARCH_WARNING_S", 0.01)  # a small map is below the default threshold
    tif = placed(tmp_path / "i.tif", "EPSG:32634")
    without = build_package([layer_of(tif)], tmp_path / "m.gpkg", descriptors=Descriptors.NONE)
    package = MapPackage.open(without, verify=True)
    local = package.bind(LocalFrame(LAT_DEG, LON_DEG))
    assert package.layer().descriptors is None and local.descriptors(PooledGradientDescriber.name) is None
    assert CoarseDescriptors(local, PooledGradientDescriber()).gsd_m(2.1) == 2.1
    (warning,) = search_warnings(local)
    assert warning.startswith("no descriptors for a search at 110 m")
    local = MapPackage.open(build(tif, tmp_path / "with.gpkg")).bind(LocalFrame(LAT_DEG, LON_DEG))
    assert not search_warnings(local)


def test_descriptors_are_covered_by_checksum_and_hashes(tmp_path: Path) -> None:
    path = build(placed(tmp_path / "i.tif", "EPSG:32634"), tmp_path / "m.gpkg")
    assert violations(path) == []
    table = MapPackage.open(path).layer().descriptors
    assert table is not None and table.tiles > 15 and table.name == PooledGradientDescriber.name
    alter(path, f"UPDATE {table.table} SET tile_data = (SELECT tile_data FROM {table.table} LIMIT 1)")
    with pytest.raises(MapError, match="tile of imagery_descriptors"):
        MapPackage.open(path, verify=True)
    package = MapPackage.open(path)
    index = CoarseDescriptors(package.bind(LocalFrame(LAT_DEG, LON_DEG)), PooledGradientDescriber())
    _, valid, *_ = index.window(-500.0, 500.0, 120, 120, index.gsd_m(2.1))
    assert not valid.any() and package.tiles.damaged  # in flight it counts as missing


def test_pooled_descriptors_are_means_of_dense_ones() -> None:
    image = np.ascontiguousarray(map_rasters.texture(66, 131, seed=2).transpose(1, 2, 0))
    dense, pooled = GradientDescriber().describe(image), PooledGradientDescriber().describe(image)
    assert pooled.shape == (8, 16, 32)
    for r, c in ((0, 0), (7, 30), (15, 31)):
        cell = dense[:, r * POOL : (r + 1) * POOL, c * POOL : (c + 1) * POOL]
        assert pooled[:, r, c] == pytest.approx(cell.mean(axis=(1, 2)), abs=1e-6)
