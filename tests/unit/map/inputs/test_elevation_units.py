"""Elevation in the units and datums of the world: a plane of known height, written by GDAL, with PROJ's units."""

import dataclasses
import io
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import rasterio.warp
from pyproj import CRS
from pyproj.database import get_units_map
from rasterio.transform import Affine
from rich.console import Console
from typer.testing import CliRunner

import map_rasters
from field_case import made
from map_geoids import undulation_m, write_geoid
from terrafix.core.errors import MapError, UsageError
from terrafix.core.geodesy import LocalFrame
from terrafix.map.package import MapPackage
from terrafix_lab.sim.ground.draped_image import open_ground
from terrafix_tools.cli import app
from terrafix_tools.mapping.area.build import Order, build_order
from terrafix_tools.mapping.build import build
from terrafix_tools.mapping.choices import Datum, Descriptors, Unit

CENTRE = (300_150.0, 2_599_850.0)  # of the imagery, EPSG:32651
HIGH_M, SLOPE = 1600.0, 0.02
LENGTHS = {name: unit.conv_factor for name, unit in get_units_map(category="linear").items()} | {"dm": 0.1}


def plane_m(east: np.ndarray | float) -> Any:
    return HIGH_M + SLOPE * (east - 300_000.0)


def write_dem(
    path: Path, *, metres: float = 1.0, scale: float = 1.0, offset: float = 0.0, dtype: str = "float32",
    crs: Any = "EPSG:32651", unit: str = "", **profile: Any,
) -> Path:  # fmt: skip
    """The plane as (height / metres - offset) / scale."""
    east = 299_000.0 + 10.0 * (np.arange(300) + 0.5)
    raw = (np.broadcast_to(plane_m(east), (300, 300)) / metres - offset) / scale
    raw = np.rint(raw) if np.dtype(dtype).kind in "iu" else raw
    with rasterio.open(
        path, "w", driver="GTiff", width=300, height=300, count=1, dtype=dtype, crs=crs,
        transform=Affine(10, 0, 299_000, 0, -10, 2_601_000), **profile,
    ) as file:  # fmt: skip
        file.write(raw.astype(dtype), 1)
        if unit:
            file.units = (unit,)
        if (scale, offset) != (1.0, 0.0):
            file.scales, file.offsets = (scale,), (offset,)
    return path


@pytest.fixture
def ortho(tmp_path: Path) -> Path:
    return map_rasters.utm(tmp_path / "ortho.tif", map_rasters.texture(600, 600))


def ordered(ortho: Path, dem: Path, **options: Any) -> MapPackage:
    out = ortho.parent / "map.gpkg"
    order = Order(
        out=out, source=(str(ortho),), dem=str(dem), workers=1, descriptors=Descriptors.NONE, say=Console(quiet=True)
    )
    build_order(dataclasses.replace(order, **options))
    return MapPackage.open(out, verify=True)


def ground_m(package: MapPackage) -> float:
    frame = LocalFrame(*_centre_deg())
    found = package.bind(frame).elevation(np.zeros(1), np.zeros(1))
    assert found is not None
    return float(found[0])


def _centre_deg() -> tuple[float, float]:
    lon_deg, lat_deg = rasterio.warp.transform("EPSG:32651", "EPSG:4326", *[[v] for v in CENTRE])
    return lat_deg[0], lon_deg[0]


def elevation_line(package: MapPackage) -> str:
    return next(s.text() for s in package.manifest.inputs if s.kind == "elevation")


NAMES = {
    "m": "metre", "metre": "metre", "meters": "metre", "[m]": "metre", "ft": "foot", "feet": "foot", "Foot": "foot",
    "US survey foot": "US survey foot", "US survey feet": "US survey foot", "ftUS": "US survey foot",
    "us-ft": "US survey foot", "Foot_US": "US survey foot", "cm": "centimetre", "centimeters": "centimetre",
    "km": "kilometre", "decimeter": "dm", "yard": "yard", "fathom": "fathom",
    "British foot (Sears 1922)": "British foot (Sears 1922)", "U.S. Survey Feet": "US survey foot",
    "foot_US": "US survey foot", "foot (international)": "foot", "decimetre": "dm", "millimetres": "millimetre",
}  # fmt: skip


@pytest.mark.parametrize("unit", NAMES)
def test_heights_are_converted_from_the_unit_of_the_band(tmp_path: Path, ortho: Path, unit: str) -> None:
    dem = write_dem(tmp_path / "d.tif", metres=LENGTHS[NAMES[unit]], unit=unit)
    package = MapPackage.open(build(ortho, tmp_path / "m.gpkg", dem=dem))
    assert ground_m(package) == pytest.approx(plane_m(CENTRE[0]), abs=0.03)
    assert f"heights in {unit}" in elevation_line(package) and "unit of heights not stated" not in elevation_line(
        package
    )


@pytest.mark.parametrize("vertical", [5773, 6360, 8228, 5702, 5703, 3855, 5715])
def test_heights_are_converted_from_the_unit_of_the_vertical_system(tmp_path: Path, ortho: Path, vertical: int) -> None:
    """EGM96, NAVD88 in US survey feet and in feet, NGVD29 in feet, NAVD88, EGM2008, and depths below mean sea level."""
    axis = CRS.from_epsg(vertical).axis_info[0]
    metres = axis.unit_conversion_factor * (-1.0 if axis.direction == "down" else 1.0)
    dem = write_dem(tmp_path / "d.tif", metres=metres, crs=f"EPSG:32651+{vertical}")
    package = ordered(ortho, dem)
    assert ground_m(package) == pytest.approx(plane_m(CENTRE[0]), abs=0.03)
    line = elevation_line(package)
    assert axis.unit_name in line and CRS.from_epsg(vertical).name in line
    assert ("used as AMSL" in line) == (vertical != 5773)


@pytest.mark.parametrize(
    ("scale", "offset", "dtype", "nodata"),
    [(0.1, 0.0, "int16", -32768), (1.0, 1000.0, "int16", -32768), (0.01, 500.0, "uint32", 0),
     (2.0, -50.0, "float32", math.nan), (0.25, 0.0, "uint16", None), (1.0, 0.0, "int16", -99999),
     (0.001, 0.0, "float64", -1e30)],
)  # fmt: skip
def test_scale_and_offset_of_the_band_are_applied(
    tmp_path: Path, ortho: Path, scale: float, offset: float, dtype: str, nodata: float | None
) -> None:
    dem = write_dem(tmp_path / "d.tif", scale=scale, offset=offset, dtype=dtype)
    with rasterio.open(dem, "r+") as file:
        raw = file.read(1)
        raw[:20, :20] = 0 if nodata is None or nodata == -99999 else nodata
        file.write(raw, 1)
    if nodata == -99999:  # a text that GDAL keeps, though 16 bits cannot hold it
        with rasterio.open(dem, "r+") as file:
            file.update_tags(ns="", GDAL_NODATA="-99999")
    elif nodata is not None:
        with rasterio.open(dem, "r+") as file:
            file.nodata = nodata
    package = MapPackage.open(build(ortho, tmp_path / "m.gpkg", dem=dem))
    assert ground_m(package) == pytest.approx(plane_m(CENTRE[0]), abs=max(0.03, 0.51 * scale))


def test_feet_with_a_scale_are_both(tmp_path: Path, ortho: Path) -> None:
    dem = write_dem(tmp_path / "d.tif", metres=0.3048, scale=0.1, offset=100.0, dtype="int32", unit="ft")
    assert ground_m(ordered(ortho, dem)) == pytest.approx(plane_m(CENTRE[0]), abs=0.03)


@pytest.mark.parametrize(
    ("profile", "reason"),
    [
        ({"unit": "furlong fortnight"}, r"the unit of its heights, 'furlong fortnight', is not known; give --dem-unit"),
        ({"unit": "degree"}, "'degree', is not known"),
        ({"unit": "0.1 m"}, "'0.1 m', is not known"),
        ({"unit": "1/100 ft"}, "'1/100 ft', is not known"),
        ({"unit": "metre", "crs": "EPSG:32651+6360"}, "band is in 'metre', its vertical .* 'US survey foot'; give"),
        ({"crs": "EPSG:2264"}, "not say the unit of its heights, and its coordinates are in 'US survey foot'; give"),
        ({"crs": CRS.from_epsg(32651).to_3d().to_wkt()}, r"count from the ellipsoid .*--geoid.*--dem-datum"),
    ],
)  # fmt: skip
def test_a_unit_or_datum_that_is_not_known_is_asked_for(
    tmp_path: Path, ortho: Path, profile: dict[str, Any], reason: str
) -> None:
    dem = write_dem(tmp_path / "d.tif", **profile)
    with pytest.raises(MapError, match=reason) as caught:
        build(ortho, tmp_path / "m.gpkg", dem=dem)
    assert str(dem) in str(caught.value) and "\n" not in str(caught.value)
    if "2264" not in str(profile):
        ordered(ortho, dem, dem_unit=Unit.METRE, dem_datum=Datum.EGM96).close()


def test_a_stated_unit_and_datum_count_and_are_in_the_manifest(tmp_path: Path, ortho: Path) -> None:
    dem = write_dem(tmp_path / "d.tif", metres=LENGTHS["US survey foot"])
    package = ordered(ortho, dem, dem_unit=Unit.US_FOOT, dem_datum=Datum.EGM96)
    assert ground_m(package) == pytest.approx(plane_m(CENTRE[0]), abs=0.03)
    line = elevation_line(package)
    assert "US survey foot (--dem-unit)" in line and "egm96 (--dem-datum)" in line and "not stated" not in line


def test_what_is_assumed_of_a_plain_file_is_in_the_manifest_and_in_map_check(tmp_path: Path, ortho: Path) -> None:
    printed = io.StringIO()
    said = Console(file=printed, soft_wrap=True)
    package = ordered(ortho, write_dem(tmp_path / "d.tif"), say=said)
    line = elevation_line(package)
    assert line in printed.getvalue()
    assert "unit of heights not stated: metres" in line and "vertical datum not stated: EGM96" in line
    shown = CliRunner().invoke(app, ["map", "check", str(package.path)], catch_exceptions=False).output
    assert line in " ".join(shown.split())
    assert "unit of heights not stated: metres" in CliRunner().invoke(app, ["map", "info", str(package.path)]).output


@pytest.mark.parametrize("foot", [False, True])
def test_ellipsoidal_heights_of_the_file_are_converted_or_refused(tmp_path: Path, ortho: Path, foot: bool) -> None:
    """Without a word of the user: the coordinate system of the file has three dimensions."""
    dem = write_dem(tmp_path / "d.tif", crs=CRS.from_epsg(32651).to_3d().to_wkt(), metres=0.3048 if foot else 1.0)
    options: dict[str, Any] = {"dem_unit": Unit.FOOT} if foot else {}
    with pytest.raises(UsageError, match=r"count from the ellipsoid and no grid .*pyproj sync.*--geoid"):
        ordered(ortho, dem, **options)
    package = ordered(ortho, dem, geoid=write_geoid(tmp_path / "g.gtx"), **options)
    lat_deg, lon_deg = _centre_deg()
    geoid_m = 10.0 + 2.0 * (lon_deg - 120.0) + 3.0 * (lat_deg - 20.0)
    assert ground_m(package) == pytest.approx(plane_m(CENTRE[0]) - geoid_m, abs=0.03)
    assert undulation_m(0, 0) == pytest.approx(geoid_m, abs=0.1)  # the same grid as that of the other test
    assert "heights converted from ellipsoid to EGM96" in elevation_line(package)


@pytest.mark.parametrize(
    "name", ["WGS_1984", "GRS 1980 height", "D_WGS_1984", "NAD83(2011)", "ITRF2014", "Ellipsoid (metre)"]
)
def test_a_vertical_system_with_the_name_of_an_ellipsoid_counts_from_it(tmp_path: Path, ortho: Path, name: str) -> None:
    """As Esri writes ellipsoidal heights."""
    horizontal = CRS.from_epsg(32651).to_wkt("WKT1_GDAL")
    vertical = f'VERT_CS["{name}",VERT_DATUM["{name}",2005],UNIT["metre",1],AXIS["Up",UP]]'
    dem = write_dem(tmp_path / "d.tif", crs=f'COMPD_CS["c",{horizontal},{vertical}]')
    with pytest.raises(MapError, match="its heights count from the ellipsoid"):
        build(ortho, tmp_path / "m.gpkg", dem=dem)


def test_a_drape_of_a_simulated_flight_converts_feet_too(tmp_path: Path, ortho: Path) -> None:
    dem = write_dem(tmp_path / "d.tif", metres=0.3048, unit="ft")
    ground = open_ground(ortho, dem, LocalFrame(*_centre_deg()))
    assert float(ground.height_amsl_m(np.zeros(1), np.zeros(1))[0]) == pytest.approx(plane_m(CENTRE[0]), abs=1.0)


def test_every_elevation_of_the_field_has_its_height(data_set: Callable[[str], Path], tmp_path: Path) -> None:
    made(data_set, "dem-units", tmp_path)
    dems = sorted(tmp_path.glob("dem_*.tif"))
    assert len(dems) == 6
    for dem in dems:
        out = build(tmp_path / "ortho.tif", tmp_path / f"{dem.stem}.gpkg", dem=dem)
        lon_deg, lat_deg = rasterio.warp.transform("EPSG:26913", "EPSG:4326", [500_256], [4_399_744])
        with_dem = MapPackage.open(out)
        assert with_dem.ground_amsl_m(lat_deg[0], lon_deg[0]) == pytest.approx(1620.92, abs=0.1), dem.name
