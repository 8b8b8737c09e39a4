"""OpenStreetMap from an Overpass server, in cached boxes (wiki.openstreetmap.org, Overpass API; `out geom`)."""

import gzip
import hashlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import msgspec
import numpy as np

from terrafix.core.errors import MapError, OutputError
from terrafix_tools.mapping.area.polygons import Area
from terrafix_tools.mapping.fetching.fetch import Client, Damaged
from terrafix_tools.mapping.fetching.pace import Limits
from terrafix_tools.mapping.fetching.progress import DownloadProgress, OnProgress
from terrafix_tools.mapping.layers import Feature
from terrafix_tools.mapping.vectors.near import AreaFilter
from terrafix_tools.mapping.vectors.rings import Ring, polygons_of
from terrafix_tools.mapping.vectors.tags import is_surface, line_wkb, polygon_wkb, table_of

PUBLIC = "https://overpass-api.de/api/interpreter"
LIMITS = Limits(requests_per_s=0.5, connections=1, timeout_s=240.0)  # low: the servers are run by volunteers
BOX_DEG = 0.1  # about 7 x 11 km: the response for a town stays below a few ten megabytes
SERVER_S = 180  # time-out of the server for one box
QUERY = """[out:json][timeout:{seconds}][bbox:{south:.6f},{west:.6f},{north:.6f},{east:.6f}];
(way["highway"];way["railway"];way["waterway"];way["building"];
way["natural"~"^(water|bay)$"];way["landuse"~"^(reservoir|basin)$"];
rel["type"="multipolygon"]["natural"="water"];rel["type"="multipolygon"]["waterway"="riverbank"];
rel["type"="multipolygon"]["building"];);
out geom;"""


def fetch_overpass(url: str, area: Area, cache: Path, on_progress: OnProgress, limits: Limits = LIMITS) -> list[Path]:
    """Fetches one file per box, cached between runs. Raises FetchError, RefusedError, MapError, OutputError."""
    client = Client(url.split("/")[2], limits)
    folder = cache / ("overpass-" + hashlib.sha256((url + QUERY).encode()).hexdigest()[:16])
    nearby = AreaFilter(area)
    boxes = [box for box in _boxes(area) if nearby.meets(*box)]
    progressed = DownloadProgress(len(boxes))
    paths = []
    for west, south, east, north in boxes:
        path = folder / f"{west:.1f}_{south:.1f}.json.gz"
        paths.append(path)
        if not path.is_file():
            query = QUERY.format(seconds=SERVER_S, south=south, west=west, north=north, east=east)
            body = urlencode({"data": query}).encode()
            headers = {"Content-Type": "application/x-www-form-urlencoded"}
            response = client.request("POST", url, headers=headers, body=body, check=_check)
            if response is None:
                raise MapError(f"{url}: nothing there; give the address of an Overpass interpreter")
            _write_file(path, response)
            progressed.size_bytes += len(response)
        progressed.tiles += 1
        on_progress(progressed)
    return paths


def overpass_features(paths: list[Path], area: Area) -> Iterator[Feature]:
    """Features of the files; an object in several boxes is yielded once. Raises MapError: a cached file is damaged."""
    nearby = AreaFilter(area)
    seen: set[tuple[str, int]] = set()
    for path in paths:
        try:
            elements = msgspec.json.decode(gzip.decompress(path.read_bytes()))["elements"]
        except (OSError, EOFError, msgspec.DecodeError, KeyError) as error:
            raise MapError(f"{path}: damaged ({error}); delete it and run again") from None
        for element in elements:
            key = element["type"], element["id"]
            if key not in seen:
                seen.add(key)
                yield from _features(element, nearby)


def _features(element: dict[str, Any], nearby: AreaFilter) -> Iterator[Feature]:
    tags = element.get("tags", {})
    placed = table_of(tags)
    if placed is None:
        return
    table, attributes = placed
    if element["type"] == "way":
        points = _points(element)
        surface = len(points) >= 4 and points[0] == points[-1] and is_surface(table, tags)
        if len(points) < 2 or not nearby.has(points, surface=surface):
            return
        if surface:
            yield table, polygon_wkb([points]), attributes
        elif table != "buildings":
            yield table, line_wkb(points), attributes
    elif element["type"] == "relation":
        members = [m for m in element.get("members", []) if m.get("type") == "way"]
        outer = [_points(m) for m in members if m.get("role") in ("outer", "")]
        inner = [_points(m) for m in members if m.get("role") == "inner"]
        for polygon in polygons_of(outer, inner):
            if nearby.has(polygon[0], surface=True):
                yield table, polygon_wkb(polygon), attributes


def _points(element: dict[str, Any]) -> Ring:
    return [(p["lon"], p["lat"]) for p in element.get("geometry", []) if p]


def _boxes(area: Area) -> Iterator[tuple[float, float, float, float]]:
    """West, south, east, north on a fixed grid, so that neighbouring areas share cached boxes."""
    west, south, east, north = area.bounds_deg
    for row in range(math.floor(south / BOX_DEG), math.floor(north / BOX_DEG) + 1):
        for column in range(math.floor(west / BOX_DEG), math.floor(east / BOX_DEG) + 1):
            corners = np.round([column * BOX_DEG, row * BOX_DEG, (column + 1) * BOX_DEG, (row + 1) * BOX_DEG], 6)
            yield float(corners[0]), float(corners[1]), float(corners[2]), float(corners[3])


def _check(data: bytes) -> None:
    """Overpass returns status 200 also after a time-out; then `remark` reports it and elements are missing."""
    try:
        response = msgspec.json.decode(data)
        remark, elements = response.get("remark", ""), response["elements"]
    except (msgspec.DecodeError, AttributeError, KeyError):
        raise Damaged("no Overpass JSON") from None
    if "error" in remark or not isinstance(elements, list):
        raise Damaged(f"the server gave up: {remark[:100]}")


def _write_file(path: Path, data: bytes) -> None:
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(gzip.compress(data, 6))
        part.replace(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); check the space") from None
