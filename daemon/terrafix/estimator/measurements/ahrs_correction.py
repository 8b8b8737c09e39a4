"""The autopilot's attitude without corrections that its gyroscopes did not measure, and how far off it may be.

An attitude that turns otherwise than its gyroscopes is being corrected: by gravity, by the compass, and by the velocity
that we send. In flight that is 0.1 degrees a second. A plane whose filter had been without a position in a turn
(ArduPilot firmware) was corrected by 1 to 5 degrees a second when one came back, past the right attitude. Odometry with
an attitude that swings like that gives a false velocity (a degree a second at 130 m is 2 m/s), the autopilot fuses it,
and the loop diverges. Gyroscopes are outside of that loop. So rotations that they did not measure are removed from the
attitude, and decay as slowly as gravity corrects a wrong tilt (TILT_CORRELATION_S)."""

import math
from collections import deque
from dataclasses import replace

import numpy as np

from terrafix.core.geodesy import euler_from_rot, rot_w_b
from terrafix.core.limits import MAX_SENT_VELOCITY_SIGMA_MPS
from terrafix.core.pose import exp_so3
from terrafix.estimator.measurements.telemetry_buffer import TURN_UNSEEN_RAD, UNKNOWN_ATTITUDE_RAD, Attitude, Telemetry
from terrafix.estimator.models.motion_model import TILT_CORRELATION_S, WorldAcceleration

# Of a rotation without the gyroscopes, what is no wrong correction: gyroscope bias hours after calibration (InvenSense
# DS-000347: 0.2 degrees a second) and ordinary corrections of the filter (with 0.2 for both together, simulated planes
# drifted twice as far on dead reckoning); and the share by scale and misalignment of the board (ArduPilot AHRS_TRIM).
ORDINARY_RADPS = math.radians(0.5)  # [measured: simulated planes]
MISALIGNED = 0.03  # [spec: InvenSense DS-000347]
# A filter without a position uses gravity alone, which a turn bends, and attributes the error to accelerometer biases:
# after five seconds without our position a plane's tilt (ArduPilot firmware, 42 times, half of them in a turn) was off
# by 1.3 degrees (each axis) for the minute that was observed, and by 0.2 before.
COAST_S = 3.0  # [tuned]
UNAIDED_RAD, UNAIDED_S = math.radians(1.5), 120.0  # [measured: ArduPilot firmware, 42 times]
BUFFER_FRAMES = 64  # whose correction is known: a motion increment begins at the frame before [tuned]


class AhrsCorrectionMonitor:
    """``attitude_at`` every frame, in order of time; then ``world_acceleration`` up to it; then ``position_published``.

    ``sent_ns``: time of the newest position that the autopilot got before this process began."""

    def __init__(self, telemetry: Telemetry, sent_ns: int | None = None) -> None:
        self._telemetry, self._sent_ns = telemetry, sent_ns
        self._unaided_ns: int | None = None  # newest frame at which the autopilot had no position
        self._last_ns: int | None = None
        self._recent: deque[tuple[float, np.ndarray]] = deque()  # time [s], tilt correction (2,) since then
        self._unmeasured = np.zeros(3)  # rotation without the gyroscopes about east, north, up; decays in TILT_S
        self._removed: deque[tuple[int, np.ndarray]] = deque([(0, np.zeros(3))], maxlen=BUFFER_FRAMES)

    def attitude_at(self, t_ns: int, tilt_sigma_rad: float, yaw_sigma_rad: float) -> Attitude:
        """The attitude at a frame: the reported one while the rotation without the gyroscopes is within twice the
        configured sigmas (each axis); what exceeds them is removed."""
        since_ns, self._last_ns = self._last_ns, t_ns
        if self._sent_ns is not None and t_ns - self._sent_ns > COAST_S * 1e9:
            self._unaided_ns = t_ns
        rotation = None if since_ns is None else self._telemetry.turn_without_gyro(since_ns, t_ns)
        if since_ns is None or rotation is None:
            self._unmeasured = np.zeros(3)  # unknown
        else:
            apart, turned_rad = rotation
            dt_s = (t_ns - since_ns) * 1e-9
            explained_rad = ORDINARY_RADPS * dt_s + MISALIGNED * turned_rad
            apart = max(0.0, 1.0 - explained_rad / max(float(np.linalg.norm(apart)), 1e-9)) * apart
            self._unmeasured = math.exp(-dt_s / TILT_CORRELATION_S) * self._unmeasured + apart
            self._recent.append((since_ns * 1e-9, np.zeros(2)))
            for _, turned in self._recent:
                turned += apart[:2]
        tilt, yaw = self._unmeasured[:2], abs(self._unmeasured[2])
        tilt_out = _unexplained_share(float(np.hypot(*tilt)), 2.0 * tilt_sigma_rad) * tilt
        out = np.array([*tilt_out, _unexplained_share(float(yaw), 2.0 * yaw_sigma_rad) * self._unmeasured[2]])
        self._removed.append((t_ns, out))
        attitude = self._telemetry.at(t_ns)
        extra_rad = self._extra_tilt_sigma_rad(t_ns * 1e-9, tilt_sigma_rad)
        attitude = _widened(attitude, extra_rad)
        if attitude.vehicle is not None:  # a gimbal levels by gyroscopes of its own
            attitude = replace(attitude, vehicle=_widened(attitude.vehicle, extra_rad))
            out = out * (0.0, 0.0, 1.0)
        if not out.any() or attitude.yaw_rad is None or attitude.pitch_rad is None or attitude.roll_rad is None:
            return attitude
        r_w_b = exp_so3(-out) @ rot_w_b(attitude.yaw_rad, attitude.pitch_rad, attitude.roll_rad)
        yaw_rad, pitch_rad, roll_rad = euler_from_rot(r_w_b)
        return replace(attitude, yaw_rad=yaw_rad, pitch_rad=pitch_rad, roll_rad=roll_rad)

    def position_published(self, t_ns: int, velocity_sigma_mps: float) -> None:
        """``velocity_sigma_mps`` of the estimate of a frame at ``t_ns``."""
        if velocity_sigma_mps <= MAX_SENT_VELOCITY_SIGMA_MPS:
            self._sent_ns = t_ns

    def world_acceleration(self, t0_ns: int, t1_ns: int) -> WorldAcceleration | None:
        """As ``Telemetry.world_acceleration``, with the attitude of ``attitude_at``."""
        times = [t_ns for t_ns, _ in self._removed]
        ends = np.array([[np.interp(t, times, axis) for t in (t0_ns, t1_ns)] for axis in self._axes()])
        return self._telemetry.world_acceleration(t0_ns, t1_ns, ends if ends.any() else None)

    def _axes(self) -> np.ndarray:
        return np.array([out for _, out in self._removed]).T

    def _extra_tilt_sigma_rad(self, now_s: float, sigma_rad: float) -> float:
        """1-sigma of the tilt beyond ``sigma_rad`` (each axis): the largest correction within TILT_CORRELATION_S, less
        the difference of two attitudes of that sigma, since the attitude before it may have been the wrong one; and
        what remains of a time without a position."""
        while self._recent and now_s - self._recent[0][0] > TILT_CORRELATION_S:
            self._recent.popleft()
        farthest_rad = max((float(np.hypot(*turned)) for _, turned in self._recent), default=0.0)
        righted2 = max(0.0, farthest_rad**2 - 4.0 * sigma_rad**2)
        return math.sqrt(righted2 + self._unaided_rad(now_s) ** 2)

    def _unaided_rad(self, now_s: float) -> float:
        if self._unaided_ns is None:
            return 0.0
        return UNAIDED_RAD * math.exp(-(now_s - self._unaided_ns * 1e-9) / UNAIDED_S)


def _widened(attitude: Attitude, extra_rad: float) -> Attitude:
    """``extra_rad``: 1-sigma of the tilt beyond the configured one and that of an old report."""
    righted_rad = math.hypot(attitude.righted_rad, extra_rad, attitude.stale * UNKNOWN_ATTITUDE_RAD)
    turned_rad = math.hypot(attitude.turned_rad, attitude.stale * TURN_UNSEEN_RAD)
    return replace(attitude, righted_rad=righted_rad, turned_rad=turned_rad)


def _unexplained_share(turned_rad: float, explained_rad: float) -> float:
    """Share of a rotation beyond ``explained_rad``, the difference of two attitudes with that error."""
    return math.sqrt(1.0 - (explained_rad / turned_rad) ** 2) if turned_rad > explained_rad else 0.0
