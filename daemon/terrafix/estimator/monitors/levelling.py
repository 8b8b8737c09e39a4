"""Roll and pitch that are swapped or of the wrong sign, from pictures that they level.

Levelled with the true attitude, pictures show a velocity that changes slowly; levelled with a wrong one they show a
jump by twice the change of tilt. So each way to be wrong is tried: the attitude that levels best is the true one. It
needs neither a map nor inertial readings, and tells nothing while the vehicle does not tilt."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.monitors.cusum import Cusum, threshold
from terrafix.estimator.monitors.sighting import sighting

STEPS_PER_HOUR = 3600.0  # at most one comparison a second
TILT_RAD = np.radians(0.7)  # 1-sigma of a reported change of tilt between two frames
ACCELERATION_MPS2 = 3.0  # 1-sigma of what a vehicle's velocity changes by
REMEMBERED = 0.95  # of how badly a way fits, from one comparison to the next
LONGEST_S = 3.0  # between two velocities that are compared


def _tilted(roll: float, pitch: float) -> Callable[[Attitude], Attitude]:
    def change(attitude: Attitude) -> Attitude:
        assert attitude.roll_rad is not None and attitude.pitch_rad is not None
        return replace(attitude, roll_rad=roll * attitude.roll_rad, pitch_rad=pitch * attitude.pitch_rad)

    return change


def _swapped(attitude: Attitude) -> Attitude:
    return replace(attitude, roll_rad=attitude.pitch_rad, pitch_rad=attitude.roll_rad)


WAYS: dict[str, Callable[[Attitude], Attitude]] = {
    "sign of roll": _tilted(-1.0, 1.0),
    "sign of pitch": _tilted(1.0, -1.0),
    "signs of roll and pitch": _tilted(-1.0, -1.0),
    "roll and pitch swapped": _swapped,
}


@dataclass(frozen=True)
class _Velocity:
    """East and north [heights/s], (2,): as reported, and by each of WAYS; over ``span_s`` before ``t_s``."""

    t_s: float
    span_s: float
    reported: np.ndarray
    otherwise: list[np.ndarray]


class LevellingMonitor:
    def __init__(self) -> None:
        limit = threshold(STEPS_PER_HOUR, len(WAYS))
        self._tests = {name: Cusum(limit) for name in WAYS}
        self._misfits = dict.fromkeys(WAYS, 0.0)  # squares of the last jumps, in sigmas: which way it is
        self._last: _Velocity | None = None

    @property
    def fault(self) -> str:
        """Of the ways that have been accepted the one that levels best; empty: none was."""
        active = [name for name, test in self._tests.items() if test.active]
        return min(active, key=self._misfits.__getitem__, default="")

    def add(
        self, pairs: np.ndarray, before: Attitude, now: Attitude, r_b_c: np.ndarray, span: tuple[float, float]
    ) -> None:
        """``pairs`` (N, 4) of a keyframe and a frame, their attitudes, R_b_c (3x3), and their times [s]."""
        if None in (before.roll_rad, before.pitch_rad, now.roll_rad, now.pitch_rad, now.agl_m):
            return
        span_s = span[1] - span[0]
        ways = (lambda attitude: attitude, *WAYS.values())
        seen = [sighting(pairs, way(before), way(now), r_b_c) for way in ways]
        moved = [one.moved / span_s for one in seen if one is not None]
        if len(moved) < len(ways):
            return
        last, self._last = self._last, _Velocity(span[1], span_s, moved[0], moved[1:])
        if last is None or not 0.0 < span[1] - last.t_s <= LONGEST_S:
            return
        assert now.agl_m is not None
        tilt = TILT_RAD * np.hypot(1.0 / span_s, 1.0 / last.span_s)
        gain = ACCELERATION_MPS2 * (span[1] - last.t_s + 0.5 * (span_s + last.span_s)) / max(now.agl_m, 10.0)
        variance = 2.0 * (tilt**2 + gain**2)
        as_reported = float(np.sum((moved[0] - last.reported) ** 2))
        for i, (name, test) in enumerate(self._tests.items()):
            other = float(np.sum((moved[1 + i] - last.otherwise[i]) ** 2))
            self._misfits[name] = REMEMBERED * self._misfits[name] + other / variance
            test.add((as_reported - other) / variance)
