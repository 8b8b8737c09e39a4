"""OpenStreetMap from an extract (.osm.pbf, also .osm and .osm.bz2), read with libosmium in memory."""

from collections.abc import Iterator
from pathlib import Path

import osmium

from terrafix.core.errors import MapError
from terrafix_tools.mapping.area.polygons import Area
from terrafix_tools.mapping.layers import Feature
from terrafix_tools.mapping.vectors.near import AreaFilter
from terrafix_tools.mapping.vectors.tags import TABLES, is_surface, line_wkb, polygon_wkb, table_of

KEYS = tuple(key for keys in TABLES.values() for key in keys)


def pbf_features(path: Path, area: Area) -> Iterator[Feature]:
    """Features of an extract. Raises MapError: missing, not an extract, damaged."""
    if not path.is_file():
        raise MapError(f"{path}: no such file; check --osm")
    nearby = AreaFilter(area)
    wanted = osmium.filter.KeyFilter(*KEYS)
    try:
        objects = osmium.FileProcessor(path).with_areas(wanted).with_filter(wanted)
        for thing in objects:
            if isinstance(thing, osmium.osm.Way):
                yield from _line(thing, nearby)
            elif isinstance(thing, osmium.osm.Area):
                yield from _surface(thing, nearby)
    except RuntimeError as error:
        raise MapError(f"{path}: cannot be read as an OpenStreetMap extract ({error}); download it again") from None


def _line(way: osmium.osm.Way, nearby: AreaFilter) -> Iterator[Feature]:
    """A way as a line feature; outlines of surfaces are skipped, because libosmium yields them as areas."""
    tags = {tag.k: tag.v for tag in way.tags}
    placed = table_of(tags)
    if placed is None or (way.is_closed() and is_surface(placed[0], tags)) or placed[0] == "buildings":
        return
    points = [(node.lon, node.lat) for node in way.nodes if node.location.valid()]
    if len(points) >= 2 and nearby.has(points):
        yield placed[0], line_wkb(points), placed[1]


def _surface(area: osmium.osm.Area, nearby: AreaFilter) -> Iterator[Feature]:
    tags = {tag.k: tag.v for tag in area.tags}
    placed = table_of(tags)
    if placed is None or not is_surface(placed[0], tags):
        return
    for outer in area.outer_rings():
        rings = [[(n.lon, n.lat) for n in ring] for ring in (outer, *area.inner_rings(outer))]
        if nearby.has(rings[0], surface=True):
            yield placed[0], polygon_wkb(rings), placed[1]
