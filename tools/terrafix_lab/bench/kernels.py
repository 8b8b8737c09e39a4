"""Floor of the stages: processor time inside of their kernels, in a replay: python -m terrafix_lab.bench.kernels
FLIGHT MAP OUT [XFEAT].

Kernels are the functions of OpenCV (transforms, warps, filters, SIFT, KLT, poses) and the inference of a model, as the
nodes call them: same sizes, same contents, same number. The floor of a stage is what it would cost if all between these
calls were free; products of matrices in NumPy and iSAM2, which evaluates factors in Python, are between. The replay is
one of its own, because reading the clock costs a microsecond a call."""

import time
import types
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from terrafix.core.node import Node, NodeContext
from terrafix_engines.runtime import Model
from terrafix_lab.bench.flights import DECODE, StageTimes, TimedNode, run_part
from terrafix_tools.replay import make_nodes, replay
from terrafix_tools.timing import WARM_UP_FRAMES, spread

RESULT = "kernels.json"
GROUPS = {
    "Fourier transforms": ("dft", "mulSpectrums"),
    "warps": ("remap", "warpPerspective", "warpAffine", "resize"),
    "SIFT": ("SIFT.detectAndCompute", "SIFT.detect", "SIFT.compute"),
    "KLT": ("calcOpticalFlowPyrLK", "goodFeaturesToTrack"),
    "poses": ("solvePnPRansac", "findEssentialMat", "findHomography", "recoverPose"),
    "decoding": ("imread", "imdecode"),
    "model": ("Model.run",),
}
WITH_FLOOR = ("vision", "anchor")  # iSAM2, the kernel of the other stages, evaluates factors in Python
OTHER = "filters and others"
_GROUP_OF = {name: group for group, names in GROUPS.items() for name in names}


class KernelTimes(StageTimes):
    """``kernels``: for each frame milliseconds of the processor by (stage, group). ``calls``: their number, of all
    frames."""

    def __init__(self) -> None:
        super().__init__()
        self.kernels: list[defaultdict[tuple[str, str], float]] = []
        self.calls: defaultdict[tuple[str, str], int] = defaultdict(int)
        self._decoding: defaultdict[tuple[str, str], float] = defaultdict(float)  # of the frame that is to come

    def add_kernel(self, name: str, cpu_ms: float) -> None:
        """A call of the function ``name`` in the stage at work; no stage: the image is being decoded."""
        key = (self.stage or DECODE, _GROUP_OF.get(name, OTHER))
        while len(self.kernels) < len(self.frames):
            self.kernels.append(self._decoding)
            self._decoding = defaultdict(float)
        row = self.kernels[-1] if self.stage else self._decoding
        row[key] += cpu_ms
        self.calls[key] += 1


@contextmanager
def timed_kernels(add: Callable[[str, float], None]) -> Iterator[None]:
    """Within it every call of a kernel is reported to ``add``: name, milliseconds of the processor."""

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **named: Any) -> Any:
            began_s = time.process_time()
            result = function(*args, **named)
            add(name, (time.process_time() - began_s) * 1e3)
            return result

        return call

    class TimedSift:
        """SIFT, whose class cannot be changed."""

        def __init__(self, sift: Any) -> None:
            for name in ("detectAndCompute", "detect", "compute"):
                setattr(self, name, timed(f"SIFT.{name}", getattr(sift, name)))

        @staticmethod
        def create(*args: Any, **named: Any) -> "TimedSift":
            return TimedSift(sift_class.create(*args, **named))

    sift_class, run_session = cv2.SIFT, Model._run_session
    functions = {name: one for name, one in vars(cv2).items() if isinstance(one, types.BuiltinFunctionType)}
    try:
        for name, function in functions.items():
            setattr(cv2, name, timed(name, function))
        cv2.SIFT = TimedSift  # type: ignore[misc, assignment]
        Model._run_session = timed("Model.run", run_session)  # type: ignore[method-assign]
        yield
    finally:
        for name, function in functions.items():
            setattr(cv2, name, function)
        cv2.SIFT = sift_class  # type: ignore[misc]
        Model._run_session = run_session  # type: ignore[method-assign]


def measure(flight: Path, map_path: Path, out: Path, xfeat: Path | None) -> dict[str, Any]:
    """Replays ``flight`` into ``out``. -> by stage: processor times of the stage and of its kernels, their ratio, and
    the kernels by group. Raises TerrafixError."""
    times = KernelTimes()

    def nodes(ctx: NodeContext) -> dict[str, Node]:
        return {name: TimedNode(name, node, times) for name, node in make_nodes(ctx).items()}

    with timed_kernels(times.add_kernel):
        replay(flight, map_path, out, models=[f"xfeat={xfeat}"] if xfeat else [], nodes=nodes)
    return floors(times)


def floors(times: KernelTimes) -> dict[str, Any]:
    """-> stage -> ``cpu_ms``, ``kernel_cpu_ms``: spreads; ``ratio`` of their sums over the frames after the first,
    None for stages without floor;    ``kernels``: group -> mean of ``cpu_ms`` and ``calls`` of a frame."""
    count = len(times.kernels)
    used = slice(min(WARM_UP_FRAMES, count - 1), count)
    result: dict[str, Any] = {}
    for stage in dict.fromkeys(stage for frame in times.cpu_frames for stage in frame):
        own_ms = [frame[stage] for frame in times.cpu_frames[:count]]
        inside_ms = [sum(ms for (where, _), ms in frame.items() if where == stage) for frame in times.kernels]
        groups = sorted({group for frame in times.kernels for where, group in frame if where == stage})
        result[stage] = {
            "cpu_ms": spread(own_ms),
            "kernel_cpu_ms": spread(inside_ms),
            "ratio": round(sum(own_ms[used]) / sum(inside_ms[used]), 2) if stage in WITH_FLOOR else None,
            "kernels": {
                group: {
                    "cpu_ms": round(float(np.mean([frame[stage, group] for frame in times.kernels[used]])), 2),
                    "calls": round(times.calls[stage, group] / count, 1),
                }
                for group in groups
            },
        }
    return result


if __name__ == "__main__":
    run_part(measure, RESULT)
