"""Gate for the estimates that the link sends: plausibility, order, freshness and confirmation of jumps (ON-6, AC-3).

The autopilot's EKF rejects an inconsistent position for 10 s and then resets onto it. A wrong position that persists
is therefore accepted there in the end. So a jump must be stopped here: the fix is lowered at once, and the new position
is accepted after further estimates have confirmed it."""

import math
from dataclasses import dataclass

from terrafix.link.integrity.output_predictor import EE, NN, UU, InertialBuffer, distance_m, predict_to
from terrafix.messages import NavEstimate, Verdict

# Jitter of clock readings between two processes. An estimate further in the future is a bug of its sender. [tuned]
MAX_FUTURE_NS = 50_000_000
# On arrival, ns. Too old to be predicted to the present by any means; and by none but the last velocity, which the
# autopilot's own dead reckoning is better than. [tuned]
MAX_DELAY_NS, MAX_BLIND_DELAY_NS = 5_000_000_000, 1_000_000_000
MAX_ESTIMATE_SPEED_MPS = 100.0  # ground speed; above that of all vehicles that this is made for [tuned]
MAX_CLIMB_MPS = 30.0  # m/s, climb or descent; same reason [tuned]
MIN_AMSL_M, MAX_AMSL_M = -500.0, 10_000.0  # shore of the Dead Sea; above the ceiling of small vehicles [tuned]
MAX_ABOVE_GROUND_M = 5_000.0  # m above the ground at the origin [tuned]
MAX_BELOW_GROUND_M = 300.0  # m below the ground at the origin: terrain may descend from there [tuned]
# as the autopilot's own position gate [spec: ArduPilot EK3_POS_I_GATE 500, hundredths of sigma]
ESTIMATE_JUMP_SIGMAS = 5.0
JUMP_GATE_MIN_M = 10.0  # m; the autopilot's EKF averages smaller steps [tuned]
LARGE_JUMP_M = 200.0  # m; a larger jump needs confirmation whatever accuracy is claimed (ON-6) [tuned]


@dataclass(frozen=True)
class JumpConfirmation:
    """Requirement on a new position: this many estimates in a row, consistent with each other, over this duration."""

    estimates: int
    duration_s: float


# Both are shorter than the time after which a copter without position starts its failsafe: 7 s to "EKF variance" and
# 7.8 s to LAND, measured on ArduPilot's firmware. [tuned]
JUMP_CONFIRMATION = JumpConfirmation(3, 1.0)
LARGE_JUMP_CONFIRMATION = JumpConfirmation(5, 3.0)  # the same bound [tuned]


class EstimateGate:
    """``accepted``: the newest accepted estimate, or None. ``pending_jump``: text about the jump that waits for
    confirmation, or empty. ``jumps_accepted``: number of jumps that were confirmed."""

    def __init__(self) -> None:
        self.accepted: NavEstimate | None = None
        self.pending_jump = ""
        self.jumps_accepted = 0
        self._candidate: NavEstimate | None = None
        self._candidate_since_ns = 0
        self._candidate_count = 0
        self._required = JUMP_CONFIRMATION

    def evaluate(
        self, estimate: NavEstimate, now_ns: int, inertial: InertialBuffer, ground_amsl_m: float | None
    ) -> tuple[Verdict, str]:
        """-> (verdict, detail). With ACCEPTED ``estimate`` becomes ``accepted``. ``ground_amsl_m``: height of the
        ground at the origin, None when unknown."""
        problem = _why_implausible(estimate, ground_amsl_m)
        if problem:
            return Verdict.IMPLAUSIBLE, problem
        if estimate.t_ns > now_ns + MAX_FUTURE_NS:
            return Verdict.IMPLAUSIBLE, f"from the future by {(estimate.t_ns - now_ns) / 1e6:.0f} ms"
        age_ns = now_ns - estimate.t_ns
        if age_ns > MAX_DELAY_NS or (age_ns > MAX_BLIND_DELAY_NS and inertial.delta(estimate, now_ns) is None):
            return Verdict.STALE, f"{age_ns / 1e9:.1f} s old on arrival"
        newest = self._candidate or self.accepted
        if newest is not None and estimate.t_ns < newest.t_ns:
            return Verdict.STALE, "older than one already received"
        if self.accepted is None:
            return self._accept(estimate)
        jump_m, gate_m = _jump_and_gate(self.accepted, estimate, inertial)
        if jump_m <= min(gate_m, LARGE_JUMP_M):
            return self._accept(estimate)
        return self._confirm_jump(estimate, jump_m, inertial)

    def _accept(self, estimate: NavEstimate, detail: str = "") -> tuple[Verdict, str]:
        self.accepted, self._candidate, self._candidate_count, self.pending_jump = estimate, None, 0, ""
        return Verdict.ACCEPTED, detail

    def _confirm_jump(self, estimate: NavEstimate, jump_m: float, inertial: InertialBuffer) -> tuple[Verdict, str]:
        """Counts estimates that are consistent with the candidate; accepts the newest when there are enough."""
        consistent = False
        if self._candidate is not None:
            between_m, gate_m = _jump_and_gate(self._candidate, estimate, inertial)
            consistent = between_m <= min(gate_m, LARGE_JUMP_M)
        if consistent:
            self._candidate_count += 1
        else:
            self._candidate_count, self._candidate_since_ns = 1, estimate.t_ns
            self._required = JUMP_CONFIRMATION
        self._candidate = estimate
        if jump_m > LARGE_JUMP_M:
            self._required = LARGE_JUMP_CONFIRMATION
        duration_s = (estimate.t_ns - self._candidate_since_ns) * 1e-9
        if self._candidate_count >= self._required.estimates and duration_s >= self._required.duration_s:
            self.jumps_accepted += 1
            return self._accept(estimate, f"step of {jump_m:.0f} m after {self._candidate_count} estimates that agree")
        self.pending_jump = (
            f"step of {jump_m:.0f} m, {self._candidate_count} of {self._required.estimates} estimates agree"
        )
        return Verdict.IMPLAUSIBLE, self.pending_jump


def _jump_and_gate(old: NavEstimate, new: NavEstimate, inertial: InertialBuffer) -> tuple[float, float]:
    """-> (distance of ``new`` from ``old`` predicted to the time of ``new`` [m]; gate for it from both claims [m])."""
    predicted, fresh = predict_to(old, new.t_ns, inertial), predict_to(new, new.t_ns, inertial)
    jump_m = distance_m(predicted.lat_deg, predicted.lon_deg, new.lat_deg, new.lon_deg)
    gate_m = ESTIMATE_JUMP_SIGMAS * math.hypot(predicted.horizontal_sigma_m, fresh.horizontal_sigma_m)
    return jump_m, max(JUMP_GATE_MIN_M, gate_m)


def _why_implausible(estimate: NavEstimate, ground_amsl_m: float | None) -> str:
    """Reason why this cannot be the state of a vehicle; empty when it can."""
    numbers = (
        estimate.lat_deg,
        estimate.lon_deg,
        estimate.alt_amsl_m,
        *estimate.velocity_enu_mps,
        estimate.velocity_sigma_mps,
        *estimate.cov,
    )
    ve, vn, vu = estimate.velocity_enu_mps
    if not all(map(math.isfinite, numbers)) or len(estimate.cov) != 36:
        return "not finite, or covariance not 6x6"
    if abs(estimate.lat_deg) > 90.0 or abs(estimate.lon_deg) > 180.0:
        return f"latitude {estimate.lat_deg}, longitude {estimate.lon_deg} is nowhere"
    if min(estimate.cov[EE], estimate.cov[NN], estimate.cov[UU]) <= 0.0 or estimate.velocity_sigma_mps < 0.0:
        return "claims a variance that is not positive"
    if math.hypot(ve, vn) > MAX_ESTIMATE_SPEED_MPS or abs(vu) > MAX_CLIMB_MPS:
        return f"speed {math.hypot(ve, vn):.0f} m/s, climb {vu:.0f} m/s"
    if not MIN_AMSL_M <= estimate.alt_amsl_m <= MAX_AMSL_M:
        return f"height {estimate.alt_amsl_m:.0f} m AMSL"
    if ground_amsl_m is not None:
        above_m = estimate.alt_amsl_m - ground_amsl_m
        if not -MAX_BELOW_GROUND_M <= above_m <= MAX_ABOVE_GROUND_M:
            return f"height {above_m:.0f} m above the ground at the origin"
    return ""
