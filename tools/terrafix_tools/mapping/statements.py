"""What the inputs of a package were taken for, as lines of its manifest."""

from collections.abc import Sequence

import msgspec

from terrafix.core.config import Map
from terrafix.map.format import Ce90Origin, InputStatement
from terrafix.map.package import MapPackage
from terrafix_tools.mapping.ways import way_to_wgs84

IMAGERY = "imagery"


def accuracy_with_datum(
    ce90_m: float | None, statements: Sequence[InputStatement]
) -> tuple[float | None, Ce90Origin, str]:
    """CE90 of a layer, its origin, and a word where the datum limits it: it is not below the accuracy of the worst way
    to WGS 84 among its sources, as PROJ states that. ``ce90_m``: as the producer states it, None: unknown."""
    worst_m = max((s.accuracy_m for s in statements if s.accuracy_m is not None), default=0.0)
    if ce90_m is None:
        if worst_m <= Map().ce90_m:
            return None, Ce90Origin.DEFAULT, ""
        return worst_m, Ce90Origin.DATUM, f"CE90 {worst_m:g} m, of its datum"
    if worst_m <= ce90_m:
        return ce90_m, Ce90Origin.STATED, ""
    return worst_m, Ce90Origin.STATED, f"CE90 {worst_m:g} m instead of the stated {ce90_m:g} m, of its datum"


def merged(statements: Sequence[InputStatement], limited: str) -> list[InputStatement]:
    """One statement for each kind of source, with a count of those that are alike; ``limited`` is added to each."""
    alike: dict[InputStatement, list[str]] = {}
    for statement in statements:
        alike.setdefault(msgspec.structs.replace(statement, name=""), []).append(statement.name)
    lines = []
    for common, names in alike.items():
        different = list(dict.fromkeys(names))
        name = different[0] if len(different) == 1 else f"{different[0]} and {len(different) - 1} more"
        assumed = (*common.assumed, limited) if limited else common.assumed
        lines.append(msgspec.structs.replace(common, name=name, assumed=assumed))
    return lines


def way_here(package: MapPackage) -> str | None:
    """A word when this computer's PROJ takes a worse way from the package's coordinate system to WGS 84 than the one at
    its build: the package keeps its coordinate system, and positions are converted in flight. None: as good."""
    stated = [s.accuracy_m for s in package.manifest.inputs if s.kind == IMAGERY and s.accuracy_m is not None]
    if not stated:
        return None
    layer = package.layer(None)
    x, y = (layer.bounds[0] + layer.bounds[2]) / 2, (layer.bounds[1] + layer.bounds[3]) / 2
    way = way_to_wgs84(package.crs, x, y)
    if way.accuracy_m is None or way.accuracy_m <= max(stated):
        return None
    return (
        f"positions in '{package.crs.name}' are good to {way.accuracy_m:g} m here, and were to {max(stated):g} m where "
        f"the map was built: PROJ uses '{way.name}'"
    )
