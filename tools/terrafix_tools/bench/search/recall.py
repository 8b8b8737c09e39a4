"""Place recognition on imagery of another date: how often is the right place among the best five of the whole map?

python -m terrafix_tools.bench.search.recall CAMERA.tif MAP.tif --agl 120 [--places 30] [--seed 1] [--json FILE]
    [--descriptor pooled-gradient] [--descriptor xfeat]

One frame of the camera's date, heading unknown; the map is the other date. *Proposed*: the order in which the joint
correlation of the search proposes places. *Checked*: the same places in the order of their evidence, after patches of
the frame were compared with each (re-ranking). With --descriptor also: the places of a place index with that
descriptor, searched exactly (neighbours within 0.4 heights count as one place), and those that the
search proposes with this index: of a map that a correlation cannot afford. A place is right within 0.2 heights, of
an index within 0.3, because its discs are 0.19 apart."""

import argparse
import json
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import typer

from terrafix.anchor.place_index.recognizer import PlaceMemory, PlaceRecognizer
from terrafix.anchor.relocalization.map_search import MapSearch
from terrafix.anchor.verification.hypothesis_tracker import MERGE_RADIUS, NEIGHBOUR_RADIUS
from terrafix.core.config import Places
from terrafix.core.errors import TerrafixError
from terrafix.map.null_model import DEFAULT_NULL, FalseAlarmBudget
from terrafix_tools.bench.search.views import TrueView, TwoDates
from terrafix_tools.mapping.place_index import IndexOptions, write_index

AMONG = (1, 5, 12)  # 12 is the number of places that a joint correlation proposes
INDEX_RIGHT = 0.3  # heights
SEED = 1


@dataclass(frozen=True)
class Ranks:
    """Rank of the right place, 1 is the best; None: it is not among them. ``checked`` is None, too, if no place was
    checked."""

    proposed: int | None
    checked: int | None


def measure(
    first: Path, second: Path, agl_m: float, places: int, seed: int = SEED, *, check: bool = True
) -> list[Ranks]:
    """-> ranks of the right place in ``places`` frames. ``check``: the proposed places are checked. Raises MapError."""
    dates = TwoDates(first, second)
    source, matcher = dates.open()

    def ranks(view: TrueView) -> Ranks:
        search = MapSearch(source, matcher, agl_m, None, DEFAULT_NULL, FalseAlarmBudget())
        if check:
            search.process_frame(view.frame, view.predicted)
        else:
            search.correlate_region(view.frame, view.predicted)
        right_m = MERGE_RADIUS * agl_m
        return Ranks(
            proposed=rank_of(view.place_m, [(p.e_m, p.n_m) for p in search.proposed], right_m),
            checked=rank_of(view.place_m, [(t.e_m, t.n_m) for t in search.tracker.tracks], right_m),
        )

    return [ranks(view) for view in dates.draw(places, agl_m, seed)]


def measure_index(
    first: Path, second: Path, agl_m: float, places: int, seed: int, descriptor: str, folder: str = ""
) -> dict[str, list[int | None]]:
    """-> ranks of the right place among those of a place index of the map, and among those that the search proposes
    with this index. Raises MapError, ModelError."""
    dates = TwoDates(first, second)
    source, matcher = dates.open()
    with tempfile.TemporaryDirectory() as made:
        out = Path(made) / "index"
        header = write_index([dates.package_path], out, IndexOptions(agl_m, descriptor, folder))
        memory = PlaceMemory.open(Places(index=str(out), search="exact"), folder, verify=False)
        assert memory is not None
        recognizer = PlaceRecognizer(memory, header.layers[0], dates.origin)

        def rank(view: TrueView) -> int | None:
            hypotheses = matcher.map_search_hypotheses(view.predicted)
            found = recognizer.candidates(view.frame, view.predicted, hypotheses, matcher)
            ranked_m = distinct([(c.e_m, c.n_m) for c in found], NEIGHBOUR_RADIUS * agl_m)
            return rank_of(view.place_m, ranked_m, INDEX_RIGHT * agl_m)

        def rank_in_search(view: TrueView) -> int | None:
            search = MapSearch(source, matcher, agl_m, None, DEFAULT_NULL, FalseAlarmBudget(), recognizer)
            search.correlate_region(view.frame, view.predicted)
            return rank_of(view.place_m, [(p.e_m, p.n_m) for p in search.proposed], MERGE_RADIUS * agl_m)

        views = list(dates.draw(places, agl_m, seed))
        return {descriptor: [rank(v) for v in views], f"search, {descriptor}": [rank_in_search(v) for v in views]}


def distinct(ranked_m: Sequence[tuple[float, float]], radius_m: float) -> list[tuple[float, float]]:
    """The places that have no better one within ``radius_m``."""
    kept: list[tuple[float, float]] = []
    for at_m in ranked_m:
        if all(np.hypot(at_m[0] - e_m, at_m[1] - n_m) > radius_m for e_m, n_m in kept):
            kept.append(at_m)
    return kept


def rank_of(place_m: np.ndarray, ranked_m: Iterable[tuple[float, float]], right_m: float) -> int | None:
    """Rank of the first place within ``right_m`` of the true one."""
    distances_m = (float(np.hypot(*(np.array(at_m) - place_m))) for at_m in ranked_m)
    return next((rank for rank, off_m in enumerate(distances_m, 1) if off_m <= right_m), None)


def recall(ranks: Sequence[int | None], among: int) -> float:
    """Share of the ranks that are at most ``among``."""
    return float(np.mean([rank is not None and rank <= among for rank in ranks]))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("first", type=Path, metavar="CAMERA.tif", help="imagery that the camera sees")
    parser.add_argument("second", type=Path, metavar="MAP.tif", help="the map, in the same coordinate system")
    parser.add_argument("--agl", type=float, required=True, help="height above ground, m")
    parser.add_argument("--places", type=int, default=30)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--descriptor", action="append", default=[], help="also a place index with it; repeatable")
    parser.add_argument("--json", type=Path, help="writes the rank of every place")
    given = parser.parse_args()
    try:
        found = measure(given.first, given.second, given.agl, given.places, given.seed)
        rows = {"proposed": [r.proposed for r in found], "checked": [r.checked for r in found]}
        for name in given.descriptor:
            rows |= measure_index(given.first, given.second, given.agl, given.places, given.seed, name)
    except TerrafixError as error:
        sys.exit(f"{error}")
    typer.echo(f"{given.first.stem} on {given.second.stem} from {given.agl:g} m, {len(found)} places, heading unknown")
    for name, ranks in rows.items():
        shares = ", ".join(f"{100 * recall(ranks, k):.0f} % among {k}" for k in AMONG)
        typer.echo(f"{name:24} {shares}")
    if given.json is not None:
        given.json.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
