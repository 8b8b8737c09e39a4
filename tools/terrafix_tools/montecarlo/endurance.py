"""`terrafix montecarlo --endurance`: one long flight, whether time and memory of the estimator stay as they are."""

from typing import Any

import numpy as np
from rich.console import Console

from terrafix_tools.montecarlo.fault import Fault
from terrafix_tools.montecarlo.flight import run
from terrafix_tools.montecarlo.plan import plan

HOURS = 2.0
# At first caches and windows fill, and what is kept for the refinement: 256 nodes, five frames apart at least.
SETTLED_S = 1800.0
BLOCK = 60  # frames: their median is a point of the line, so that a busy machine bends it little
TIME_SHARE_PER_H = 0.01  # of the time for one frame
MEMORY_MB_PER_H = 2.0


def endurance(seed: int) -> dict[str, Any]:
    """Flies for HOURS without the refinement after landing. -> slopes, and whether they are flat."""
    record = run(plan(seed, 0, fault=Fault.NONE, duration_s=3600.0 * HOURS), refine=False)
    result = slopes(record.t_s, record.cpu_ms, record.yardstick_ms, record.memory_mb)
    Console().print(
        f"{HOURS:g} h: {result['cpu_ms']:.1f} ms of processor time a frame, {100 * result['cpu_share_per_h']:+.1f} % "
        f"an hour; memory {result['memory_mb']:.0f} MB, {result['memory_mb_per_h']:+.1f} MB an hour: "
        f"{'flat' if result['flat'] else 'NOT FLAT'}",
        highlight=False,
        soft_wrap=True,
    )
    return result


def slopes(t_s: np.ndarray, cpu_ms: np.ndarray, yardstick_ms: np.ndarray, memory_mb: np.ndarray) -> dict[str, Any]:
    """Straight lines through time and memory (N,) of each frame. A machine that slows down slows the simulation of the
    frame as well: time is taken by that yardstick."""
    kept = t_s >= SETTLED_S
    t_h, cpu, yardstick, memory = (_blocks(v[kept]) for v in (t_s / 3600.0, cpu_ms, yardstick_ms, memory_mb))
    share_per_h = float(np.polyfit(t_h, cpu / yardstick, 1)[0] / np.median(cpu / yardstick))
    memory_per_h = float(np.polyfit(t_h, memory, 1)[0])
    return {
        "cpu_ms": float(np.median(cpu)),
        "cpu_share_per_h": share_per_h,
        "memory_mb": float(memory[-1]),
        "memory_mb_per_h": memory_per_h,
        "flat": share_per_h < TIME_SHARE_PER_H and memory_per_h < MEMORY_MB_PER_H,
    }


def _blocks(values: np.ndarray) -> np.ndarray:
    """Medians of BLOCK frames."""
    whole = len(values) // BLOCK * BLOCK
    return np.median(values[:whole].reshape(-1, BLOCK), axis=1)
