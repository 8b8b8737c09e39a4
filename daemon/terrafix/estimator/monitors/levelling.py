"""Swapped or inverted roll and pitch, from the visual velocity of images that are levelled with them.

With the true attitude the visual velocity changes slowly. With a wrong one it jumps by twice the change of tilt. Each
possible fault is tested: the attitude that gives the smoothest velocity is the true one. The test needs neither a map
nor inertial readings, and gains no information while the vehicle does not tilt."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.monitors.cusum import COMPARISONS_PER_HOUR, Cusum, threshold
from terrafix.estimator.monitors.visual_motion import visual_motion

TILT_CHANGE_SIGMA_RAD = np.radians(0.7)  # 1-sigma of a reported change of tilt between two frames [tuned]
ACCELERATION_SIGMA_MPS2 = 3.0  # m/s^2, 1-sigma of a vehicle's acceleration [tuned]
MISFIT_MEMORY = 0.95  # exponential forgetting of the misfit of a fault, per comparison [tuned]
MAX_INTERVAL_S = 3.0  # s between two velocities that are compared [tuned]


def _scaled(roll: float, pitch: float) -> Callable[[Attitude], Attitude]:
    def change(attitude: Attitude) -> Attitude:
        assert attitude.roll_rad is not None and attitude.pitch_rad is not None
        return replace(attitude, roll_rad=roll * attitude.roll_rad, pitch_rad=pitch * attitude.pitch_rad)

    return change


def _swapped(attitude: Attitude) -> Attitude:
    return replace(attitude, roll_rad=attitude.pitch_rad, pitch_rad=attitude.roll_rad)


# Fault -> the true attitude from the reported one.
TILT_FAULTS: dict[str, Callable[[Attitude], Attitude]] = {
    "sign of roll": _scaled(-1.0, 1.0),
    "sign of pitch": _scaled(1.0, -1.0),
    "signs of roll and pitch": _scaled(-1.0, -1.0),
    "roll and pitch swapped": _swapped,
}


@dataclass(frozen=True)
class _Velocity:
    """Visual velocity, east and north [heights/s], (2,), over ``span_s`` before ``t_s``: levelled with the reported
    attitude, and with that of each of TILT_FAULTS."""

    t_s: float
    span_s: float
    reported: np.ndarray
    by_fault: list[np.ndarray]


class LevellingMonitor:
    """One CUSUM per fault."""

    def __init__(self) -> None:
        limit = threshold(COMPARISONS_PER_HOUR, len(TILT_FAULTS))
        self._tests = {name: Cusum(limit) for name in TILT_FAULTS}
        self._misfits = dict.fromkeys(TILT_FAULTS, 0.0)  # squared jumps in sigmas: select among active faults
        self._last: _Velocity | None = None

    @property
    def fault(self) -> str:
        """The fault with the smallest misfit among those whose alarm is active; empty: none is."""
        active = [name for name, test in self._tests.items() if test.active]
        return min(active, key=self._misfits.__getitem__, default="")

    def add(
        self, pairs: np.ndarray, before: Attitude, now: Attitude, r_b_c: np.ndarray, span: tuple[float, float]
    ) -> None:
        """``pairs`` (N, 4) of a keyframe and a frame, their attitudes, R_b_c (3x3), and their times [s]."""
        if None in (before.roll_rad, before.pitch_rad, now.roll_rad, now.pitch_rad, now.agl_m):
            return
        span_s = span[1] - span[0]
        attitudes = (lambda attitude: attitude, *TILT_FAULTS.values())
        motions = [visual_motion(pairs, corrected(before), corrected(now), r_b_c) for corrected in attitudes]
        velocities = [one.displacement / span_s for one in motions if one is not None]
        if len(velocities) < len(attitudes):
            return
        last, self._last = self._last, _Velocity(span[1], span_s, velocities[0], velocities[1:])
        if last is None or not 0.0 < span[1] - last.t_s <= MAX_INTERVAL_S:
            return
        assert now.agl_m is not None
        tilt = TILT_CHANGE_SIGMA_RAD * np.hypot(1.0 / span_s, 1.0 / last.span_s)
        gain = ACCELERATION_SIGMA_MPS2 * (span[1] - last.t_s + 0.5 * (span_s + last.span_s)) / max(now.agl_m, 10.0)
        variance = 2.0 * (tilt**2 + gain**2)
        reported_jump2 = float(np.sum((velocities[0] - last.reported) ** 2))
        for i, (name, test) in enumerate(self._tests.items()):
            jump2 = float(np.sum((velocities[1 + i] - last.by_fault[i]) ** 2))
            self._misfits[name] = MISFIT_MEMORY * self._misfits[name] + jump2 / variance
            test.add((reported_jump2 - jump2) / variance)
