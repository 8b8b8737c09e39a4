"""The fix type as the gate: 3 only while covariance, freshness and speed accuracy allow it, 1 otherwise, never 0.

fix_type 0 on a booting copter keeps its filter from starting at all, and anything below 3 is dropped by the filter,
so 1 says "no fix" at no cost. Silence does the same to the filter, is seen only after 4 s, and spoils the rate health
on return; it is kept for when nobody has said anything for so long that a live GPS would be a lie."""

import math
from dataclasses import dataclass

from terrafix.link.integrity.output_predictor import PredictedState
from terrafix.messages import SourceLabel

FIX_3D, NO_FIX = 3, 1

# Up to here the link carries; beyond it the autopilot's own inertial coasting is better (0.2-0.5 m after 3 s of
# silence, measured) than constant velocity, and silence of up to 4 s has no effect on it.
MAX_AGE_NS = 2_000_000_000
SILENT_AFTER_NS = 35_000_000_000  # the last rung of the ladder: every vehicle has given this GPS up long before
MAX_HORIZONTAL_SIGMA_M = 50.0  # the autopilot's gate is 7 times this: wider, it would take any position for true
MAX_SPEED_SIGMA_MPS = 1.5  # its filter calls the GPS glitching above
BACK_HORIZONTAL_SIGMA_M = 40.0  # hysteresis: the way back to 3 is narrower than the way out
BACK_SPEED_SIGMA_MPS = 1.45
# Reported accuracy passes a peak hold of 5 s time constant: one bad report keeps the gate open for ~15 s. A sudden
# spike is therefore answered with the fix type, and becomes a number only if it lasts.
SPIKE_RATIO = 3.0
SPIKE_FLOOR_M = 15.0
SPIKE_HOLD_NS = 2_000_000_000
MIN_HORIZONTAL_ACCURACY_M = 0.5  # EK3_POSNE_M_NSE: the filter clips to it
MAX_ACCURACY_M = 100.0  # and to this
MIN_SPEED_ACCURACY_MPS = 0.1

# ON-6, the caution ladder: (seconds without a map fix, factor on the position accuracy, MAV_SEVERITY).
DEGRADATION_LEVELS = ((0.0, 1.0, 6), (5.0, 1.2, 5), (15.0, 1.5, 4), (35.0, 2.0, 2))


def degradation_level(unanchored_s: float) -> int:
    """0..3: how far up the ladder so long without a map fix is."""
    return sum(unanchored_s >= after_s for after_s, _, _ in DEGRADATION_LEVELS) - 1


@dataclass(frozen=True)
class NoFixReason:
    """Why there is no fix: ``text`` for the record, ``short`` for the pilot's screen (40 characters at most)."""

    text: str
    short: str


# The computer was started again in the air: its start coordinate is where the flight began, and claims to be good.
STARTED_IN_FLIGHT = NoFixReason("started in flight, and no map fix yet", "the map must confirm the start")


class FixGate:
    """Decides the fix type at every send; remembers only what hysteresis and the spike hold need."""

    def __init__(self) -> None:
        self.good = False
        self._sent_accuracy_m: float | None = None  # last horizontal accuracy that went out with a 3D fix
        self._spike_since_ns: int | None = None

    def lower(self) -> None:
        """There is no estimate to judge."""
        self.good = False

    def judge(self, carried: PredictedState, accuracy_m: float, step: int, label: SourceLabel) -> NoFixReason | None:
        """Why fix_type is not 3; None when it is. ``accuracy_m`` is what would be sent, ``step`` the ladder's rung."""
        why = self._judge(carried, accuracy_m, step, label)
        self.good = why is None
        if self.good:
            self._sent_accuracy_m = accuracy_m
        return why

    def _judge(self, carried: PredictedState, accuracy_m: float, step: int, label: SourceLabel) -> NoFixReason | None:
        if carried.age_s * 1e9 > MAX_AGE_NS:
            return NoFixReason(f"estimate is {carried.age_s:.1f} s old", "the estimate is too old")
        if step == len(DEGRADATION_LEVELS) - 1 and label is SourceLabel.DEAD_RECKONED:
            text = f"no map and no odometry, {DEGRADATION_LEVELS[-1][0]:.0f} s without a map fix"
            return NoFixReason(text, "neither map nor odometry")
        limit_m = MAX_HORIZONTAL_SIGMA_M if self.good else BACK_HORIZONTAL_SIGMA_M
        if accuracy_m > limit_m:
            return NoFixReason(
                f"accuracy {accuracy_m:.0f} m is worse than {limit_m:.0f} m", f"worse than {limit_m:.0f} m"
            )
        limit_mps = MAX_SPEED_SIGMA_MPS if self.good else BACK_SPEED_SIGMA_MPS
        if carried.speed_sigma_mps > limit_mps:
            text = f"speed accuracy {carried.speed_sigma_mps:.1f} m/s is worse than {limit_mps:.1f} m/s"
            return NoFixReason(text, "the speed is too uncertain")
        return self._spike(carried.t_ns, accuracy_m)

    def _spike(self, now_ns: int, accuracy_m: float) -> NoFixReason | None:
        before_m = self._sent_accuracy_m
        if before_m is None or accuracy_m <= max(SPIKE_FLOOR_M, SPIKE_RATIO * before_m):
            self._spike_since_ns = None
            return None
        if self._spike_since_ns is None:
            self._spike_since_ns = now_ns
        if now_ns - self._spike_since_ns >= SPIKE_HOLD_NS:
            self._spike_since_ns = None
            return None
        return NoFixReason(f"accuracy went from {before_m:.0f} to {accuracy_m:.0f} m at once", "suddenly less accurate")


def reported_accuracy(carried: PredictedState, step: int) -> tuple[float, float, float]:
    """-> (horizontal m, vertical m, speed m/s): 1-sigma per axis, widened by the ladder."""
    factor = DEGRADATION_LEVELS[step][1]
    return (
        max(MIN_HORIZONTAL_ACCURACY_M, carried.horizontal_sigma_m * factor),
        max(MIN_HORIZONTAL_ACCURACY_M, carried.vertical_sigma_m * factor),
        max(MIN_SPEED_ACCURACY_MPS, carried.speed_sigma_mps),
    )


def bounded(accuracy_m: float) -> float:
    """What goes into the message: the autopilot clips to 100 m anyway, and infinity is no number."""
    return min(MAX_ACCURACY_M, accuracy_m) if math.isfinite(accuracy_m) else MAX_ACCURACY_M
