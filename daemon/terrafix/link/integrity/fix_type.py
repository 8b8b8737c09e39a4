"""Fix type and reported accuracies: 3 while age, covariance and speed accuracy are good enough, otherwise 1, never 0.

Fix type 0 keeps the EKF of a booting copter from starting at all. Every sample below 3 is dropped by the EKF, so fix
type 1 means "no fix" without a side effect. No GPS_INPUT at all has the same effect on the EKF, but the autopilot
detects it only after 4 s, and it lowers the rate health on return. Sending stops only after a long time without any
estimate, when further messages would report a failed position source as a working GPS."""

import math
from dataclasses import dataclass

from terrafix.core.limits import MAX_SENT_VELOCITY_SIGMA_MPS
from terrafix.link.integrity.output_predictor import PredictedState
from terrafix.messages import SourceLabel

# Age of the estimate up to which the link predicts it without inertial readings, ns. Beyond it the autopilot's own
# inertial dead reckoning is better (0.2 to 0.5 m after 3 s of silence, measured on the firmware) than constant
# velocity, and silence of up to 4 s has no effect on the autopilot. With readings its accuracy decides. [tuned]
MAX_PREDICTION_AGE_NS = 2_000_000_000
SILENCE_AFTER_NS = 35_000_000_000  # ns; last degradation level, by then every vehicle has rejected this GPS [tuned]
MAX_HORIZONTAL_SIGMA_M = 50.0  # m; the autopilot's gate is 7 times this, above it any position would pass [tuned]
RECOVERY_HORIZONTAL_SIGMA_M = 40.0  # m; hysteresis: narrower limit for the return to fix type 3 [tuned]
RECOVERY_AGE_NS = 1_500_000_000  # ns; hysteresis, as above [tuned]
# A fix that was withdrawn stays away this long: a computer that is too slow would send it on and off, and the EKF takes
# the velocity of each return anew. It is half of the time within which the autopilot must use a returned position.
MIN_NO_FIX_NS = 1_000_000_000  # ns [spec: ON-6]
# The autopilot applies a peak hold with a time constant of 5 s to the reported accuracy: one bad report keeps its gate
# open for about 15 s. A sudden increase therefore lowers the fix type at first, and is reported only if it lasts.
SPIKE_RATIO = 3.0  # accuracy over the last one that was sent [tuned]
SPIKE_MIN_M = 15.0  # m; smaller accuracies are no spike [tuned]
SPIKE_HOLD_NS = 2_000_000_000  # ns of no fix before the larger accuracy is reported [tuned]
# After 5 s without a 3D fix the first sample decides the alignment checks of the EKF, which a filter that has stopped
# aiding needs: if it fails, only 10 s without a failure at the narrower limits of 5 m and 1 m/s open them again (EKF3,
# AP_NavEKF3_VehicleStatus.cpp, calcGpsGoodToAlign, at EK3_CHECK_SCALE 100). The peak hold has forgotten all by then.
ALIGNMENT_GAP_NS = 5_000_000_000  # ns [spec: ArduPilot calcGpsGoodToAlign]
FIRST_HORIZONTAL_M = 6.5  # m; 1.3 times 5 m [spec: ArduPilot calcGpsGoodToAlign]
FIRST_SPEED_SIGMA_MPS = 1.29  # m/s; 1.3 times 1 m/s, less rounding [spec: ArduPilot calcGpsGoodToAlign]
# ns for which a better first accuracy is awaited: the recommended EK3_GPS_CHECK ignores it, and the autopilot, which
# needs 0.7 s, must use the position within 2 s. [measured: docs/autopilot-facts.md]
FIRST_WAIT_NS = 1_000_000_000
MIN_HORIZONTAL_ACCURACY_M = 0.5  # m; lower limit in the EKF [spec: ArduPilot EK3_POSNE_M_NSE]
MAX_ACCURACY_M = 100.0  # m; upper limit in the EKF [measured: docs/autopilot-facts.md]
MIN_SPEED_ACCURACY_MPS = 0.1  # m/s, in the worst direction [tuned]

# ON-6, degradation levels: (seconds without a map fix, factor on the position accuracy, MAV_SEVERITY). [tuned]
DEGRADATION_LEVELS = ((0.0, 1.0, 6), (5.0, 1.2, 5), (15.0, 1.5, 4), (35.0, 2.0, 2))


def degradation_level(unanchored_s: float) -> int:
    """Index into DEGRADATION_LEVELS, 0 to 3, after ``unanchored_s`` seconds without a map fix."""
    return sum(unanchored_s >= after_s for after_s, _, _ in DEGRADATION_LEVELS) - 1


@dataclass(frozen=True)
class NoFixReason:
    """Reason for fix type 1. ``text``: for the record. ``short``: for the pilot's screen, 40 characters at most."""

    text: str
    short: str


# The computer was restarted in flight: the start coordinate is the place of take-off, with a small stated sigma.
STARTED_IN_FLIGHT = NoFixReason("started in flight, and no map fix yet", "the map must confirm the start")

# Disarmed is evidence for standing and no measurement of it: a vehicle on a deck or a truck is disarmed, too.
ONLY_DISARMED = NoFixReason(
    "nothing has measured that the start stands, and no map fix yet", "no map fix since the start"
)

# No map match yet, and no start that is known to 100 m.
NOT_PLACED = NoFixReason("not found on the map yet", "not found on the map yet")


class FixGate:
    """Decides the fix type at every transmission. Its state: hysteresis, and the wait for a better accuracy."""

    def __init__(self) -> None:
        self.has_fix = False
        self._sent: tuple[int, float] | None = None  # ns, m: time and horizontal accuracy of the last 3D fix
        self._withdrawn: tuple[int, NoFixReason] | None = None  # time [ns] and reason of the end of the last 3D fix
        self._awaited_since_ns: int | None = None  # since when the accuracy is worse than the autopilot takes well

    def withdraw(self) -> None:
        """No fix now, for a reason outside of this gate."""
        self.has_fix = False

    def evaluate(
        self, predicted: PredictedState, accuracy_m: float, level: int, label: SourceLabel
    ) -> NoFixReason | None:
        """-> the reason why fix_type is not 3, or None when it is 3.

        ``accuracy_m``: horizontal accuracy that would be sent, 1-sigma. ``level``: degradation level."""
        reason = self._no_fix_reason(predicted, accuracy_m, level, label)
        if self._withdrawn is not None and predicted.t_ns - self._withdrawn[0] < MIN_NO_FIX_NS:
            reason = reason or self._withdrawn[1]
        if reason is None:
            self._withdrawn = None
        elif self.has_fix:
            self._withdrawn = predicted.t_ns, reason
        self.has_fix = reason is None
        if self.has_fix:
            self._sent = predicted.t_ns, accuracy_m
        return reason

    def _no_fix_reason(
        self, predicted: PredictedState, accuracy_m: float, level: int, label: SourceLabel
    ) -> NoFixReason | None:
        limit_ns = MAX_PREDICTION_AGE_NS if self.has_fix or self._sent is None else RECOVERY_AGE_NS
        if predicted.age_s * 1e9 > limit_ns and not predicted.inertial:
            return NoFixReason(f"estimate is {predicted.age_s:.1f} s old", "the estimate is too old")
        if label is SourceLabel.NOT_PLACED:
            return NOT_PLACED
        if level == len(DEGRADATION_LEVELS) - 1 and label is SourceLabel.DEAD_RECKONED:
            text = f"no map and no odometry, {DEGRADATION_LEVELS[-1][0]:.0f} s without a map fix"
            return NoFixReason(text, "neither map nor odometry")
        limit_m = MAX_HORIZONTAL_SIGMA_M if self.has_fix else RECOVERY_HORIZONTAL_SIGMA_M
        if accuracy_m > limit_m:
            return NoFixReason(
                f"accuracy {accuracy_m:.0f} m is worse than {limit_m:.0f} m", f"worse than {limit_m:.0f} m"
            )
        after_gap = self._sent is not None and predicted.t_ns - self._sent[0] >= ALIGNMENT_GAP_NS
        limit_mps = MAX_SENT_VELOCITY_SIGMA_MPS if self.has_fix else FIRST_SPEED_SIGMA_MPS
        if predicted.speed_sigma_mps > limit_mps:
            text = f"speed accuracy {predicted.speed_sigma_mps:.1f} m/s is worse than {limit_mps:.1f} m/s"
            return NoFixReason(text, "the speed is too uncertain")
        return self._await_accuracy(predicted.t_ns, accuracy_m, after_gap=after_gap)

    def _await_accuracy(self, now_ns: int, accuracy_m: float, *, after_gap: bool) -> NoFixReason | None:
        """An accuracy that the autopilot would take badly is reported only if it lasts."""
        if self._sent is None:
            return None
        before_m = self._sent[1]
        limit_m, wait_ns = max(SPIKE_MIN_M, SPIKE_RATIO * before_m), SPIKE_HOLD_NS
        text, short = f"accuracy went from {before_m:.0f} to {accuracy_m:.0f} m at once", "suddenly less accurate"
        if after_gap:
            limit_m, wait_ns = FIRST_HORIZONTAL_M, FIRST_WAIT_NS
            text, short = f"first accuracy after a gap, {accuracy_m:.1f} m", "awaiting a better accuracy"
        if accuracy_m <= limit_m:
            self._awaited_since_ns = None
            return None
        if self._awaited_since_ns is None:
            self._awaited_since_ns = now_ns
        if now_ns - self._awaited_since_ns >= wait_ns:
            self._awaited_since_ns = None
            return None
        return NoFixReason(text, short)


def reported_accuracy(predicted: PredictedState, level: int) -> tuple[float, float, float]:
    """-> (horizontal [m], vertical [m], speed [m/s]), 1-sigma, horizontal and speed in the worst direction. The
    degradation level widens horizontal and vertical accuracy."""
    factor = DEGRADATION_LEVELS[level][1]
    return (
        max(MIN_HORIZONTAL_ACCURACY_M, predicted.horizontal_sigma_m * factor),
        max(MIN_HORIZONTAL_ACCURACY_M, predicted.vertical_sigma_m * factor),
        max(MIN_SPEED_ACCURACY_MPS, predicted.speed_sigma_mps),
    )


def clamp_accuracy_m(accuracy_m: float) -> float:
    """Limits an accuracy to MAX_ACCURACY_M, as the autopilot does. Infinity and NaN become MAX_ACCURACY_M, because the
    field must hold a finite number."""
    return min(MAX_ACCURACY_M, accuracy_m) if math.isfinite(accuracy_m) else MAX_ACCURACY_M
