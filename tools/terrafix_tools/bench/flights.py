"""One timed replay in a process of its own, so that its peak memory is its own: python -m terrafix_tools.bench.flights.

The nodes are those that fly, each behind a stopwatch; frames are those of the flight folder."""

import json
import os
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import typer

from terrafix.core.errors import TerrafixError
from terrafix.core.node import Node, NodeContext
from terrafix.messages import Frame, Message, SourceEnded
from terrafix_tools.estimates import ESTIMATES, read_rows
from terrafix_tools.evaluate import metrics, read_summary, read_truth, truth_sigma_of
from terrafix_tools.replay import FLOWN, make_nodes, peak_memory_mb, replay

RESULT = "bench.json"
WARM_UP_FRAMES = 1  # the first frame searches wide and pays for the first tiles of the map: it is told apart


class StageTimes:
    """Milliseconds of every stage for every frame; the refinement after the last frame has a row of its own."""

    def __init__(self) -> None:
        self.frames: list[defaultdict[str, float]] = []
        self.cpu_ms: list[float] = []  # of all threads, for each frame; other programs do not lengthen it
        self.refine_ms = 0.0
        self.start_up_s = 0.0  # age of the program at its first frame
        self._frame_id = -1
        self._landed = False

    def begin(self, message: Message) -> None:
        """Every node that hears of a frame says so; the first one counts."""
        if isinstance(message, Frame) and message.frame_id != self._frame_id:
            self._frame_id = message.frame_id
            self.start_up_s = self.start_up_s or program_age_s()
            self.frames.append(defaultdict(float))
            self.cpu_ms.append(0.0)
        elif isinstance(message, SourceEnded):
            self._landed = True

    def add(self, stage: str, elapsed_ms: float, cpu_ms: float) -> None:
        if self._landed:
            self.refine_ms += elapsed_ms
        elif self.frames:
            self.frames[-1][stage] += elapsed_ms
            self.cpu_ms[-1] += cpu_ms


class TimedNode:
    """A node and the time that it takes; what it says is said when it is done."""

    def __init__(self, name: str, node: Node, times: StageTimes) -> None:
        self._name, self._node, self._times = name, node, times

    def on(self, message: Message) -> Iterable[Message]:
        self._times.begin(message)
        began_s, cpu_s = time.perf_counter(), time.process_time()
        said = list(self._node.on(message))
        self._times.add(self._name, (time.perf_counter() - began_s) * 1e3, (time.process_time() - cpu_s) * 1e3)
        return said

    def tick(self, now_ns: int) -> Iterable[Message]:
        return self._node.tick(now_ns)


def measure(flight: Path, map_path: Path, out: Path, xfeat: Path | None) -> dict[str, Any]:
    """Replays ``flight`` into ``out``. -> times per frame and stage, memory, accuracy. Raises the TerrafixError
    family."""
    times = StageTimes()

    def nodes(ctx: NodeContext) -> dict[str, Node]:
        return {name: TimedNode(name, node, times) for name, node in make_nodes(ctx).items()}

    replay(flight, map_path, out, models=[f"xfeat={xfeat}"] if xfeat else [], nodes=nodes)
    rows = read_rows(out / ESTIMATES)
    truth = flight / "truth.csv"
    whole_ms = [row.process_ms or 0.0 for row in rows]
    stages = {name: [frame[name] for frame in times.frames] for name in FLOWN}
    decode_ms = [whole - sum(frame.values()) for whole, frame in zip(whole_ms, times.frames, strict=True)]
    result: dict[str, Any] = {
        "start_up_s": round(times.start_up_s, 2),
        "frames_per_s": round(1e3 * len(whole_ms) / sum(whole_ms), 2),
        "frame_ms": spread(whole_ms),
        "first_frame_ms": round(whole_ms[0], 1),
        "stage_ms": {"decode": spread(decode_ms)} | {name: spread(values) for name, values in stages.items()},
        "cpu_ms": spread(times.cpu_ms),
        "refine_ms": round(times.refine_ms, 1),
        "peak_memory_mb": peak_memory_mb(),
    }
    if truth.is_file():
        found = metrics(rows, read_truth(truth), read_summary(out), truth_sigma_of(truth))
        kept = ("within_20m", "within_50m", "median_m", "p95_m", "ellipse95_coverage", "false_fixes", "localised")
        result["accuracy"] = {key: found[key] for key in (*kept, "refined_within_20m", "refined_median_m")}
    return result


def spread(values_ms: list[float]) -> dict[str, float]:
    """Median and 95th percentile, without the warm-up."""
    used = values_ms[WARM_UP_FRAMES:] or values_ms
    return {"median": round(float(np.median(used)), 2), "p95": round(float(np.percentile(used, 95)), 2)}


def program_age_s() -> float:
    """Since this process was started; proc(5): field 22 of stat, in clock ticks after boot."""
    started = int(Path("/proc/self/stat").read_text(encoding="ascii").rpartition(")")[2].split()[19])
    return time.clock_gettime(time.CLOCK_BOOTTIME) - started / os.sysconf("SC_CLK_TCK")


def run_part(measure: Callable[[Path, Path, Path, Path | None], dict[str, Any]], result: str) -> None:
    """FLIGHT MAP OUT [XFEAT] on the command line: writes OUT/``result``. A user's mistake is one line."""
    flight, map_path, out, *model = (Path(text) for text in sys.argv[1:])
    try:
        found = measure(flight, map_path, out, model[0] if model else None)
    except TerrafixError as error:
        typer.echo(str(error), err=True)
        sys.exit(error.exit_code)
    (out / result).write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    run_part(measure, RESULT)
