"""Over ground without imagery the operator is asked for a position after a fifth of the route, and the hint is used."""

import csv
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.warp import transform

from source_folders import some_frames
from terrafix.core.geodesy import LocalFrame
from terrafix.core.log_lines import MessageLog
from terrafix.core.node import Node, NodeBase, NodeContext
from terrafix.link.node import LinkNode
from terrafix.messages import HintVerdict, Message, NavEstimate, PositionHint, StatusText, Verdict
from terrafix_tools.evaluate import evaluate
from terrafix_tools.replay import make_nodes, replay

EVERY, FRAMES = 2, 200  # of the recorded frames every second one is flown, up to this one: 100 frames at 1 Hz
BLANK, BLANK_M = range(60, 150), 90.0  # recorded frames around which the map has no imagery, and radius there
MAX_SPEED_MPS = 12.0  # of the flight
HINT_OFF_M, HINT_RADIUS_M = 60.0, 150.0
DRIFT_M = 100.0  # between two map fixes, AC-11

pytestmark = pytest.mark.slow


def truth_of(flight: Path) -> list[tuple[float, float]]:
    """(latitude, longitude) in degrees of each frame."""
    rows = csv.DictReader((flight / "truth.csv").read_text(encoding="utf-8").splitlines())
    return [(float(row["lat_deg"]), float(row["lon_deg"])) for row in rows]


def way_m(places: list[tuple[float, float]]) -> float:
    """Length of a path through (latitude, longitude) in degrees."""
    lat, lon = np.array(places).T * 111_000.0
    return float(np.hypot(np.diff(lat), np.diff(lon) * np.cos(np.radians(places[0][0]))).sum())


def errors_m(rows: list[dict[str, str]], truth: list[tuple[float, float]]) -> np.ndarray:
    """East and north (N, 2) of the immediate positions."""
    places = [(float(row["lat_deg"]), float(row["lon_deg"])) for row in rows]
    return np.array([LocalFrame(*true).to_local(*at) for at, true in zip(places, truth[:FRAMES:EVERY], strict=True)])


def write_map_with_a_gap(source: Path, out: Path, places: list[tuple[float, float]]) -> None:
    """Copies a map without its imagery within ``BLANK_M`` of ``places``."""
    with rasterio.open(source) as src:
        image, profile = src.read(), src.profile
        lat, lon = zip(*places, strict=True)
        east, north = transform("EPSG:4326", src.crs, lon, lat)
        rows, columns = rasterio.transform.rowcol(src.transform, east, north)
        half = round(BLANK_M / src.res[0])
    for row, column in zip(rows, columns, strict=True):
        image[:, max(row - half, 0) : row + half, max(column - half, 0) : column + half] = 0
    with rasterio.open(out, "w", **{**profile, "nodata": 0, "compress": "deflate", "photometric": "rgb"}) as dst:
        dst.write(image)


class AskedOperator(NodeBase):
    """The link, ticked at each estimate, and an operator who answers a request with the true position, roughly."""

    def __init__(self, truth: list[tuple[float, float]]) -> None:
        self._link, self._truth = LinkNode(10.0), truth
        self.asked: list[tuple[int, StatusText]] = []
        self.verdicts: list[HintVerdict] = []

    def on(self, message: Message) -> Iterable[Message]:
        yield from self._link.on(message)
        if isinstance(message, HintVerdict):
            self.verdicts.append(message)
        if isinstance(message, NavEstimate):
            for answer in self._link.tick(message.t_ns):
                yield answer
                if isinstance(answer, StatusText) and "hint" in answer.text:
                    self.asked.append((message.frame_id, answer))
                    yield self._hint(message)

    def _hint(self, estimate: NavEstimate) -> PositionHint:
        lat_deg, lon_deg = self._truth[EVERY * estimate.frame_id]
        return PositionHint(
            t_ns=estimate.t_ns,
            lat_deg=lat_deg + HINT_OFF_M / 111_000.0,
            lon_deg=lon_deg,
            radius_m=HINT_RADIUS_M,
            source="ground station 255",
        )


@pytest.mark.nightly
def test_after_a_fifth_of_the_route_without_a_fix_the_operator_is_asked_and_the_hint_is_used(
    data_set: Callable[[str], Path], tmp_path: Path
) -> None:
    flight, whole = data_set("flights/village-1"), data_set("maps/village-2014-01.tif")
    truth = truth_of(flight)
    write_map_with_a_gap(whole, tmp_path / "map.tif", [truth[i] for i in BLANK])
    operator = AskedOperator(truth)

    def nodes(ctx: NodeContext) -> Mapping[str, Node]:
        return {**make_nodes(ctx), "link": operator}

    replay(
        some_frames(flight, tmp_path / "flight", slice(0, FRAMES, EVERY)),
        tmp_path / "map.tif",
        tmp_path / "out",
        nodes=nodes,
    )
    rows = list(csv.DictReader((tmp_path / "out" / "estimates.csv").read_text(encoding="utf-8").splitlines()))
    fixed = [i for i, row in enumerate(rows) if row["anchor_age_ms"] == "0"]
    last_before = max(i for i in fixed if i < BLANK[0] // EVERY)
    again = [i for i in fixed if i > last_before]
    assert again and again[0] - last_before > 60, "the map has a gap"
    asked = operator.asked[0][0]
    assert last_before < asked
    fifth = way_m(truth[: EVERY * asked : EVERY]) * 0.2
    assert way_m(truth[EVERY * last_before : EVERY * asked : EVERY]) <= max(fifth, 35.0 * MAX_SPEED_MPS)
    entries = [MessageLog().entry(text) for _, text in operator.asked]
    assert all(entry is not None and entry.level == "warning" and "hint" in entry.fields["text"] for entry in entries)
    assert operator.verdicts and {v.verdict for v in operator.verdicts} == {Verdict.ACCEPTED}
    off_m = errors_m(rows, truth)
    # The drift over 600 m without a fix hangs on a few tracks: 7 m with one processor's kernels, 39 m with another's.
    # AC-11 allows 100 m. What the hint does does not hang on it: it is 60 m off, and the position hardly moves.
    assert np.hypot(*off_m[fixed].T).max() < 20.0 and np.hypot(*off_m.T).max() < DRIFT_M
    for frame, _ in operator.asked:
        assert np.hypot(*(off_m[frame + 1] - off_m[frame])) < 0.1 * HINT_OFF_M
    result = evaluate(tmp_path / "out", flight / "truth.csv")
    assert result["false_fixes"] == 0 and result["ellipse95_coverage"] == 1.0
