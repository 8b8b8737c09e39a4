"""What the inertial sensors felt in the last seconds: the velocity that was gained, and the way that it makes.

A copter that leans to a corner changes its velocity by 5 m/s in a second: what is carried on as constant from a picture
that is 0.6 s old would be 3 m/s off. Readings are levelled by the attitude that was said last, as in the estimator."""

from collections import deque
from itertools import pairwise

import numpy as np

from terrafix.core.geodesy import rot_w_b
from terrafix.messages import Imu, VehicleState

GRAVITY_MPS2 = 9.81
MEMORY_NS = 4_000_000_000  # longer than any carry (fix.MAX_AGE_NS)
MAX_GAP_NS = 150_000_000  # between readings, and from the last one to now: a serial line may have room for 10 Hz only
MAX_TURN_AGE_NS = 260_000_000  # ATTITUDE at 4 Hz, ArduPilot's own rate, turns a vehicle too far between two

Vec3 = tuple[float, float, float]


class InertialIntegrator:
    """``turn`` each attitude, ``add`` each bundle of readings."""

    def __init__(self) -> None:
        self._accel: deque[tuple[int, float, float, float]] = deque()  # t_ns; east, north, up, by the compass
        self._r_w_b = np.eye(3)
        self._turned_ns: int | None = None

    def turn(self, state: VehicleState) -> None:
        if state.yaw_rad is None or state.roll_rad is None or state.pitch_rad is None:
            return
        self._r_w_b = rot_w_b(state.yaw_rad, state.pitch_rad, state.roll_rad)
        self._turned_ns = state.t_ns

    def add(self, imu: Imu) -> None:
        if self._turned_ns is None:
            return
        if self._accel and imu.t_ns - self._accel[-1][0] > MEMORY_NS:
            self._accel.clear()
        for before_ns, forward, right, down, *_ in imu.samples:
            t_ns = imu.t_ns - before_ns
            newer = not self._accel or t_ns > self._accel[-1][0]
            if newer and abs(t_ns - self._turned_ns) <= MAX_TURN_AGE_NS:
                east, north, up = self._r_w_b @ (forward, right, down)
                self._accel.append((t_ns, float(east), float(north), float(up) - GRAVITY_MPS2))
        while self._accel and self._accel[-1][0] - self._accel[0][0] > MEMORY_NS:
            self._accel.popleft()

    def since(self, t0_ns: int, t1_ns: int) -> tuple[Vec3, Vec3] | None:
        """Velocity gained from ``t0_ns`` to ``t1_ns``, and the way that this made (east, north, up; by the compass).
        None: the readings do not cover that. Each reading holds from the middle between it and its neighbours."""
        inside = [a for a in self._accel if t0_ns - MAX_GAP_NS <= a[0] <= t1_ns + MAX_GAP_NS]
        if not inside or inside[0][0] > t0_ns + MAX_GAP_NS or inside[-1][0] < t1_ns - MAX_GAP_NS:
            return None
        times = [a[0] for a in inside]
        if max((b - a for a, b in pairwise(times)), default=0) > MAX_GAP_NS:
            return None
        middles = [(a + b) // 2 for a, b in pairwise(times)]
        gain, way = np.zeros(3), np.zeros(3)
        for begin, end, a in zip([t0_ns, *middles], [*middles, t1_ns], inside, strict=True):
            held_s = (min(max(end, t0_ns), t1_ns) - min(max(begin, t0_ns), t1_ns)) * 1e-9
            accel = np.array(a[1:])
            way += gain * held_s + 0.5 * accel * held_s**2
            gain += accel * held_s
        return _vec3(gain), _vec3(way)


def _vec3(v: np.ndarray) -> Vec3:
    return float(v[0]), float(v[1]), float(v[2])
