"""Evaluation of an external position prior (operator's hint): it starts a search if the position is not confirmed,
otherwise it is only compared."""

import math
from dataclasses import dataclass

from terrafix.anchor.verification.lock_monitor import START_LOG_ODDS
from terrafix.core.gate import SIGMAS_95
from terrafix.messages import Verdict

# radius of the 95 % circle of a round Gaussian in sigmas per axis [spec: chi-square, 2 dof]
# m/s, growth of the prior's radius with its age: the speed that the vehicle may have flown [tuned]
RADIUS_GROWTH_MPS = 30.0
# standard deviations of the believed position, beyond the prior's radius, within which both agree [tuned]
PRIOR_AGREEMENT_SIGMAS = 3.0

# east and north of the south-west corner, then of the north-east corner, local metres
Bounds = tuple[float, float, float, float]


@dataclass(frozen=True)
class CurrentBelief:
    """Believed position (local east and north), its 1-sigma, and the log odds that it is right."""

    e_m: float
    n_m: float
    sigma_m: float  # per axis
    log_odds: float  # from ``LockMonitor``; not used during a search


@dataclass(frozen=True)
class PriorDecision:
    verdict: Verdict
    starts_search: bool
    distance_m: float  # between prior and believed position
    text: str  # at most 40 characters


def aged_radius_m(radius_m: float, age_s: float) -> float:
    """Radius of a prior that was given ``age_s`` ago: it grows by the distance that the vehicle may have flown."""
    return radius_m + RADIUS_GROWTH_MPS * max(age_s, 0.0)


def distance_outside_m(at_m: tuple[float, float], bounds_m: Bounds) -> float:
    """Distance of a place (east, north) from the rectangle ``bounds_m``; 0 inside."""
    return math.hypot(
        max(bounds_m[0] - at_m[0], 0.0, at_m[0] - bounds_m[2]), max(bounds_m[1] - at_m[1], 0.0, at_m[1] - bounds_m[3])
    )


def evaluate_prior(
    at_m: tuple[float, float], radius_m: float, belief: CurrentBelief, bounds_m: Bounds, *, searching: bool
) -> PriorDecision:
    """``at_m``: the prior, local east and north; ``radius_m`` holds 95 % of it. ``bounds_m``: extent of the map.

    A position that poses have confirmed is not replaced, because a wrong prior must not degrade it. The prior is
    adopted if the log odds are below those of a start, if the believed position is less accurate than the prior, or
    during a search.
    """
    distance_m = math.hypot(at_m[0] - belief.e_m, at_m[1] - belief.n_m)
    off_m = distance_outside_m(at_m, bounds_m)
    if off_m > radius_m:
        return PriorDecision(Verdict.OUTSIDE_MAP, False, distance_m, f"hint is {distance_text(off_m)} outside the map")
    if searching or radius_m < SIGMAS_95 * belief.sigma_m:
        return PriorDecision(
            Verdict.ACCEPTED, True, distance_m, f"hint accepted, searching within {distance_text(radius_m)}"
        )
    if distance_m <= radius_m + PRIOR_AGREEMENT_SIGMAS * belief.sigma_m:
        text = f"hint agrees, {distance_text(distance_m)} from the estimate"
        return PriorDecision(Verdict.ACCEPTED, False, distance_m, text)
    if belief.log_odds < START_LOG_ODDS:
        return PriorDecision(Verdict.ACCEPTED, True, distance_m, f"hint is {distance_text(distance_m)} off, searching")
    text = f"hint not used, {distance_text(distance_m)} from the estimate"
    return PriorDecision(Verdict.INNOVATION, False, distance_m, text)


def distance_text(metres: float) -> str:
    """Distance as text: 380 m, 4.2 km, 12 km."""
    if metres < 1000.0:
        return f"{metres:.0f} m"
    return f"{metres / 1e3:.1f} km" if metres < 10_000.0 else f"{metres / 1e3:.0f} km"
