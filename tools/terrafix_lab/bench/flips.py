"""Decisions that two records of one flight took differently: where rounding became another answer.

python -m terrafix_lab.bench.flips A B [--frames N]

A and B are outputs of replay, as terrafix_lab.bench.processors leaves them in OUT/ROW/FLIGHT. `terrafix compare` says
which message first differs by a bit; this says of each kind of decision at how many frames it differs, and where first:
keyframe, features of odometry, place and patches of a map match, inliers of its pose, verdicts. Beside them the
distances of what is continuous. ``--frames``: lists the first N frames at which a decision differs."""

from collections import defaultdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from terrafix.core.geodesy import LocalFrame
from terrafix.messages import (
    MapMatch,
    MeasurementVerdict,
    NavEstimate,
    Odometry,
    Origin,
    PoseSolution,
    Prediction,
    Relocalization,
)
from terrafix.recorder.reader import read_flight
from terrafix_lab.standalone import run_standalone

SAME_RAY = 0.002  # distance of two image points that are one feature, normalised: a pixel of the tracker
SAME_PATCH = 0.01  # ... of two patches of a frame, whose grid moves with the prediction
SAME_PEAK_M = 1.0  # distance on the map of one patch's two peaks: more than two of its cells at 100 m
SAME_PLACE_M = 5.0  # distance of two places that are one mode


class Decisions:
    """``discrete``: of one frame, by kind; ``points``: image points (N, 2) and what each is matched with, by kind;
    ``places``: (east, north) [m], by kind."""

    def __init__(self) -> None:
        self.discrete: dict[str, Any] = {}
        self.points: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self.places: dict[str, np.ndarray] = {}


def read_decisions(folder: Path) -> dict[int, Decisions]:
    """Of each frame of a record; of several messages of a kind the last one. Raises SourceError."""
    frames: dict[int, Decisions] = defaultdict(Decisions)
    axes: LocalFrame | None = None
    for _, _, message in read_flight(folder):
        if isinstance(message, Origin):
            axes = LocalFrame(message.lat_deg, message.lon_deg)
        elif (frame_id := getattr(message, "frame_id", -1)) >= 0:
            _take(frames[frame_id], message, axes)
    return dict(frames)


def _take(into: Decisions, message: Any, axes: LocalFrame | None) -> None:
    match message:
        case Odometry():
            into.discrete["keyframe"] = (message.keyframe_id, message.becomes_keyframe)
            into.discrete["odometry"] = str(message.verdict)
            into.discrete["links"] = [link.keyframe_id for link in message.links]
            into.discrete["tracked, inliers"] = (message.tracked, message.inliers)
            rows = np.reshape(message.two_view, (-1, 4))
            into.points["features"] = (rows[:, :2], rows[:, 2:])
        case Relocalization():
            into.discrete["loop closure"] = message.keyframe_id
        case Prediction():
            into.places["prediction"] = np.array(message.p_c_in_w_m[:2])
        case MapMatch():
            into.discrete["map match"] = (str(message.verdict), message.matcher, message.position_only)
            into.discrete["search"] = (str(message.search.step), message.search.relocalized)
            if message.place is not None:
                into.places["mode"] = np.array([message.place.e_m, message.place.n_m])
            rows = np.reshape(message.matches, (-1, 6))
            into.points["patches"] = (rows[:, :2], rows[:, 2:4])
        case PoseSolution():
            into.discrete["pose"] = (str(message.verdict), str(message.method))
            into.discrete["pose inliers"] = message.inliers
            if message.pose is not None:
                into.places["pose"] = np.array(message.pose.p_c_in_w_m[:2])
        case MeasurementVerdict():
            into.discrete[f"verdict of {message.measurement}"] = str(message.verdict)
        case NavEstimate() if axes is not None:
            into.places["estimate"] = np.array(axes.to_local(message.lat_deg, message.lon_deg))


def differences(a: Decisions, b: Decisions) -> dict[str, str]:
    """-> by kind, in words, what two decisions about a frame differ in."""
    found = {}
    for kind in dict.fromkeys((*a.discrete, *b.discrete)):
        one, other = a.discrete.get(kind), b.discrete.get(kind)
        if one != other:
            found[kind] = f"{one} | {other}"
    for kind, same in (("features", SAME_RAY), ("patches", SAME_PATCH)):
        alone, pairs, count = _paired(a.points.get(kind), b.points.get(kind), same)
        if alone:
            found[f"which {kind}"] = f"{alone} of {count} alone"
        moved = int(np.sum(np.hypot(*pairs.T) > (SAME_PEAK_M if kind == "patches" else SAME_RAY)))
        if moved:
            found[f"{kind} elsewhere"] = f"{moved} of {len(pairs)}"
    mode_m = _apart_m(a, b, "mode")
    if mode_m is not None and mode_m > SAME_PLACE_M:
        found["mode"] = f"{mode_m:.1f} m apart"
    return found


def _paired(
    a: tuple[np.ndarray, np.ndarray] | None, b: tuple[np.ndarray, np.ndarray] | None, same: float
) -> tuple[int, np.ndarray, int]:
    """-> points of either that the other lacks; displacements (N, 2) of the partners of the others; points of both."""
    if a is None or b is None or not len(a[0]) or not len(b[0]):
        count = sum(len(one[0]) for one in (a, b) if one is not None)
        return count, np.zeros((0, 2)), count
    apart = np.linalg.norm(a[0][:, None] - b[0][None], axis=2)
    nearest = apart.argmin(axis=1)
    both = apart[np.arange(len(nearest)), nearest] < same
    alone = int(np.sum(~both) + np.sum(apart.min(axis=0) >= same))
    return alone, (a[1] - b[1][nearest])[both], len(a[0]) + len(b[0])


def _apart_m(a: Decisions, b: Decisions, kind: str) -> float | None:
    if kind not in a.places or kind not in b.places:
        return None
    return float(np.hypot(*(a.places[kind] - b.places[kind])))


def main(
    a: Annotated[Path, typer.Argument(help="Output of replay.")],
    b: Annotated[Path, typer.Argument(help="Another one of the same flight.")],
    frames: Annotated[int, typer.Option(min=0, help="Number of frames to list.")] = 0,
) -> None:
    one, other = read_decisions(a), read_decisions(b)
    shared = sorted(one.keys() & other.keys())
    found = {frame_id: differences(one[frame_id], other[frame_id]) for frame_id in shared}
    table = Table(title=f"{a} | {b}: {len(shared)} frames", title_justify="left")
    for name in ("decision", "frames", "first", "what"):
        table.add_column(name)
    for kind in dict.fromkeys(kind for differing in found.values() for kind in differing):
        where = [frame_id for frame_id, differing in found.items() if kind in differing]
        table.add_row(kind, str(len(where)), str(where[0]), found[where[0]][kind])
    for kind in ("prediction", "mode", "pose", "estimate"):
        apart = [
            metres for frame_id in shared if (metres := _apart_m(one[frame_id], other[frame_id], kind)) is not None
        ]
        if apart:
            spread = " / ".join(f"{v:.3f}" for v in np.percentile(apart, (50, 95, 100)))
            table.add_row(f"{kind}, distance", str(len(apart)), "", f"median / 95 % / largest {spread} m")
    Console(width=150).print(table)
    for frame_id in [frame_id for frame_id in shared if found[frame_id]][:frames]:
        typer.echo(f"{frame_id}: " + "; ".join(f"{kind}: {what}" for kind, what in found[frame_id].items()))


if __name__ == "__main__":
    run_standalone("bench.flips", main)
