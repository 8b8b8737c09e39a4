"""The autopilot's attitude as its gyroscopes felt it turn, where it was put right otherwise, and how far off it may be.

An attitude that turns otherwise than the gyroscopes felt is being corrected: by gravity, by the compass, and by what we
tell the autopilot of its motion. In flight that is a tenth of a degree a second. A plane whose filter had been without
a position in a turn (ArduPilot's firmware) was put right by 1 to 5 degrees a second when one came back, and not to
where it should be: from an attitude that sways so, pictures tell of a velocity that nobody flies (a degree a second at
130 m is 2 m/s), the autopilot believes it, and sways by it, until its attitude is lost. Gyroscopes do not hear of our
velocity. So turns that they did not feel are taken out of the attitude, and let in again only as slowly as a wrong tilt
is found out by gravity (TILT_S)."""

import math
from collections import deque
from dataclasses import replace

import numpy as np

from terrafix.core.geodesy import angles_of, rot_w_b
from terrafix.core.pose import exp_so3
from terrafix.estimator.measurements.telemetry_buffer import Attitude, Telemetry
from terrafix.estimator.models.motion_model import TILT_S, WorldAcceleration

# So much of a turn nobody has put right wrongly: what gyroscopes are off by hours after their calibration (InvenSense
# DS-000347: 0.2 degrees a second) and what an attitude filter mends in ordinary flight (at 0.2 for both together,
# simulated planes drifted twice as far on dead reckoning); and the share that their scale leaves out, and their axes,
# which are those of the board: an attitude is that of the vehicle (ArduPilot's AHRS_TRIM).
ORDINARY_RADPS = math.radians(0.5)
MISALIGNED = 0.03
# A filter that has no position leans on gravity alone, which a turn bends, and takes what is wrong then for a bias of
# its accelerometers: after five seconds without us a plane's tilt (ArduPilot's firmware, 42 times, half of them in a
# turn) was off by 1.3 degrees (each axis) for as long as it was looked at, a minute, and by 0.2 before.
AIDS_MPS = 1.5  # 1-sigma of a velocity up to which the link lets an autopilot have it
COASTS_S = 3.0
UNAIDED_RAD, UNAIDED_S = math.radians(1.5), 120.0
FRAMES_KEPT = 64  # whose correction is known: a leg begins at the frame before


class AhrsCorrectionMonitor:
    """``look`` at every frame, in order of time; then ``felt`` up to it; then ``told`` what an autopilot gets of it.

    ``told_ns``: when it got something before this process began."""

    def __init__(self, said: Telemetry, told_ns: int | None = None) -> None:
        self._said, self._told_ns = said, told_ns
        self._unaided_ns: int | None = None  # newest frame at which the autopilot had no position
        self._last_ns: int | None = None
        self._lately: deque[tuple[float, np.ndarray]] = deque()  # seconds, tilt (2,) by which it was put right since
        self._unfelt = np.zeros(3)  # turned without being felt, about east, north, up; forgotten in TILT_S
        self._taken_out: deque[tuple[int, np.ndarray]] = deque([(0, np.zeros(3))], maxlen=FRAMES_KEPT)

    def look(self, t_ns: int, tilt_sigma_rad: float, yaw_sigma_rad: float) -> Attitude:
        """The attitude at a frame: as it is said while it turns as it was felt, within twice the sigmas that are
        claimed for it (each axis): beyond, as it was felt."""
        since_ns, self._last_ns = self._last_ns, t_ns
        if self._told_ns is not None and t_ns - self._told_ns > COASTS_S * 1e9:
            self._unaided_ns = t_ns
        way = None if since_ns is None else self._said.turned_otherwise(since_ns, t_ns)
        if since_ns is None or way is None:
            self._unfelt = np.zeros(3)  # nobody knows what it was turned by
        else:
            apart, turned_rad = way
            dt_s = (t_ns - since_ns) * 1e-9
            explained_rad = ORDINARY_RADPS * dt_s + MISALIGNED * turned_rad
            apart = max(0.0, 1.0 - explained_rad / max(float(np.linalg.norm(apart)), 1e-9)) * apart
            self._unfelt = math.exp(-dt_s / TILT_S) * self._unfelt + apart
            self._lately.append((since_ns * 1e-9, np.zeros(2)))
            for _, turned in self._lately:
                turned += apart[:2]
        tilt, yaw = self._unfelt[:2], abs(self._unfelt[2])
        tilt_out = _beyond(float(np.hypot(*tilt)), 2.0 * tilt_sigma_rad) * tilt
        out = np.array([*tilt_out, _beyond(float(yaw), 2.0 * yaw_sigma_rad) * self._unfelt[2]])
        self._taken_out.append((t_ns, out))
        attitude = replace(self._said.at(t_ns), righted_rad=self._off_rad(t_ns * 1e-9, tilt_sigma_rad))
        if not out.any() or attitude.yaw_rad is None or attitude.pitch_rad is None or attitude.roll_rad is None:
            return attitude
        r_w_b = exp_so3(-out) @ rot_w_b(attitude.yaw_rad, attitude.pitch_rad, attitude.roll_rad)
        yaw_rad, pitch_rad, roll_rad = angles_of(r_w_b)
        return replace(attitude, yaw_rad=yaw_rad, pitch_rad=pitch_rad, roll_rad=roll_rad)

    def told(self, t_ns: int, velocity_sigma_mps: float) -> None:
        """The estimate of a frame."""
        if velocity_sigma_mps <= AIDS_MPS:
            self._told_ns = t_ns

    def felt(self, t0_ns: int, t1_ns: int) -> WorldAcceleration | None:
        """As ``Telemetry.felt``, by the attitude that ``look`` gives."""
        times = [t_ns for t_ns, _ in self._taken_out]
        ends = np.array([[np.interp(t, times, axis) for t in (t0_ns, t1_ns)] for axis in self._axes()])
        return self._said.felt(t0_ns, t1_ns, ends if ends.any() else None)

    def _axes(self) -> np.ndarray:
        return np.array([out for _, out in self._taken_out]).T

    def _off_rad(self, now_s: float, sigma_rad: float) -> float:
        """1-sigma of the tilt, besides the ``sigma_rad`` (each axis) that is said of it: the farthest that it was put
        right within TILT_S, less what two attitudes that are off by that differ by. It may have been wrong before. And
        what is left of a time without a position."""
        while self._lately and now_s - self._lately[0][0] > TILT_S:
            self._lately.popleft()
        farthest_rad = max((float(np.hypot(*turned)) for _, turned in self._lately), default=0.0)
        righted2 = max(0.0, farthest_rad**2 - 4.0 * sigma_rad**2)
        return math.sqrt(righted2 + self._unaided_rad(now_s) ** 2)

    def _unaided_rad(self, now_s: float) -> float:
        if self._unaided_ns is None:
            return 0.0
        return UNAIDED_RAD * math.exp(-(now_s - self._unaided_ns * 1e-9) / UNAIDED_S)


def _beyond(turned_rad: float, explained_rad: float) -> float:
    """Share of a turn that is not explained by two attitudes that are off by so much."""
    return math.sqrt(1.0 - (explained_rad / turned_rad) ** 2) if turned_rad > explained_rad else 0.0
