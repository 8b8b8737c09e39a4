"""Cost as map and flight grow: the synthetic flight is a possible one, and every field is there."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from terrafix.estimator.estimator import Estimator
from terrafix.estimator.measurements.telemetry_buffer import Telemetry
from terrafix.messages import Imu
from terrafix_tools.bench import growth, map_size
from terrafix_tools.bench.stream import FIX_EVERY, FRAME_S, LEG_S, ORIGIN, spoken


def test_the_estimator_follows_the_synthetic_flight() -> None:
    """Through the first turn: what is said belongs to one motion, or the times would be those of a lost estimator."""
    estimator, telemetry = Estimator(ORIGIN), Telemetry()
    frames, refused, inertial = round((LEG_S + 10.0) / FRAME_S), 0, 0
    for said in spoken(frames):
        for message in said.telemetry:
            (telemetry.add_imu if isinstance(message, Imu) else telemetry.add)(message)  # type: ignore[operator]
        t_ns = said.odometry.t_ns
        advance = estimator.advance(
            said.odometry.frame_id, t_ns * 1e-9, said.odometry, telemetry.at(t_ns), telemetry.felt
        )
        inertial += telemetry.felt(t_ns - round(FRAME_S * 1e9), t_ns) is not None
        if said.match is not None:
            refused += estimator.fix(said.match).verdict != "accepted"
        off_m = advance.placed.pose.translation() - said.p_m
        assert np.hypot(*off_m[:2]) < (40.0 if said.odometry.frame_id < 5 else 6.0)
    assert inertial == frames - 1
    assert refused <= 0.05 * frames / FIX_EVERY


@pytest.mark.slow
def test_every_field_of_a_longer_flight() -> None:
    found = growth.measure(30)
    assert found["frames"] == 30 and found["peak_memory_mb"] >= found["memory_in_flight_mb"] > 50.0
    assert list(found["covariance_cpu_ms"]) == [
        "of the smoother", "gtsam.Marginals, window", "gtsam.Marginals, whole flight"
    ]  # fmt: skip
    assert found["frame_cpu_ms"]["median"] > found["update_cpu_ms"]["median"] > 0.0
    assert found["update_cpu_ms"]["p99"] > found["update_cpu_ms"]["median"]


@pytest.mark.slow
def test_every_field_of_a_larger_map(tmp_path: Path) -> None:
    built = map_size.measure(0.25, tmp_path)
    assert min(built[key] for key in ("build_cpu_s", "build_s", "build_by_several_s", "speed_up")) > 0.0
    assert built["same_bytes"]
    assert built["area_km2"] == 0.25 and built["package_mb"] > 0.05 and not (tmp_path / "map.tif").exists()
    found = map_size.search(tmp_path / "map.gpkg")
    json.dumps(built | found, allow_nan=False)
    assert set(found["look_cpu_ms"]) == {"in flight", "lost"}
    assert len(found["window_ms"]) == len(map_size.WINDOW_GSD_M) and found["open_ms"] > 0.0
    assert all(0.0 < look["median"] <= look["p95"] for look in found["look_cpu_ms"].values())


def test_the_noise_is_different_everywhere() -> None:
    first, second = (map_size._block(np.random.default_rng([0, i * map_size.BLOCK_PX]))[..., 1] for i in (0, 1))
    agree = float(np.corrcoef(first.ravel(), second.ravel())[0, 1])
    assert abs(agree) < 0.2 and math.isfinite(agree) and first.std() > 20.0
