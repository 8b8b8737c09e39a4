"""What an operator's hint is worth: the beginning of a search where nobody knows better, and else a comparison."""

import math
from dataclasses import dataclass

from terrafix.anchor.verification.lock_monitor import START_ODDS
from terrafix.messages import Verdict

SIGMAS_95 = math.sqrt(5.991)  # radius that holds 95 % of a round Gaussian, by its sigma per axis (chi-square, 2 dof)
SPEED_MPS = 30.0  # how fast the vehicle may have flown since the hint was given
SURE = 3.0  # standard deviations of the believed position, beyond the radius of the hint, that still agree with it

Bounds = tuple[float, float, float, float]  # east and north of the south-west corner, then of the north-east one


@dataclass(frozen=True)
class CurrentBelief:
    """Where the vehicle is believed to be (local east and north), how well, and the log odds that this is so."""

    e_m: float
    n_m: float
    sigma_m: float  # 1-sigma per axis
    odds: float  # of LostWatch; without meaning during a search


@dataclass(frozen=True)
class PriorDecision:
    verdict: Verdict
    begins_search: bool
    distance_m: float  # between hint and believed position
    text: str  # at most 40 characters


def radius_now_m(radius_m: float, age_s: float) -> float:
    """Of a hint that was given ``age_s`` ago: the vehicle has flown on since."""
    return radius_m + SPEED_MPS * max(age_s, 0.0)


def outside_m(at_m: tuple[float, float], bounds_m: Bounds) -> float:
    """How far a place (east, north) lies outside of ``bounds_m``; 0 within."""
    return math.hypot(
        max(bounds_m[0] - at_m[0], 0.0, at_m[0] - bounds_m[2]), max(bounds_m[1] - at_m[1], 0.0, at_m[1] - bounds_m[3])
    )


def weigh(
    at_m: tuple[float, float], radius_m: float, believed: CurrentBelief, bounds_m: Bounds, *, searching: bool
) -> PriorDecision:
    """``at_m``: the hint, local east and north; ``radius_m`` holds 95 %. ``bounds_m`` of the map.

    A place that poses have confirmed is not given up for a hint: an operator who is wrong must do no harm. One that
    the map has not confirmed more than the start (odds), or that claims less than the hint, is."""
    distance_m = math.hypot(at_m[0] - believed.e_m, at_m[1] - believed.n_m)
    off_m = outside_m(at_m, bounds_m)
    if off_m > radius_m:
        return PriorDecision(Verdict.OUTSIDE_MAP, False, distance_m, f"hint is {length(off_m)} outside the map")
    if searching or radius_m < SIGMAS_95 * believed.sigma_m:
        return PriorDecision(Verdict.ACCEPTED, True, distance_m, f"hint taken, searching within {length(radius_m)}")
    if distance_m <= radius_m + SURE * believed.sigma_m:
        return PriorDecision(Verdict.ACCEPTED, False, distance_m, f"hint agrees, {length(distance_m)} from us")
    if believed.odds < START_ODDS:
        return PriorDecision(Verdict.ACCEPTED, True, distance_m, f"hint is {length(distance_m)} off, searching")
    return PriorDecision(Verdict.INNOVATION, False, distance_m, f"hint not used, {length(distance_m)} from us")


def length(metres: float) -> str:
    """For people: 380 m, 4.2 km, 12 km."""
    if metres < 1000.0:
        return f"{metres:.0f} m"
    return f"{metres / 1e3:.1f} km" if metres < 10_000.0 else f"{metres / 1e3:.0f} km"
