"""One timed replay in its own process, whose peak memory is measured: python -m terrafix_lab.bench.flights.

Arguments: FLIGHT MAP OUT [XFEAT]. The nodes are those of the daemon; each is timed."""

import json
import os
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import typer

from terrafix.core.errors import TerrafixError
from terrafix.core.node import Node, NodeContext
from terrafix.messages import Frame, Message, SourceEnded
from terrafix_tools.estimates import ESTIMATES, read_rows
from terrafix_tools.evaluate import metrics, read_summary, read_truth, truth_sigma_of
from terrafix_tools.replay import REPLAYED_PROCESSES, make_nodes, peak_memory_mb, replay
from terrafix_tools.timing import spread

RESULT = "bench.json"
DECODE = "decode"  # the stage before the nodes


class StageTimes:
    """Milliseconds of every stage for every frame. The refinement after the last frame is counted separately.

    ``frames``: by the clock; ``cpu_frames``: of the processor, all threads, which other programs do not lengthen.
    ``start_up_s``: age of the process at its first frame."""

    def __init__(self) -> None:
        self.frames: list[defaultdict[str, float]] = []
        self.cpu_frames: list[defaultdict[str, float]] = []
        self.stage = ""  # at work; empty: none
        self.refine_ms = 0.0
        self.start_up_s = 0.0
        self._frame_id = -1
        self._source_ended = False

    def begin(self, message: Message) -> None:
        """Begins a new row at the first Frame with a new id (each subscribed node calls this)."""
        if isinstance(message, Frame) and message.frame_id != self._frame_id:
            self._frame_id = message.frame_id
            self.start_up_s = self.start_up_s or program_age_s()
            self.frames.append(defaultdict(float))
            self.cpu_frames.append(defaultdict(float))
        elif isinstance(message, SourceEnded):
            self._source_ended = True

    def add(self, stage: str, elapsed_ms: float, cpu_ms: float) -> None:
        if self._source_ended:
            self.refine_ms += elapsed_ms
        elif self.frames:
            self.frames[-1][stage] += elapsed_ms
            self.cpu_frames[-1][stage] += cpu_ms

    @property
    def cpu_ms(self) -> list[float]:
        """Processor time of each frame."""
        return [sum(frame.values()) for frame in self.cpu_frames]


class TimedNode:
    """A node whose processing time is measured. Its messages are returned after it has finished, not one by one."""

    def __init__(self, name: str, node: Node, times: StageTimes) -> None:
        self._name, self._node, self._times = name, node, times

    def on(self, message: Message) -> Iterable[Message]:
        self._times.begin(message)
        began_s, cpu_s = time.perf_counter(), time.process_time()
        self._times.stage = self._name
        published = list(self._node.on(message))
        self._times.stage = ""
        self._times.add(self._name, (time.perf_counter() - began_s) * 1e3, (time.process_time() - cpu_s) * 1e3)
        return published

    def tick(self, now_ns: int) -> Iterable[Message]:
        return self._node.tick(now_ns)


def measure(flight: Path, map_path: Path, out: Path, xfeat: Path | None) -> dict[str, Any]:
    """Replays ``flight`` into ``out``. -> times per frame and stage, memory, accuracy. Raises TerrafixError."""
    times = StageTimes()

    def nodes(ctx: NodeContext) -> dict[str, Node]:
        return {name: TimedNode(name, node, times) for name, node in make_nodes(ctx).items()}

    replay(flight, map_path, out, models=[f"xfeat={xfeat}"] if xfeat else [], nodes=nodes)
    rows = read_rows(out / ESTIMATES)
    truth = flight / "truth.csv"
    whole_ms = [row.process_ms or 0.0 for row in rows]
    stages = {name: [frame[name] for frame in times.frames] for name in REPLAYED_PROCESSES}
    decode_ms = [whole - sum(frame.values()) for whole, frame in zip(whole_ms, times.frames, strict=True)]
    result: dict[str, Any] = {
        "start_up_s": round(times.start_up_s, 2),
        "frames_per_s": round(1e3 * len(whole_ms) / sum(whole_ms), 2),
        "frame_ms": spread(whole_ms),
        "first_frame_ms": round(whole_ms[0], 1),
        "first_frame_cpu_ms": round(times.cpu_ms[0], 1),
        "stage_ms": {DECODE: spread(decode_ms)} | {name: spread(values) for name, values in stages.items()},
        "stage_cpu_ms": {name: spread([frame[name] for frame in times.cpu_frames]) for name in REPLAYED_PROCESSES},
        "cpu_ms": spread(times.cpu_ms),
        "refine_ms": round(times.refine_ms, 1),
        "peak_memory_mb": peak_memory_mb(),
    }
    if truth.is_file():
        found = metrics(rows, read_truth(truth), read_summary(out), truth_sigma_of(truth))
        found_by = ("frames", "within_20m", "within_50m", "median_m", "p95_m", "refined_within_20m", "refined_median_m")
        claims = ("ellipse95_coverage", "false_fixes", "localised", "model_rate")
        result["accuracy"] = {key: found[key] for key in (*found_by, *claims)}
    return result


def program_age_s() -> float:
    """-> time since this process was started (proc(5): field 22 of stat, in clock ticks after boot)."""
    started = int(Path("/proc/self/stat").read_text(encoding="ascii").rpartition(")")[2].split()[19])
    return time.clock_gettime(time.CLOCK_BOOTTIME) - started / os.sysconf("SC_CLK_TCK")


def run_part(measure: Callable[[Path, Path, Path, Path | None], dict[str, Any]], result: str) -> None:
    """Runs ``measure`` with FLIGHT MAP OUT [XFEAT] of the command line and writes OUT/``result``. A TerrafixError is
    one line on stderr, and its exit code."""
    flight, map_path, out, *model = (Path(text) for text in sys.argv[1:])
    try:
        found = measure(flight, map_path, out, model[0] if model else None)
    except TerrafixError as error:
        typer.echo(str(error), err=True)
        sys.exit(error.exit_code)
    (out / result).write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    run_part(measure, RESULT)
