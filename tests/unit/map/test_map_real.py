"""Every image of the shared data set becomes a package that follows the standard and reproduces the image."""

from collections.abc import Callable
from pathlib import Path

import pytest
import rasterio

from map_standard import violations
from terrafix.core.geodesy import LocalFrame
from terrafix.map.package import MapPackage
from terrafix_tools.mapping.build import build

FAST = ["imagery/joplin/before.tif", "imagery/prairie/20120731.tif", "imagery/swellendam/ortho.tif"]
SLOW = [
    "maps/town.tif",
    "maps/village-2014-01.tif",
    "maps/village-2014-03.tif",
    "imagery/adiyaman-6/dry.tif",
    "imagery/adiyaman-6/winter.tif",
    "imagery/gaziantep-2/dry.tif",
    "imagery/gaziantep-2/winter.tif",
    "imagery/joplin/after.tif",
    "imagery/prairie/20160816.tif",
    "imagery/prairie/20180716.tif",
    "imagery/single/terraces.tif",
    "imagery/single/pasture.tif",
    "imagery/single/reef.tif",
]


@pytest.mark.parametrize("name", [*FAST, *(pytest.param(n, marks=pytest.mark.slow) for n in SLOW)])
def test_real_imagery_becomes_a_valid_package(tmp_path: Path, data_set: Callable[[str], Path], name: str) -> None:
    tif = data_set(name)
    dem = data_set("imagery/swellendam/srtm.tif") if "swellendam" in name else None
    out = build(tif, tmp_path / "m.gpkg", dem=dem)
    assert violations(out) == []
    package = MapPackage.open(out, verify=True)
    west, south, east, north = package.manifest.bounds_wgs84
    lat_deg, lon_deg = (south + north) / 2, (west + east) / 2
    local = package.bind(LocalFrame(lat_deg, lon_deg))
    side = 400
    image, valid = local.window(-0.5 * side * local.gsd_m, 0.5 * side * local.gsd_m, side, side, local.gsd_m)
    assert valid.mean() > 0.5 and image[valid].std() > 5
    assert package.covers(lat_deg, lon_deg) == bool(valid[side // 2, side // 2])
    area_km2 = (east - west) * (north - south) * 111.2**2 * 0.5
    assert out.stat().st_size < 50e6 * max(area_km2, 0.1) * (0.3 / min(package.manifest.gsd_m, 0.3)) ** 2
    with rasterio.open(f"GPKG:{out}:imagery" if dem else out) as file:
        assert file.driver == "GPKG" and file.count >= 3
    package.close()
