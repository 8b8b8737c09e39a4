"""Which estimates the link believes: plausibility, order, freshness, and no jump that was not announced (ON-6, AC-3).

A persistent wrong position always wins in the autopilot: what its filter rejects for 10 s becomes a hard reset onto
our value. So a jump is stopped here: the fix is lowered at once and the new place must prove itself."""

import math
from dataclasses import dataclass

from terrafix.link.integrity.output_predictor import Attitudes, distance_m, predict_to
from terrafix.messages import NavEstimate, Verdict

FUTURE_NS = 50_000_000  # an estimate of the future beyond clock reading jitter is a bug elsewhere
MAX_LATE_NS = 5_000_000_000  # older than this on arrival it cannot be carried to now by anybody
MAX_SPEED_MPS = 100.0  # no vehicle this is for flies faster over ground
MAX_CLIMB_MPS = 30.0
MIN_AMSL_M, MAX_AMSL_M = -500.0, 10_000.0  # Dead Sea shore to beyond any small vehicle's ceiling
MAX_ABOVE_GROUND_M = 5_000.0
MAX_BELOW_GROUND_M = 300.0  # terrain falls away from the origin
JUMP_SIGMAS = 5.0  # the autopilot's own gate is 5 sigma (EK3_POS_I_GATE 500)
JUMP_FLOOR_M = 10.0  # steps of this size are the autopilot's to average
BIG_STEP_M = 200.0  # ON-6: no bigger step is promoted on one estimate's word, whatever it claims


@dataclass(frozen=True)
class JumpConfirmation:
    """What a new place must show: so many estimates in a row that agree with each other, over so long."""

    estimates: int
    seconds: float


# Both end well before a copter without position gives up (measured: 7 s to "EKF variance", LAND at 7.8 s).
PROOF_OF_STEP = JumpConfirmation(3, 1.0)
PROOF_OF_BIG_STEP = JumpConfirmation(5, 3.0)


class EstimateGate:
    """``accepted`` is the newest believed estimate; ``holding`` names the jump that is being proved, or is empty.
    ``steps``: how many jumps were accepted."""

    def __init__(self) -> None:
        self.accepted: NavEstimate | None = None
        self.holding = ""
        self.steps = 0
        self._candidate: NavEstimate | None = None
        self._candidate_since_ns = 0
        self._candidates = 0
        self._needed = PROOF_OF_STEP

    def consider(
        self, estimate: NavEstimate, now_ns: int, attitudes: Attitudes, ground_amsl_m: float | None
    ) -> tuple[Verdict, str]:
        """-> (verdict, detail). ACCEPTED makes it ``accepted``."""
        problem = _implausible(estimate, ground_amsl_m)
        if problem:
            return Verdict.IMPLAUSIBLE, problem
        if estimate.t_ns > now_ns + FUTURE_NS:
            return Verdict.IMPLAUSIBLE, f"from the future by {(estimate.t_ns - now_ns) / 1e6:.0f} ms"
        if now_ns - estimate.t_ns > MAX_LATE_NS:
            return Verdict.STALE, f"{(now_ns - estimate.t_ns) / 1e9:.1f} s old on arrival"
        newest = self._candidate or self.accepted
        if newest is not None and estimate.t_ns < newest.t_ns:
            return Verdict.STALE, "older than one already heard"
        if self.accepted is None:
            return self._accept(estimate)
        step_m, allowed_m = _step(self.accepted, estimate, attitudes)
        if step_m <= min(allowed_m, BIG_STEP_M):
            return self._accept(estimate)
        return self._hold(estimate, step_m, attitudes)

    def _accept(self, estimate: NavEstimate, detail: str = "") -> tuple[Verdict, str]:
        self.accepted, self._candidate, self._candidates, self.holding = estimate, None, 0, ""
        return Verdict.ACCEPTED, detail

    def _hold(self, estimate: NavEstimate, step_m: float, attitudes: Attitudes) -> tuple[Verdict, str]:
        agrees = False
        if self._candidate is not None:
            between_m, allowed_m = _step(self._candidate, estimate, attitudes)
            agrees = between_m <= min(allowed_m, BIG_STEP_M)
        if agrees:
            self._candidates += 1
        else:
            self._candidates, self._candidate_since_ns = 1, estimate.t_ns
            self._needed = PROOF_OF_STEP
        self._candidate = estimate
        if step_m > BIG_STEP_M:
            self._needed = PROOF_OF_BIG_STEP
        held_s = (estimate.t_ns - self._candidate_since_ns) * 1e-9
        if self._candidates >= self._needed.estimates and held_s >= self._needed.seconds:
            self.steps += 1
            return self._accept(estimate, f"step of {step_m:.0f} m after {self._candidates} estimates that agree")
        self.holding = f"step of {step_m:.0f} m, {self._candidates} of {self._needed.estimates} estimates agree"
        return Verdict.IMPLAUSIBLE, self.holding


def _step(old: NavEstimate, new: NavEstimate, attitudes: Attitudes) -> tuple[float, float]:
    """-> (distance between ``new`` and ``old`` carried to its time, distance that both claims allow)."""
    carried, fresh = predict_to(old, new.t_ns, attitudes), predict_to(new, new.t_ns, attitudes)
    step_m = distance_m(carried.lat_deg, carried.lon_deg, new.lat_deg, new.lon_deg)
    allowed_m = JUMP_SIGMAS * math.hypot(carried.horizontal_sigma_m, fresh.horizontal_sigma_m)
    return step_m, max(JUMP_FLOOR_M, allowed_m)


def _implausible(estimate: NavEstimate, ground_amsl_m: float | None) -> str:
    """Why this cannot be a vehicle's state; empty when it can."""
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
    if min(estimate.cov[0], estimate.cov[7], estimate.cov[14]) <= 0.0 or estimate.velocity_sigma_mps < 0.0:
        return "claims a variance that is not positive"
    if math.hypot(ve, vn) > MAX_SPEED_MPS or abs(vu) > MAX_CLIMB_MPS:
        return f"speed {math.hypot(ve, vn):.0f} m/s, climb {vu:.0f} m/s"
    if not MIN_AMSL_M <= estimate.alt_amsl_m <= MAX_AMSL_M:
        return f"height {estimate.alt_amsl_m:.0f} m AMSL"
    if ground_amsl_m is not None:
        above_m = estimate.alt_amsl_m - ground_amsl_m
        if not -MAX_BELOW_GROUND_M <= above_m <= MAX_ABOVE_GROUND_M:
            return f"height {above_m:.0f} m above the ground at the origin"
    return ""
