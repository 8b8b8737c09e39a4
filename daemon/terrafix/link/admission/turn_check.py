"""Consistency check of the autopilot's attitude with its gyroscopes. An attitude that jumps is rejected until only the
new attitude has been received for ``ATTITUDE_CONFIRM_NS``.

An AHRS corrects its attitude slowly; estimator/measurements/ahrs_correction.py handles such corrections. A jump comes
from another sender, or from a reset of the AHRS: in that case the attitude continues from the new value, and the old
one is not received any more."""

import math
from collections import deque
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from terrafix.core.geodesy import rot_w_b
from terrafix.core.pose import exp_so3

# False alarms: for an acrobatic copter (ArduCopter's log171.bin, attitude at 10 Hz, gyroscopes at 50 Hz, up to 1600
# degrees/s) 8 of 2234 attitudes are rejected, in two episodes of 0.4 s, and 14 of 149 during the crash that followed.
# An attitude jumps if the turn that the gyroscopes do not explain exceeds JUMP_RAD plus a share of the turned angle.
JUMP_RAD = math.radians(5.0)  # [tuned]
TURN_ERROR_SHARE = 0.1  # of the turned angle: errors of timing, scale and alignment of the gyroscopes [tuned]
ENDPOINT_TURN_ERROR_SHARE = 0.5  # the same, if only the rates at the two attitudes are known [tuned]
# longest gap between gyroscope readings that cover the time between two attitudes [tuned]
MAX_GYRO_GAP_NS = 150_000_000
# Between two attitudes without gyroscope readings (10 Hz, with jitter). In a longer time a copter can begin and end a
# turn, which the rates at both ends do not show. [tuned]
MAX_ENDPOINT_SPAN_NS = 130_000_000
MAX_COMPARED_SPAN_NS = 1_000_000_000  # attitudes further apart are not compared [tuned]
RATE_HISTORY_NS = 2_000_000_000  # gyroscope readings older than this are dropped [tuned]
ATTITUDE_CONFIRM_NS = 1_000_000_000  # time for which only the new attitude must be received [tuned]

Vec3 = tuple[float, float, float]


@dataclass(frozen=True)
class AttitudeSample:
    """An attitude with the body rates of the same message (FRD). ``boot_ns``: time since the autopilot's boot;
    ``r_w_b``: rotation matrix (3, 3), body to world."""

    boot_ns: int
    r_w_b: np.ndarray
    rates_radps: Vec3


def attitude_sample(boot_ns: int, yaw_pitch_roll_rad: Vec3, rates_radps: Vec3) -> AttitudeSample:
    """``yaw_pitch_roll_rad`` and ``rates_radps`` (FRD) as in ATTITUDE. A rate that is not finite is replaced by 0."""
    forward, right, down = (rate if math.isfinite(rate) else 0.0 for rate in rates_radps)
    return AttitudeSample(boot_ns, rot_w_b(*yaw_pitch_roll_rad), (forward, right, down))


class TurnCheck:
    """Compares the turn between attitudes with the integrated gyroscope readings."""

    def __init__(self) -> None:
        self._rates: deque[tuple[int, np.ndarray]] = deque()  # (ns since boot, body rates FRD [rad/s])
        self._accepted: AttitudeSample | None = None
        self._candidate: AttitudeSample | None = None  # attitude after a jump, not confirmed yet
        self._candidate_since_ns = 0

    def add(self, boot_ns: int, rates_radps: Vec3) -> None:
        """Adds a gyroscope reading (body rates FRD); one that is not newer than the last is ignored."""
        if self._rates and boot_ns <= self._rates[-1][0]:
            return
        self._rates.append((boot_ns, np.array(rates_radps)))
        while boot_ns - self._rates[0][0] > RATE_HISTORY_NS:
            self._rates.popleft()

    def rejection_reason(self, attitude: AttitudeSample) -> str:
        """-> reason for the rejection; empty if the attitude is accepted."""
        from_accepted_rad, from_candidate_rad = (
            self._unexplained_rad(self._accepted, attitude),
            self._unexplained_rad(self._candidate, attitude),
        )
        if from_accepted_rad == 0.0 or (from_accepted_rad is None and from_candidate_rad is None):
            if self._accepted is None or attitude.boot_ns > self._accepted.boot_ns:
                self._accepted = attitude
            self._candidate = None
            return ""
        if from_candidate_rad != 0.0:
            self._candidate_since_ns = attitude.boot_ns
        self._candidate = attitude
        if attitude.boot_ns - self._candidate_since_ns < ATTITUDE_CONFIRM_NS:
            degrees = math.degrees(from_accepted_rad or from_candidate_rad or 0.0)
            return f"jumps by {degrees:.0f} degrees that its gyroscopes did not turn"
        self._accepted, self._candidate = attitude, None
        return ""

    def _unexplained_rad(self, reference: AttitudeSample | None, other: AttitudeSample) -> float | None:
        """-> angle between two attitudes that the gyroscopes do not explain [rad]; 0 if it is within the tolerance;
        None if the attitudes cannot be compared."""
        if reference is None or abs(other.boot_ns - reference.boot_ns) > MAX_COMPARED_SPAN_NS:
            return None
        before, after = (reference, other) if reference.boot_ns <= other.boot_ns else (other, reference)
        turned = self._integrated_turn(before, after)
        if turned is None:
            return None
        turn, allowed_rad = turned
        residual = turn.T @ before.r_w_b.T @ after.r_w_b
        angle = math.acos(min(1.0, max(-1.0, (float(np.trace(residual)) - 1.0) / 2.0)))
        return angle if angle > JUMP_RAD + allowed_rad else 0.0

    def _integrated_turn(self, before: AttitudeSample, after: AttitudeSample) -> tuple[np.ndarray, float] | None:
        """-> rotation (3, 3) from ``before`` to ``after`` by the gyroscopes, and the tolerance of its angle [rad].

        None if no gyroscope readings cover the time between."""
        dt_ns = after.boot_ns - before.boot_ns
        rates = [r for r in self._rates if before.boot_ns - MAX_GYRO_GAP_NS <= r[0] <= after.boot_ns + MAX_GYRO_GAP_NS]
        times = [before.boot_ns, *(t for t, _ in rates if before.boot_ns < t < after.boot_ns), after.boot_ns]
        if not rates or max(b - a for a, b in pairwise(times)) > MAX_GYRO_GAP_NS:
            return _turn_from_endpoints(before, after, dt_ns)
        turn, path_rad = np.eye(3), 0.0
        for t0, t1 in pairwise(times):
            step = _nearest(rates, (t0 + t1) // 2) * ((t1 - t0) * 1e-9)
            turn, path_rad = turn @ exp_so3(step), path_rad + float(np.linalg.norm(step))
        return turn, TURN_ERROR_SHARE * path_rad


def _nearest(rates: list[tuple[int, np.ndarray]], boot_ns: int) -> np.ndarray:
    """-> rates (3,) of the reading nearest in time."""
    return min(rates, key=lambda r: abs(r[0] - boot_ns))[1]


def _turn_from_endpoints(before: AttitudeSample, after: AttitudeSample, dt_ns: int) -> tuple[np.ndarray, float] | None:
    """As ``TurnCheck._integrated_turn``, by the mean of the rates at both attitudes."""
    if dt_ns > MAX_ENDPOINT_SPAN_NS:
        return None
    first, last = np.array(before.rates_radps), np.array(after.rates_radps)
    fastest = max(float(np.linalg.norm(first)), float(np.linalg.norm(last)))
    return exp_so3((first + last) / 2 * (dt_ns * 1e-9)), ENDPOINT_TURN_ERROR_SHARE * fastest * dt_ns * 1e-9
