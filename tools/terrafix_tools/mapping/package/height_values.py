"""What the values of an elevation raster are: unit, scale and offset, and the surface that they count from.

A value is (raw scale + offset) units (GDAL raster data model). The unit is that of the band, else of the vertical
coordinate system; GDAL reports the latter as the former for GeoTIFF. Lengths of units are those of PROJ's database."""

import math
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS
from pyproj.database import get_units_map

from terrafix.core.errors import MapError
from terrafix.map.format import InputStatement
from terrafix_tools.mapping.choices import Datum, Unit
from terrafix_tools.mapping.datum import check_datum, stated_crs
from terrafix_tools.mapping.ways import accuracy_to_wgs84

US_FOOT, FOOT, METRE = "US survey foot", "foot", "metre"
SHORT = {  # letters of a unit as programs write it -> its name in PROJ's database
    "m": METRE, "meter": METRE, "ft": FOOT, "feet": FOOT, "international foot": FOOT, "international feet": FOOT,
    "foot international": FOOT, "foot intl": FOOT, "ft intl": FOOT,
    "us ft": US_FOOT, "ft us": US_FOOT, "ftus": US_FOOT, "usft": US_FOOT, "foot us": US_FOOT, "feet us": US_FOOT,
    "us foot": US_FOOT, "us feet": US_FOOT, "us survey feet": US_FOOT, "survey foot": US_FOOT, "survey feet": US_FOOT,
    "us survey ft": US_FOOT, "sft": US_FOOT, "cm": "centimetre", "centimeter": "centimetre", "mm": "millimetre",
    "millimeter": "millimetre", "km": "kilometre", "kilometer": "kilometre", "yd": "yard", "fathom": "fathom",
}  # fmt: skip
DECIMETRES = {"dm", "decimetre", "decimeter"}  # PROJ's database (9.5) gives a decimeter 0.01 m
OF_UNIT = {Unit.METRE: METRE, Unit.FOOT: FOOT, Unit.US_FOOT: US_FOOT}
# Of a vertical system that is named as its ellipsoid or geodetic datum, as Esri's are, the heights count from it.
ELLIPSOIDAL = re.compile(r"ellips|^d?(wgs|grs|itrf|etrs)\d|^d?nad(19)?83")
SAME = 1e-5  # relative: a foot and a US survey foot are one to a height


@dataclass(frozen=True)
class Heights:
    """``unit_m``: metres of a unit, negative for depths. ``datum``: None when the file names one that is neither of
    these: ``vertical``, its vertical coordinate system. ``assumed``: what the file does not say."""

    unit: str
    unit_m: float
    scale: float
    offset: float
    datum: Datum | None
    datum_name: str
    vertical: CRS | None
    assumed: tuple[str, ...]

    def to_m(self, raw: np.ndarray) -> np.ndarray:
        """Values of the file in metres; raw values that are metres are returned as they are."""
        if (self.unit_m, self.scale, self.offset) == (1.0, 1.0, 0.0):
            return raw
        metres: np.ndarray = (raw.astype(np.float64) * self.scale + self.offset) * self.unit_m
        return metres.astype(np.float32)


def heights_of(file: Any, where: str, unit: Unit | None = None, stated: Datum | None = None) -> Heights:
    """``file``: an open raster of rasterio; ``unit`` and ``stated`` (datum): as the user states them.

    Raises MapError: a unit that is not known, that contradicts the coordinate system, or that must be stated."""
    scale, offset = float(file.scales[0]), float(file.offsets[0])
    if not (math.isfinite(scale) and math.isfinite(offset)) or scale == 0.0:
        raise MapError(f"{where}: scale {scale:g} and offset {offset:g} of its band are no numbers; set them again")
    crs = stated_crs(file, Path(where))
    vertical = _vertical(crs)
    axis = vertical.axis_info[-1] if vertical else crs.axis_info[2] if crs and len(crs.axis_info) == 3 else None
    assumed: list[str] = []
    try:
        band = (file.units[0] or "").strip()
    except UnicodeDecodeError:
        raise MapError(f"{where}: the unit of its heights is no text; give --dem-unit m, ft or us-ft") from None
    if unit is not None:
        name, unit_m = OF_UNIT[unit], _metres(OF_UNIT[unit])
        assert unit_m is not None
        name += " (--dem-unit)"
    elif band:
        name, unit_m = band, _metres(band)
        if unit_m is None:
            raise MapError(f"{where}: the unit of its heights, '{band}', is not known; give --dem-unit m, ft or us-ft")
        if axis and abs(unit_m / axis.unit_conversion_factor - 1.0) > SAME:
            raise MapError(
                f"{where}: the band is in '{band}', its vertical coordinate system in '{axis.unit_name}'; "
                "give --dem-unit m, ft or us-ft"
            )
    elif axis:
        name, unit_m = axis.unit_name, float(axis.unit_conversion_factor)
    else:
        name, unit_m = METRE, 1.0
        across = "" if crs is None or crs.is_geographic else crs.axis_info[0].unit_name
        if across and _metres(across) != 1.0:
            raise MapError(
                f"{where}: does not say the unit of its heights, and its coordinates are in '{across}'; "
                "give --dem-unit m, ft or us-ft"
            )
        assumed.append("unit of heights not stated: metres")
    if axis is not None and axis.direction == "down":
        name, unit_m = f"{name}, downwards", -unit_m
    datum, datum_name = _datum(crs, vertical)
    if stated is not None:
        instead = f", instead of {datum_name}" if datum_name and datum is not stated else ""
        datum, datum_name = stated, f"{stated} (--dem-datum{instead})"
    elif datum is Datum.EGM96 and not datum_name:
        datum_name = "EGM96"
        assumed.append("vertical datum not stated: EGM96 (--dem-datum)")
    return Heights(name, unit_m, scale, offset, datum, datum_name, vertical, tuple(assumed))


def check_amsl(heights: Heights, path: Path) -> None:
    """Raises MapError: heights that count from the ellipsoid, which is up to 106 m beside mean sea level."""
    if heights.datum is Datum.ELLIPSOID:
        raise MapError(
            f"{path}: its heights count from the ellipsoid ('{heights.datum_name}'); terrafix map build converts them "
            "(--geoid), or takes them for others (--dem-datum)"
        )


def height_statement(
    file: Any, path: Path, heights: Heights, crs: CRS, centre: tuple[float, float], note: str = ""
) -> InputStatement:
    """``crs``, ``centre``: horizontal coordinate system and a place in it; ``note``: what was done with the heights."""
    values = "" if (heights.scale, heights.offset) == (1.0, 0.0) else f", x {heights.scale:g} + {heights.offset:g}"
    assumed = check_datum(file, path)
    accuracy_m, missing = accuracy_to_wgs84(crs, *centre, assumed)
    return InputStatement(
        name=path.name,
        kind="elevation",
        unit=f"heights in {heights.unit}{values}",
        datum=f"{crs.name}, heights above {heights.datum_name}",
        accuracy_m=accuracy_m,
        assumed=(*heights.assumed, *([note] if note else []), *assumed, *missing),
    )


@cache
def _lengths() -> dict[str, float]:
    return {name.lower(): unit.conv_factor for name, unit in get_units_map(category="linear").items()}


def _metres(unit: str) -> float | None:
    """Length of a unit by its name or abbreviation; None: not known."""
    names = [unit.strip().lower()]
    if not re.search(r"\d", unit):  # "0.1 m" and "1/100 ft" are no names of units
        letters = " ".join(re.findall(r"[a-z]+", unit.lower().replace(".", "")))
        names += [letters, letters.removesuffix("s")]
    for name in names:
        if name in DECIMETRES:
            return 0.1
        if (found := _lengths().get(SHORT.get(name, name).lower())) is not None:
            return found
    return None


def _vertical(crs: CRS | None) -> CRS | None:
    parts = [] if crs is None or not crs.is_compound else crs.sub_crs_list
    return next((part for part in parts if part.is_vertical), None)


def _datum(crs: CRS | None, vertical: CRS | None) -> tuple[Datum | None, str]:
    """Datum, and its name; EGM96 and "": not stated. None: another one."""
    if vertical is None:
        three = crs is not None and len(crs.axis_info) == 3
        return (Datum.ELLIPSOID, "ellipsoid") if three else (Datum.EGM96, "")
    name = re.sub(r"[\s_]", "", vertical.name.lower())
    if "egm96" in name:
        return Datum.EGM96, vertical.name
    if "egm2008" in name or "egm08" in name:
        return Datum.EGM2008, vertical.name
    if ELLIPSOIDAL.search(name):
        return Datum.ELLIPSOID, vertical.name
    if name in ("", "unknown", "unnamed"):
        return Datum.EGM96, ""
    return None, vertical.name
