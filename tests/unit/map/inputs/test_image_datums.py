"""Datums of images: not named, guessed, without their grids; and images that are placed by points or polynomials."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
import rasterio
from pyproj import CRS, Geod, Transformer
from rasterio.control import GroundControlPoint
from rasterio.rpc import RPC
from rasterio.transform import Affine
from typer.testing import CliRunner

import map_rasters
from field_case import made
from terrafix.core.errors import MapError
from terrafix.map.format import Ce90Origin
from terrafix.map.package import MapPackage
from terrafix_tools.cli import app
from terrafix_tools.mapping.build import build
from terrafix_tools.mapping.mosaic.accuracy import with_estimates
from terrafix_tools.mapping.mosaic.overlap import Offset
from terrafix_tools.mapping.statements import way_here

PIXELS = map_rasters.texture(200, 200)
ELLIPSOIDS = ["bessel", "intl", "clrk66", "krass", "airy", "evrst30", "GRS67", "helmert"]


def image(path: Path, crs: Any, x: float = 452_000.0, y: float = 5_333_000.0, pixel: float = 0.5) -> Path:
    return map_rasters.write_tif(path, PIXELS, crs, Affine(pixel, 0, x, 0, -pixel, y))


@pytest.mark.parametrize("ellipsoid", ELLIPSOIDS)
def test_a_datum_that_is_not_named_is_refused(tmp_path: Path, ellipsoid: str) -> None:
    """Datums on these ellipsoids are up to a kilometre apart; some of them GDAL would guess."""
    path = image(tmp_path / "i.tif", f"+proj=utm +zone=33 +ellps={ellipsoid} +units=m +no_defs")
    with pytest.raises(MapError, match=r"does not name its datum \(ellipsoid .*gdal_translate -a_srs") as caught:
        build(path, tmp_path / "m.gpkg", ce90_m=1.0)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_shift_of_zero_from_another_ellipsoid_is_no_datum(tmp_path: Path) -> None:
    path = image(tmp_path / "i.tif", "+proj=utm +zone=33 +ellps=bessel +towgs84=0,0,0 +units=m +no_defs")
    with pytest.raises(MapError, match="does not name its datum"):
        build(path, tmp_path / "m.gpkg")


def test_a_datum_without_a_way_to_wgs84_is_refused(tmp_path: Path) -> None:
    """PROJ knows no parameters for Beijing 1954 and would leave the datum out, about 100 m off."""
    with pytest.raises(MapError, match=r"'Beijing 1954' has no known way to WGS 84"):
        build(image(tmp_path / "i.tif", "EPSG:2437", 500_000.0, 4_400_000.0), tmp_path / "m.gpkg")


@pytest.mark.parametrize("ellipsoid", ["WGS84", "GRS80"])
def test_an_ellipsoid_about_the_earths_centre_is_wgs84_with_a_word_and_an_accuracy(
    tmp_path: Path, ellipsoid: str
) -> None:
    path = image(tmp_path / "i.tif", f"+proj=utm +zone=33 +ellps={ellipsoid} +units=m +no_defs")
    package = MapPackage.open(build(path, tmp_path / "m.gpkg", ce90_m=1.0))
    assert "datum not named: WGS 84 by its ellipsoid" in package.manifest.inputs[0].text()
    assert package.manifest.ce90_m == 4.0
    west, south, east, north = package.manifest.bounds_wgs84
    lon_deg, lat_deg = Transformer.from_crs(32633, 4326, always_xy=True).transform(452_050.0, 5_332_950.0)
    assert Geod(ellps="WGS84").inv((west + east) / 2, (south + north) / 2, lon_deg, lat_deg)[2] < 0.5


@pytest.mark.parametrize(
    ("crs", "x", "y"),
    [
        ("EPSG:27700", 651_409.804, 313_177.450),
        ("EPSG:26714", 539_000.0, 4_340_000.0),
        ("EPSG:31468", 4_468_000.0, 5_333_000.0),
        ("EPSG:26913", 500_000.0, 4_400_000.0),
        ("EPSG:25833", 452_000.0, 5_333_000.0),
        ("EPSG:28355", 500_000.0, 5_800_000.0),
        ("EPSG:32633", 452_000.0, 5_333_000.0),
    ],
)
def test_the_accuracy_is_not_below_what_proj_states_and_a_missing_grid_is_named(
    tmp_path: Path, crs: str, x: float, y: float
) -> None:
    transformer = Transformer.from_crs(crs, 4326, always_xy=True)
    transformer.transform(x + 50.0, y - 50.0)
    stated_m = transformer.get_last_used_operation().accuracy
    package = MapPackage.open(build(image(tmp_path / "i.tif", crs, x, y), tmp_path / "m.gpkg", ce90_m=0.5))
    assert package.manifest.ce90_m == max(0.5, stated_m)
    assert package.manifest.layers[0].ce90_origin is Ce90Origin.STATED
    line = package.manifest.inputs[0].text()
    assert package.manifest.inputs[0].accuracy_m == stated_m and f"{stated_m:g} m to WGS 84" in line
    assert ("instead of the stated 0.5 m, of its datum" in line) == (stated_m > 0.5)
    if crs in ("EPSG:27700", "EPSG:26714", "EPSG:31468"):
        assert "PROJ lacks the grid" in line and "pyproj sync --file" in line


def test_an_accuracy_that_is_not_stated_is_that_of_a_datum_worse_than_the_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("terrafix_tools.mapping.source.accuracy_to_wgs84", lambda *_: (25.0, ()))
    package = MapPackage.open(build(image(tmp_path / "i.tif", "EPSG:32633"), tmp_path / "m.gpkg"))
    layer = package.manifest.layers[0]
    assert (layer.ce90_m, layer.ce90_origin) == (25.0, Ce90Origin.DATUM)
    shown = CliRunner().invoke(app, ["map", "check", str(package.path)], catch_exceptions=False).output
    assert "25 m (CE90) is that of its datum" in " ".join(shown.split())
    apart = {(0, 1): Offset(east_m=0.0, north_m=0.0, scatter_m=0.1, patches=9)}
    unknown = msgspec.structs.replace(layer, ce90_m=None, ce90_origin=Ce90Origin.DEFAULT)
    other = with_estimates((layer, unknown), apart)
    assert other[0].ce90_m == 25.0 and other[1].ce90_origin is Ce90Origin.ESTIMATED


def test_a_vehicle_without_the_grid_of_the_build_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("terrafix_tools.mapping.source.accuracy_to_wgs84", lambda *_: (1.0, ()))
    package = MapPackage.open(
        build(image(tmp_path / "i.tif", "EPSG:27700", 651_409.804, 313_177.450), tmp_path / "m.gpkg")
    )
    text = way_here(package)
    assert text is not None and "are good to 2 m here, and were to 1 m where the map was built" in text
    plain = MapPackage.open(build(image(tmp_path / "w.tif", "EPSG:32633"), tmp_path / "w.gpkg"))
    assert way_here(plain) is None


def test_a_named_datum_without_a_code_is_that_datum(tmp_path: Path) -> None:
    """WKT of Esri, in which no authority is named: ED50, and WGS 84."""
    for code in (23033, 32633):
        wkt = CRS.from_epsg(code).to_wkt("WKT1_ESRI")
        package = MapPackage.open(build(image(tmp_path / "i.tif", wkt), tmp_path / "m.gpkg"))
        lon_deg, lat_deg = Transformer.from_crs(code, 4326, always_xy=True).transform(452_050.0, 5_332_950.0)
        west, south, east, north = package.manifest.bounds_wgs84
        assert Geod(ellps="WGS84").inv((west + east) / 2, (south + north) / 2, lon_deg, lat_deg)[2] < 0.5


def test_the_datums_of_the_field(data_set: Callable[[str], Path], tmp_path: Path) -> None:
    made(data_set, "datum", tmp_path)
    for name in ("unknown_bessel", "unknown_datum"):
        with pytest.raises(MapError, match="does not name its datum"):
            build(tmp_path / f"{name}.tif", tmp_path / "m.gpkg", ce90_m=1.0)
    places = {"osgb": (52 + 39 / 60 + 28.8282 / 3600, 1 + 42 / 60 + 57.8663 / 3600)}
    places["nad27"] = (39 + 13 / 60 + 26.7122 / 3600, -(98 + 32 / 60 + 31.74604 / 3600))
    for name, (lat_deg, lon_deg) in places.items():
        package = MapPackage.open(build(tmp_path / f"{name}.tif", tmp_path / "m.gpkg", ce90_m=1.0))
        west, south, east, north = package.manifest.bounds_wgs84
        off_m = Geod(ellps="WGS84").inv((west + east) / 2, (south + north) / 2, lon_deg, lat_deg)[2]
        assert package.manifest.ce90_m is not None and package.manifest.ce90_m >= 2.0
        assert off_m < 0.1 or "PROJ lacks the grid" in package.manifest.inputs[0].text()
        assert off_m < 2.0 * package.manifest.ce90_m
    shifted = MapPackage.open(build(tmp_path / "towgs84.tif", tmp_path / "m.gpkg"))
    assert "the file states its own shift to WGS 84" in shifted.manifest.inputs[0].text()


def gcps() -> list[GroundControlPoint]:
    corners = ((0, 0), (0, 200), (200, 0), (200, 200))
    return [GroundControlPoint(row, col, 14.0 + 1e-5 * col, 48.0 - 1e-5 * row, 0.0) for row, col in corners]


def rpc() -> RPC:
    line, sample = [0.0] * 20, [0.0] * 20
    line[2], sample[1] = -1.0, 1.0
    one = [1.0] + [0.0] * 19
    return RPC(
        height_off=300.0, height_scale=100.0, lat_off=48.0, lat_scale=0.01, line_den_coeff=one, line_num_coeff=line,
        line_off=100.0, line_scale=100.0, long_off=14.0, long_scale=0.01, samp_den_coeff=one, samp_num_coeff=sample,
        samp_off=100.0, samp_scale=100.0, err_bias=None, err_rand=None,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("placed", "command"),
    [
        ({"gcps": gcps(), "crs": "EPSG:4326"}, r"4 ground control points only; .*gdalwarp -tps .*-t_srs EPSG:32633"),
        ({"rpcs": rpc()}, r"\(RPC\) only; .*gdalwarp -rpc -to RPC_DEM=DEM.tif .*-t_srs EPSG:32633"),
        ({}, "has no georeference; give a GeoTIFF"),
    ],
)
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_an_image_without_a_grid_names_the_command_that_makes_one(
    tmp_path: Path, placed: dict[str, Any], command: str
) -> None:
    path = tmp_path / "i.tif"
    with rasterio.open(path, "w", driver="GTiff", width=200, height=200, count=3, dtype="uint8", **placed) as file:
        file.write(PIXELS)
    with pytest.raises(MapError, match=command):
        build(path, tmp_path / "m.gpkg")
    with pytest.raises(MapError, match=command.split("only")[0]):  # as elevation, too
        build(image(tmp_path / "o.tif", "EPSG:32633"), tmp_path / "m.gpkg", dem=one_band(tmp_path / "d.tif", placed))


def one_band(path: Path, placed: dict[str, Any]) -> Path:
    with rasterio.open(path, "w", driver="GTiff", width=200, height=200, count=1, dtype="uint8", **placed) as file:
        file.write(PIXELS[:1])
    return path
