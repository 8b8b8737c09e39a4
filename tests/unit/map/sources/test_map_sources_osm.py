"""Roads, water and buildings of OpenStreetMap: an extract and a server give the same features."""

import json
import struct
from pathlib import Path
from urllib.parse import parse_qs

import numpy as np
import osmium
import pytest

from map_servers import Reply, Request, serving
from terrafix.core.errors import MapError
from terrafix_tools.mapping.area.files import read_area
from terrafix_tools.mapping.fetching.fetch import FetchError
from terrafix_tools.mapping.fetching.pace import Limits
from terrafix_tools.mapping.layers import Feature
from terrafix_tools.mapping.vectors.overpass import fetch_overpass, overpass_features
from terrafix_tools.mapping.vectors.pbf import pbf_features
from terrafix_tools.mapping.vectors.rings import polygons_of

AREA = read_area("13.00,47.00,13.05,47.05", buffer_km=0.0)
FAST = Limits(500.0, 1, first_wait_s=0.01)
NODES = {
    1: (13.01, 47.01), 2: (13.02, 47.01), 3: (13.02, 47.02), 4: (13.01, 47.02),  # a square
    5: (13.012, 47.012), 6: (13.018, 47.012), 7: (13.015, 47.018),  # a triangle in it
    8: (12.90, 47.03), 9: (13.15, 47.031),  # from far west to far east
    10: (14.0, 47.0), 11: (14.1, 47.0), 12: (14.1, 47.1),  # another place
    13: (12.9, 46.9), 14: (13.2, 46.9), 15: (13.2, 47.2), 16: (12.9, 47.2),  # around everything
}  # fmt: skip
WAYS = {
    100: ([1, 2, 3, 4, 1], {"building": "yes", "name": "Hall <1>"}),
    101: ([8, 9], {"highway": "primary", "surface": "asphalt", "ref": "B1"}),
    102: ([1, 2, 3, 1], {"highway": "footway"}),  # a road around a block is a line
    103: ([2, 3], {"waterway": "river", "name": "Mur"}),
    104: ([3, 4], {"highway": "proposed"}),
    105: ([3, 4], {"waterway": "stream", "tunnel": "culvert"}),
    106: ([10, 11, 12, 10], {"building": "yes"}),
    107: ([5, 6, 7, 5], {"natural": "wood"}),
    110: ([1, 2, 3], {}), 111: ([1, 4, 3], {}), 112: ([5, 6], {}), 113: ([6, 7, 5], {}),
    114: ([13, 14, 15, 16, 13], {"natural": "water", "name": "Sea"}),
}  # fmt: skip
RELATIONS = {
    200: (
        [(110, "outer"), (111, "outer"), (112, "inner"), (113, "inner")],
        {"type": "multipolygon", "natural": "water"},
    ),
}


def write_osm(path: Path) -> Path:
    lines = ['<osm version="0.6">']
    lines += [f'<node id="{i}" version="1" lon="{x}" lat="{y}"/>' for i, (x, y) in NODES.items()]
    for i, (refs, tags) in WAYS.items():
        inner = "".join(f'<nd ref="{r}"/>' for r in refs) + tagged(tags)
        lines.append(f'<way id="{i}" version="1">{inner}</way>')
    for i, (members, tags) in RELATIONS.items():
        inner = "".join(f'<member type="way" ref="{r}" role="{role}"/>' for r, role in members) + tagged(tags)
        lines.append(f'<relation id="{i}" version="1">{inner}</relation>')
    path.write_text("\n".join([*lines, "</osm>"]), encoding="utf-8")
    return path


def tagged(tags: dict[str, str]) -> str:
    return "".join(f'<tag k="{k}" v="{v.replace("<", "&lt;")}"/>' for k, v in tags.items())


def elements() -> list[dict]:
    """Elements as in an Overpass response to `out geom`."""

    def geometry(refs: list[int]) -> list[dict]:
        return [{"lat": NODES[r][1], "lon": NODES[r][0]} for r in refs]

    made = [{"type": "way", "id": i, "tags": t, "nodes": r, "geometry": geometry(r)} for i, (r, t) in WAYS.items() if t]
    for i, (members, tags) in RELATIONS.items():
        parts = [{"type": "way", "ref": r, "role": role, "geometry": geometry(WAYS[r][0])} for r, role in members]
        made.append({"type": "relation", "id": i, "tags": tags, "members": parts})
    return made


def parsed(wkb: bytes) -> tuple[str, list[list[tuple[float, float]]]]:
    """Independent WKB reader: "line" or "polygon", and its parts; rings start at their smallest point."""
    order, kind, count = struct.unpack_from("<BII", wkb)
    assert order == 1
    if kind == 2:
        return "line", [[struct.unpack_from("<2d", wkb, 9 + 16 * i) for i in range(count)]]
    assert kind == 3
    at, rings = 9, []
    for _ in range(count):
        (size,) = struct.unpack_from("<I", wkb, at)
        ring = [struct.unpack_from("<2d", wkb, at + 4 + 16 * i) for i in range(size)]
        assert ring[0] == ring[-1]
        rings.append(sorted(ring[:-1]))
        at += 4 + 16 * size
    assert at == len(wkb)
    return "polygon", [rings[0], *sorted(rings[1:])]


def summary(features: list[Feature]) -> list[tuple]:
    rows = []
    for table, wkb, attributes in features:
        kind, parts = parsed(wkb)
        rows.append((table, kind, np.round(np.concatenate(parts), 7).tolist(), len(parts), sorted(attributes.items())))
    return sorted(rows)


def assert_right(features: list[Feature]) -> None:
    rows = summary(features)
    found = {
        (table, kind, dict(attributes)["kind"]): (points, parts) for table, kind, points, parts, attributes in rows
    }
    assert len(rows) == len(found) + 1  # two surfaces of water
    assert set(found) == {
        ("buildings", "polygon", "yes"),
        ("roads", "line", "primary"),
        ("roads", "line", "footway"),
        ("water", "line", "river"),
        ("water", "polygon", "water"),
    }
    hall = next(r for r in rows if r[0] == "buildings")
    assert dict(hall[4])["name"] == "Hall <1>" and hall[2] == [list(p) for p in sorted(NODES[i] for i in (1, 2, 3, 4))]
    pond = next(r for r in rows if r[:2] == ("water", "polygon") and "name" not in dict(r[4]))
    assert pond[3] == 2 and pond[2][4:] == [list(p) for p in sorted(NODES[i] for i in (5, 6, 7))]
    assert dict(next(r for r in rows if dict(r[4])["kind"] == "primary")[4]) == {
        "kind": "primary",
        "surface": "asphalt",
    }


def test_an_osm_extract_is_read(tmp_path: Path) -> None:
    assert_right(list(pbf_features(write_osm(tmp_path / "a.osm"), AREA)))


def test_a_pbf_extract_is_read(tmp_path: Path) -> None:
    source = write_osm(tmp_path / "a.osm")
    with osmium.SimpleWriter(str(tmp_path / "a.osm.pbf")) as writer:
        for thing in osmium.FileProcessor(source):
            writer.add(thing)
    assert summary(list(pbf_features(tmp_path / "a.osm.pbf", AREA))) == summary(list(pbf_features(source, AREA)))


def test_invalid_extracts_are_reported(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="no such file"):
        list(pbf_features(tmp_path / "none.osm.pbf", AREA))
    for name, data in (("a.osm.pbf", b"no protobuf at all" * 20), ("b.txt", b"x"), ("c.osm", b"<osm><node")):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(MapError, match="cannot be read as an OpenStreetMap extract"):
            list(pbf_features(tmp_path / name, AREA))


def test_overpass_is_queried_once_per_box(tmp_path: Path) -> None:
    """An object in several boxes becomes one feature."""
    area = read_area("13.00,47.00,13.15,47.05", buffer_km=0.0)
    body = json.dumps({"version": 0.6, "elements": elements()}).encode()
    with serving(lambda _: Reply(body=body)) as server:
        paths = fetch_overpass(server.url + "/api/interpreter", area, tmp_path, lambda _: None, FAST)
        assert len(server.requests) == len(paths) == 2
        query = parse_qs(server.requests[0].body.decode())["data"][0]
        assert "[bbox:47.000000,13.000000,47.100000,13.100000]" in query and query.endswith("out geom;")
        fetch_overpass(server.url + "/api/interpreter", area, tmp_path, lambda _: None, FAST)
        assert len(server.requests) == 2
    assert_right(list(overpass_features(paths, AREA)))


def test_an_overpass_time_out_is_retried(tmp_path: Path) -> None:
    """Overpass reports it with status 200 and a part of the elements."""
    late = {"elements": elements()[:2], "remark": 'runtime error: Query timed out in "query" at line 2'}
    waiting = [Reply(429), Reply(504), Reply(body=json.dumps(late).encode()), Reply(body=b"<html>busy</html>")]

    def answer(_: Request) -> Reply:
        return waiting.pop(0) if waiting else Reply(body=json.dumps({"elements": elements()}).encode())

    with serving(answer) as server:
        paths = fetch_overpass(server.url + "/api", AREA, tmp_path, lambda _: None, FAST)
    assert_right(list(overpass_features(paths, AREA)))
    tired = serving(lambda _: Reply(body=json.dumps(late).encode()))
    with tired as server, pytest.raises(FetchError, match="gave up: runtime error: Query timed out"):
        fetch_overpass(server.url + "/api", AREA, tmp_path, lambda _: None, FAST)


def test_rings_are_assembled_in_any_order_and_direction() -> None:
    a, b, c, d = (0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)
    hole = [(1.0, 1.0), (2.0, 1.0), (2.0, 2.0), (1.0, 1.0)]
    away = [(9.0, 9.0), (9.5, 9.0), (9.5, 9.5), (9.0, 9.0)]
    polygons = polygons_of([[a, b], [d, c], [c, b], [a, d]], [hole, away])
    assert len(polygons) == 1 and len(polygons[0]) == 2
    assert set(polygons[0][0]) == {a, b, c, d} and len(polygons[0][0]) == 5
    assert polygons_of([[a, b], [b, c]], []) == []
