"""Benchmarks of growing maps and flights: the synthetic flight is consistent, and all result fields are present."""

import ctypes
import gc
import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from terrafix.core.allocator import _Mallinfo2
from terrafix.estimator.estimator import Estimator
from terrafix_lab.bench.growth import estimator_cost, map_size
from terrafix_lab.bench.growth.stream import FIX_EVERY, origin


def test_the_estimator_follows_the_synthetic_flight() -> None:
    """The messages must describe one motion, or the benchmark would time a lost
    estimator."""
    estimator, frames, rejected, inertial = Estimator(origin()), 140, 0, 0
    for frame, propagated, matched, _ in estimator_cost.flown(estimator, frames):
        inertial += estimator.state.continuity.last_increment_inertial is True
        rejected += matched is not None and matched.verdict != "accepted"
        error_m = propagated.placed.pose.translation() - frame.p_m
        assert np.hypot(*error_m[:2]) < (40.0 if frame.odometry.frame_id < 5 else 6.0)
    assert inertial == frames - 1
    assert rejected <= 0.05 * frames / FIX_EVERY


def allocated_bytes() -> int:
    """Blocks in use of the C library's heap, where arrays and GTSAM's objects are, and those mapped one by one."""
    libc = ctypes.CDLL(None)
    libc.mallinfo2.restype = _Mallinfo2
    info = libc.mallinfo2()
    return int(info.uordblks + info.hblkhd)


@pytest.mark.slow
def test_what_the_estimator_keeps_of_each_frame_is_small() -> None:
    """In Python and in GTSAM, while the history retains more and more nodes: 2 kB a frame, and 44 kB if factors were
    parts of larger matrices. A window has some 40 factors more or less, 10 kB each."""
    estimator, used = Estimator(origin()), []
    for frame, _ in enumerate(estimator_cost.flown(estimator, 300)):
        if frame in (99, 299):
            gc.collect()
            used.append(allocated_bytes())
    assert 0 < used[1] - used[0] < 200 * 8_000


@pytest.mark.slow
def test_the_growth_benchmark_has_all_fields(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the graph has begun anew late in the flight, and has fewer nodes than before."""
    flown = estimator_cost.flown

    def begun_anew(estimator: Estimator, frames: int) -> Iterator[estimator_cost.Flown]:
        for frame in flown(estimator, frames):
            if frame[0].odometry.frame_id == frames - 5:
                estimator.graph._rebuild()
            yield frame

    monkeypatch.setattr(estimator_cost, "flown", begun_anew)
    found = estimator_cost.measure(30)
    assert found["frames"] == 30 and found["peak_memory_mb"] >= found["memory_in_flight_mb"] > 50.0
    assert list(found["covariance_cpu_ms"]) == [
        "of the smoother", "gtsam.Marginals, window", "gtsam.Marginals, whole flight"
    ]  # fmt: skip
    assert found["frame_cpu_ms"]["median"] > found["update_cpu_ms"]["median"] > 0.0
    assert found["update_cpu_ms"]["p99"] > found["update_cpu_ms"]["median"]


@pytest.mark.nightly
@pytest.mark.slow
def test_the_map_size_benchmark_has_all_fields(tmp_path: Path) -> None:
    built = map_size.measure(0.25, tmp_path)
    assert min(built[key] for key in ("build_cpu_s", "build_s", "build_by_several_s", "speed_up")) > 0.0
    assert built["same_bytes"]
    assert built["area_km2"] == 0.25 and built["package_mb"] > 0.05 and not (tmp_path / "map.tif").exists()
    found = map_size.search(tmp_path / "map.gpkg")
    json.dumps(built | found, allow_nan=False)
    assert set(found["look_cpu_ms"]) == {"in flight", "lost"}
    assert len(found["window_ms"]) == len(map_size.WINDOW_GSD_M) and found["open_ms"] > 0.0
    assert all(0.0 < correlation["median"] <= correlation["p95"] for correlation in found["look_cpu_ms"].values())


def test_the_noise_imagery_does_not_repeat() -> None:
    first, second = (map_size._block(np.random.default_rng([0, i * map_size.BLOCK_PX]))[..., 1] for i in (0, 1))
    correlation = float(np.corrcoef(first.ravel(), second.ravel())[0, 1])
    assert abs(correlation) < 0.2 and math.isfinite(correlation) and first.std() > 20.0
