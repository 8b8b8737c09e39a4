"""Run times of this machine, and what the machine is: for `terrafix models bench` and the benchmarks of the lab."""

import os
from typing import Any

import numpy as np

from terrafix.recorder.provenance import device, versions

WARM_UP_FRAMES = 1  # reported separately: the first frame has a wide search, and loads the first tiles of the map


def spread(values_ms: list[float]) -> dict[str, float]:
    """-> median, 95th and 99th percentile, without the warm-up frames if there are others."""
    used = values_ms[WARM_UP_FRAMES:] or values_ms
    median, p95, p99 = (round(float(value), 2) for value in np.percentile(used, (50, 95, 99)))
    return {"median": median, "p95": p95, "p99": p99}


def machine() -> dict[str, Any]:
    """-> processor, memory, load and versions of this machine."""
    computer = device()
    return {
        "cpu": computer["processor"] or computer["machine"],
        "cores": len(os.sched_getaffinity(0)),
        "memory_mb": computer["memory_mb"],
        "load_average_before": os.getloadavg(),
        "versions": versions(),
    }
