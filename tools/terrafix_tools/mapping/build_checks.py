"""Checks before a build: position of the imagery, output path, date."""

import datetime
from pathlib import Path

from pyproj import Transformer

from terrafix.core.errors import MapError, OutputError, UsageError
from terrafix_tools.mapping.area.checks import POLAR_DEG
from terrafix_tools.mapping.imagery import Imagery


def check_reach(imagery: Path, source: Imagery) -> None:
    """Raises MapError: across the antimeridian, where west is greater than east, or polar."""
    to_wgs84 = Transformer.from_crs(source.crs, 4326, always_xy=True)
    west, south, east, north = to_wgs84.transform_bounds(*source.bounds, densify_pts=51)
    if west > east:
        raise MapError(
            f"{imagery}: crosses the antimeridian (180 degrees); build a map for each side of it, with --area"
        )
    farthest_deg = max(south, north, key=abs)
    if abs(farthest_deg) > POLAR_DEG:
        raise MapError(
            f"{imagery}: reaches {farthest_deg:.2f} degrees of latitude, maps end at {POLAR_DEG:g}; "
            "build a part of it, with --area"
        )


def check_out(out: Path, imagery: Path | None = None) -> None:
    """Raises OutputError: no folder or no name for a package, or the imagery itself."""
    if out.is_dir():
        raise OutputError(f"{out}: is a folder; give the name of a file to write, for example {out / 'map.gpkg'}")
    if out.suffix.lower() != ".gpkg":
        raise OutputError(f"{out}: a map package is a GeoPackage; let its name end in .gpkg")
    if out.exists() and not out.is_file():
        raise OutputError(f"{out}: exists and is not a regular file; give another --out")
    if imagery is not None and out.exists() and imagery.exists() and out.samefile(imagery):
        raise OutputError(f"{out}: would overwrite the imagery; give another --out")


def check_date(date: str) -> None:
    """Raises UsageError unless it is empty or YYYY-MM-DD."""
    try:
        good = not date or datetime.date.fromisoformat(date).isoformat() == date
    except ValueError:
        good = False
    if not good:
        raise UsageError(f"date '{date}' of the imagery: write it YYYY-MM-DD")
