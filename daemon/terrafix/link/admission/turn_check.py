"""Whether an attitude turned as the gyroscopes did: what jumps is refused until it has stayed where it jumped to.

A filter that corrects its attitude does it slowly; estimator/measurements/ahrs_correction.py sees to that. A jump is
another sender, or a reset of the filter: then the new attitude goes on from there, and the old one is not heard any
more."""

import math
from collections import deque
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from terrafix.core.geodesy import rot_w_b
from terrafix.core.pose import exp_so3

# False alarms: of an acrobatic copter (ArduCopter's log171.bin, attitudes at 10 Hz, gyroscopes at 50 Hz, turns of up to
# 1600 degrees a second) 8 of 2234 attitudes are refused, in two episodes of 0.4 s; and 14 of 149 when it crashed then.
JUMP_RAD = math.radians(5.0)
OF_TURN = 0.1  # of the angle that was turned: timing, scale and alignment of the gyroscopes
OF_TURN_BY_ENDS = 0.5  # where the rates of the two attitudes are all that is known of the time between them
MAX_GAP_NS = 150_000_000  # between two readings, so that they cover the time between two attitudes
MAX_BY_ENDS_NS = (
    130_000_000  # between two attitudes without readings (10 Hz, with jitter): copters begin and end a turn in more
)
MAX_APART_NS = 1_000_000_000  # attitudes further apart are not compared
MEMORY_NS = 2_000_000_000
CONFIRM_NS = 1_000_000_000  # the new attitude alone was heard for so long

Vec3 = tuple[float, float, float]


@dataclass(frozen=True)
class Said:
    """An attitude with the rates of the same message (forward, right, down), ``boot_ns`` since the autopilot's boot."""

    boot_ns: int
    r_w_b: np.ndarray
    rates_radps: Vec3


def said(boot_ns: int, yaw_pitch_roll_rad: Vec3, rates_radps: Vec3) -> Said:
    """``rates_radps`` that are not finite are taken for none."""
    forward, right, down = (rate if math.isfinite(rate) else 0.0 for rate in rates_radps)
    return Said(boot_ns, rot_w_b(*yaw_pitch_roll_rad), (forward, right, down))


class TurnCheck:
    """``add`` each reading of the gyroscopes, ``refuses`` each attitude."""

    def __init__(self) -> None:
        self._rates: deque[tuple[int, np.ndarray]] = deque()  # ns since boot; forward, right, down [rad/s]
        self._newest: Said | None = None
        self._new: Said | None = None  # not believed yet
        self._new_since_ns = 0

    def add(self, boot_ns: int, rates_radps: Vec3) -> None:
        if self._rates and boot_ns <= self._rates[-1][0]:
            return
        self._rates.append((boot_ns, np.array(rates_radps)))
        while boot_ns - self._rates[0][0] > MEMORY_NS:
            self._rates.popleft()

    def refuses(self, attitude: Said) -> str:
        """-> why it is not taken; empty: it is."""
        apart_rad, from_new_rad = self._apart_rad(self._newest, attitude), self._apart_rad(self._new, attitude)
        if apart_rad == 0.0 or (apart_rad is None and from_new_rad is None):
            if self._newest is None or attitude.boot_ns > self._newest.boot_ns:
                self._newest = attitude
            self._new = None
            return ""
        if from_new_rad != 0.0:
            self._new_since_ns = attitude.boot_ns
        self._new = attitude
        if attitude.boot_ns - self._new_since_ns < CONFIRM_NS:
            degrees = math.degrees(apart_rad or from_new_rad or 0.0)
            return f"jumps by {degrees:.0f} degrees that its gyroscopes did not turn"
        self._newest, self._new = attitude, None
        return ""

    def _apart_rad(self, one: Said | None, other: Said) -> float | None:
        """Angle between them that nothing turned; 0: none beyond what may be; None: they cannot be compared."""
        if one is None or abs(other.boot_ns - one.boot_ns) > MAX_APART_NS:
            return None
        before, after = (one, other) if one.boot_ns <= other.boot_ns else (other, one)
        turned = self._turned(before, after)
        if turned is None:
            return None
        turn, allowed_rad = turned
        apart = turn.T @ before.r_w_b.T @ after.r_w_b
        angle = math.acos(min(1.0, max(-1.0, (float(np.trace(apart)) - 1.0) / 2.0)))
        return angle if angle > JUMP_RAD + allowed_rad else 0.0

    def _turned(self, before: Said, after: Said) -> tuple[np.ndarray, float] | None:
        """-> rotation from ``before`` to ``after`` by the gyroscopes (3x3), and by how much it may be off [rad].

        None: nobody knows."""
        dt_ns = after.boot_ns - before.boot_ns
        inside = [r for r in self._rates if before.boot_ns - MAX_GAP_NS <= r[0] <= after.boot_ns + MAX_GAP_NS]
        times = [before.boot_ns, *(t for t, _ in inside if before.boot_ns < t < after.boot_ns), after.boot_ns]
        if not inside or max(b - a for a, b in pairwise(times)) > MAX_GAP_NS:
            return _by_ends(before, after, dt_ns)
        turn, path_rad = np.eye(3), 0.0
        for t0, t1 in pairwise(times):
            step = _nearest(inside, (t0 + t1) // 2) * ((t1 - t0) * 1e-9)
            turn, path_rad = turn @ exp_so3(step), path_rad + float(np.linalg.norm(step))
        return turn, OF_TURN * path_rad


def _nearest(rates: list[tuple[int, np.ndarray]], boot_ns: int) -> np.ndarray:
    return min(rates, key=lambda r: abs(r[0] - boot_ns))[1]


def _by_ends(before: Said, after: Said, dt_ns: int) -> tuple[np.ndarray, float] | None:
    if dt_ns > MAX_BY_ENDS_NS:
        return None
    first, last = np.array(before.rates_radps), np.array(after.rates_radps)
    fastest = max(float(np.linalg.norm(first)), float(np.linalg.norm(last)))
    return exp_so3((first + last) / 2 * (dt_ns * 1e-9)), OF_TURN_BY_ENDS * fastest * dt_ns * 1e-9
