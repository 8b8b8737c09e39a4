"""Map packages of tests: opened in a local frame at their centre, and altered."""

import sqlite3
from pathlib import Path

from terrafix.core.geodesy import LocalFrame
from terrafix.map.package import LocalMap, MapPackage


def centre_of(package: MapPackage | Path) -> LocalFrame:
    """-> a local frame with its origin at the centre of the map."""
    opened = MapPackage.open(package) if isinstance(package, Path) else package
    west, south, east, north = opened.manifest.bounds_wgs84
    if isinstance(package, Path):
        opened.close()
    return LocalFrame((south + north) / 2, (west + east) / 2)


def bound(package: MapPackage | Path) -> LocalMap:
    opened = MapPackage.open(package) if isinstance(package, Path) else package
    return opened.bind(centre_of(opened))


def alter(package: Path, statement: str, *values: object) -> None:
    """Changes the file by SQL, without its triggers: they call functions that only GeoPackage editors provide."""
    db = sqlite3.connect(package)
    for (trigger,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
        db.execute(f'DROP TRIGGER "{trigger}"')
    db.execute(statement, values)
    db.commit()
    db.close()
