"""Velocity and position increments from the accelerometers of the last seconds.

A copter that rolls into a corner changes its velocity by 5 m/s within a second. Prediction with constant velocity from
an image that is 0.6 s old would then be 3 m/s off. Specific forces are rotated by the last reported attitude, as in the
estimator."""

from collections import deque

import numpy as np

from terrafix.core.geodesy import rot_w_b
from terrafix.core.inertial import GRAVITY_MPS2, covers, integrate_held
from terrafix.messages import Imu, VehicleState

BUFFER_NS = 4_000_000_000  # ns of readings; longer than any prediction (fix_type.MAX_AGE_NS) [tuned]
# Largest interval between readings, and from the last one to the end of the increment, ns: a serial line may have room
# for 10 Hz only. [tuned]
MAX_IMU_GAP_NS = 150_000_000
# Largest age of the attitude at a reading, ns. One period of ATTITUDE at ArduPilot's default of 4 Hz is still accepted;
# over longer intervals a vehicle turns too far. [tuned]
MAX_ATTITUDE_AGE_NS = 260_000_000

Vec3 = tuple[float, float, float]


class InertialIntegrator:
    """``add_attitude`` each attitude, ``add_imu`` each bundle of readings, ``delta`` for the increment of an interval.

    World axes: east, north, up by the autopilot's heading (its compass)."""

    def __init__(self) -> None:
        self._accel: deque[tuple[int, float, float, float]] = deque()  # t_ns; acceleration east, north, up [m/s^2]
        self._r_w_b = np.eye(3)
        self._attitude_t_ns: int | None = None

    def add_attitude(self, state: VehicleState) -> None:
        if state.yaw_rad is None or state.roll_rad is None or state.pitch_rad is None:
            return
        self._r_w_b = rot_w_b(state.yaw_rad, state.pitch_rad, state.roll_rad)
        self._attitude_t_ns = state.t_ns

    def add_imu(self, imu: Imu) -> None:
        if self._attitude_t_ns is None:
            return
        if self._accel and imu.t_ns - self._accel[-1][0] > BUFFER_NS:
            self._accel.clear()
        for before_ns, forward, right, down, *_ in imu.samples:
            t_ns = imu.t_ns - before_ns
            newer = not self._accel or t_ns > self._accel[-1][0]
            if newer and abs(t_ns - self._attitude_t_ns) <= MAX_ATTITUDE_AGE_NS:
                east, north, up = self._r_w_b @ (forward, right, down)
                self._accel.append((t_ns, float(east), float(north), float(up) - GRAVITY_MPS2))
        while self._accel and self._accel[-1][0] - self._accel[0][0] > BUFFER_NS:
            self._accel.popleft()

    def delta(self, t0_ns: int, t1_ns: int) -> tuple[Vec3, Vec3] | None:
        """-> (velocity increment [m/s], position increment that it causes [m]) from ``t0_ns`` to ``t1_ns``, in east,
        north, up by the compass; None when the readings do not cover the interval."""
        inside = [a for a in self._accel if t0_ns - MAX_IMU_GAP_NS <= a[0] <= t1_ns + MAX_IMU_GAP_NS]
        times = [a[0] for a in inside]
        if not covers(times, t0_ns, t1_ns, MAX_IMU_GAP_NS):
            return None
        delta_v, delta_p = integrate_held(times, [a[1:] for a in inside], t0_ns, t1_ns)
        return _vec3(delta_v), _vec3(delta_p)


def _vec3(v: np.ndarray) -> Vec3:
    return float(v[0]), float(v[1]), float(v[2])
