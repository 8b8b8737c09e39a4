"""Swapped or inverted roll and pitch are identified by the attitude that levels the pictures."""

import math
from dataclasses import replace

import numpy as np
import pytest

from terrafix.core.camera import Mount
from terrafix.core.geodesy import rot_w_b
from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.monitors.levelling import TILT_FAULTS, LevellingMonitor

R_B_C = Mount().r_b_c()
AGL_M = 100.0


def attitude(t_s: float, tilts_deg: float) -> Attitude:
    """Attitude of a vehicle that rolls and pitches with different periods."""
    roll, pitch = tilts_deg * math.sin(t_s / 1.9), 0.6 * tilts_deg * math.sin(t_s / 1.3 + 1.0)
    return Attitude(0.4, math.radians(pitch), math.radians(roll), AGL_M, armed=True)


def rays(t_s: float, ground: np.ndarray, tilts_deg: float) -> np.ndarray:
    """(N, 2): normalised image points of the ground (N, 2) [m], from a camera that flies east at 15 m/s, north at 5."""
    sample = attitude(t_s, tilts_deg)
    r_w_c = rot_w_b(sample.yaw_rad or 0.0, sample.pitch_rad or 0.0, sample.roll_rad or 0.0) @ R_B_C
    away = np.column_stack([ground - (15.0 * t_s, 5.0 * t_s), np.full(len(ground), -AGL_M)]) @ r_w_c
    return away[:, :2] / away[:, 2:]


def flown(report: str = "", *, tilts_deg: float = 12.0, seconds: int = 90, seed: int = 1) -> LevellingMonitor:
    rng, monitor = np.random.default_rng(seed), LevellingMonitor()

    def reported(t_s: float) -> Attitude:
        sample = attitude(t_s, tilts_deg)
        sample = TILT_FAULTS[report](sample) if report else sample
        assert sample.roll_rad is not None and sample.pitch_rad is not None
        noise = np.radians(0.3) * rng.normal(size=2)
        return replace(sample, roll_rad=sample.roll_rad + noise[0], pitch_rad=sample.pitch_rad + noise[1])

    for t_s in np.arange(0.0, float(seconds), 1.0):
        ground = rng.uniform(-40.0, 40.0, (40, 2)) + np.array([15.0, 5.0]) * t_s
        pairs = np.hstack([rays(t, ground, tilts_deg) for t in (t_s, t_s + 0.5)])
        pairs += 1e-3 * rng.normal(size=pairs.shape)
        monitor.add(pairs, reported(t_s), reported(t_s + 0.5), R_B_C, (t_s, t_s + 0.5))
    return monitor


@pytest.mark.parametrize("way", list(TILT_FAULTS))
def test_each_tilt_fault_is_identified(way: str) -> None:
    assert flown(way).fault == way


@pytest.mark.parametrize("seed", range(4))
def test_a_correct_attitude_raises_no_levelling_fault(seed: int) -> None:
    assert flown(seconds=300, seed=seed).fault == ""


def test_without_tilt_no_levelling_fault_is_raised() -> None:
    assert flown("signs of roll and pitch", tilts_deg=0.5).fault == ""


def test_unknown_attitudes_raise_no_levelling_fault() -> None:
    monitor, unknown = LevellingMonitor(), Attitude(0.4, None, None, AGL_M)
    monitor.add(np.zeros((20, 4)), unknown, unknown, R_B_C, (0.0, 0.5))
    assert monitor.fault == ""


def test_velocities_beyond_the_maximum_interval_are_not_compared() -> None:
    monitor = LevellingMonitor()
    rng = np.random.default_rng(1)
    for k in range(60):
        t_s = 10.0 * k
        ground = rng.uniform(-40.0, 40.0, (40, 2)) + np.array([15.0, 5.0]) * t_s
        pairs = np.hstack([rays(t, ground, 12.0) for t in (t_s, t_s + 0.5)])
        wrong = [TILT_FAULTS["sign of roll"](attitude(t, 12.0)) for t in (t_s, t_s + 0.5)]
        monitor.add(pairs, wrong[0], wrong[1], R_B_C, (t_s, t_s + 0.5))
    assert monitor.fault == ""
