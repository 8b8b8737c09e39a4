"""Outlines of a KML file, also in a KMZ archive: polygons, lines, tracks, and the way points of DJI's planners.

Formats: OGC KML 2.3 (12-007r2), gx:Track of Google's extensions to KML 2.2, DJI WPML (a KMZ with wpmz/waylines.wpml,
the flown route, and wpmz/template.kml)."""

import re
import xml.etree.ElementTree as ElementTree
import zipfile
import zlib
from pathlib import Path

import numpy as np

from terrafix.core.errors import UsageError
from terrafix_tools.text_file import decode_text

SUFFIXES = (".kml", ".kmz", ".wpml")
ZIP = b"PK\x03\x04"
MAX_KML_BYTES = 64 << 20  # of a document in an archive
FLOWN_ROUTE = "wpmz/waylines.wpml"
DECLARATION = re.compile(r"^\s*<\?xml[^>]*\?>")
MAX_NUMBERS = 3  # of a position: longitude, latitude, height

Shape = tuple[bool, str, np.ndarray]  # closed, its kind, (n, 2) longitude and latitude in degrees


def kml_shapes(path: Path, data: bytes) -> tuple[list[Shape], tuple[str, ...]]:
    """The shapes in order, and notes about what was assumed or left out. Holes count as area, because a vehicle may
    cross them. Points count only where there is nothing else: as a path in their order. Raises UsageError."""
    root = _root(path, _document(path, data) if data.startswith(ZIP) else data)
    within = {id(ring) for polygon in root.iter() if _kind(polygon) == "Polygon" for ring in polygon.iter()}
    shapes: list[Shape] = []
    places: list[np.ndarray] = []
    for element in root.iter():
        kind = _kind(element)
        where = f"{path} {kind} {len(shapes) + 1}"
        if kind == "Polygon":
            outer = element.find("{*}outerBoundaryIs")
            shapes.append((True, kind, _points(where, "" if outer is None else _coordinates(outer))))
        elif kind == "LinearRing" and id(element) not in within:
            shapes.append((True, kind, _points(where, _coordinates(element))))
        elif kind == "LineString":
            shapes.append((False, kind, _points(where, _coordinates(element))))
        elif kind == "Track":
            coords = [",".join((coord.text or "").split()) for coord in element.findall("{*}coord")]
            shapes.append((False, kind, _points(where, " ".join(coords))))
        elif kind == "Point":
            places.append(_points(f"{path} Point {len(places) + 1}", _coordinates(element)))
    links = [link for link in root.iter() if _kind(link) == "NetworkLink"]
    if links and not shapes and not places:
        href = " ".join((links[0].findtext(".//{*}href") or "another document").split())
        raise UsageError(f"{path}: has no shape of its own, only a link to {href}; save what it shows as KML")
    count = sum(len(place) for place in places)
    notes = (f"{len(links)} link(s) to other documents are not followed",) if links else ()
    if shapes and count:
        return shapes, (*notes, f"{count} point(s) beside the outlines are left out")
    if count > 1:
        text = f"its {count} points are read as way points, in their order"
        return [(False, "Points", np.concatenate(places))], (*notes, text)
    return shapes, notes


def _kind(element: ElementTree.Element) -> str:
    return element.tag.rpartition("}")[2]


def _coordinates(element: ElementTree.Element) -> str:
    node = element.find(".//{*}coordinates")
    return "" if node is None else node.text or ""


def _document(path: Path, data: bytes) -> bytes:
    """The document of an archive: DJI's flown route, else doc.kml, else the only .kml."""
    try:
        # Opened from the path and not from ``data``: an archive in an archive is no case.
        with zipfile.ZipFile(path) as archive:
            names = {info.filename.replace("\\", "/").lower(): info for info in archive.infolist()}
            documents = [name for name in names if name.endswith(".kml")]
            chosen = next((name for name in (FLOWN_ROUTE, "doc.kml") if name in names), None)
            if chosen is None and not documents:
                raise UsageError(f"{path}: an archive without a .kml; give the .kml or .geojson of the area")
            info = names[chosen or sorted(documents, key=lambda name: (name.count("/"), name))[0]]
            if info.file_size > MAX_KML_BYTES:
                raise UsageError(f"{path}: its {info.filename} has {info.file_size >> 20} MB; give a smaller area")
            with archive.open(info) as file:
                return file.read(MAX_KML_BYTES)
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, NotImplementedError, ValueError) as error:
        raise UsageError(f"{path}: not an archive that can be read ({error}); export the area as KML again") from None


def _root(path: Path, data: bytes) -> ElementTree.Element:
    """The document in its declared encoding, else in the one that it has: names may be in another than declared."""
    try:
        return ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError):
        pass
    try:
        return ElementTree.fromstring(DECLARATION.sub("", decode_text(data)))
    except (ElementTree.ParseError, ValueError) as error:
        raise UsageError(f"{path}: not valid XML ({error}); export the area as KML again") from None


def _points(where: str, text: str) -> np.ndarray:
    """ "lon,lat[,height] lon,lat ...", also with spaces behind the commas -> (n, 2)."""
    tuples = [part.split(",") for part in re.sub(r"\s*,\s*", ",", text.strip()).split()]
    if any(len(numbers) > MAX_NUMBERS for numbers in tuples):
        raise UsageError(
            f"{where}: a position of more than {MAX_NUMBERS} numbers, as decimal commas make it; export it with points"
        )
    try:
        return np.array([[float(number) for number in numbers[:2]] for numbers in tuples], float).reshape(-1, 2)
    except ValueError:
        raise UsageError(f"{where}: its coordinates are no numbers; export the area again") from None
