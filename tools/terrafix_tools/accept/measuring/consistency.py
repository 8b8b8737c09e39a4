"""Claimed covariance against the errors (AC-13): share of the truth inside the 95 % ellipse, and mean NEES.

NEES: squared Mahalanobis distance of the horizontal error, chi-square with 2 degrees of freedom when the covariance is
consistent. Most of a claim is the error of the map, which is one draw for all frames over it. So the frames of a flight
count as one draw, those of several flights over the same map too."""

import math

from terrafix_tools.accept.measuring.results import Bounds, Verdict

COVERAGE = Bounds(0.93, 0.98)  # AC-13
INSIDE = 0.95  # share of the truth that a consistent covariance has inside its 95 % ellipse
RUN_CONFIDENCE = 0.95  # of the band of the NEES of all flights of a run
# Of the band for each flight: a run has some twenty, and one in five hundred consistent ones is outside.
FLIGHT_CONFIDENCE = 0.998


def nees_band(draws: int, confidence: float = RUN_CONFIDENCE) -> tuple[float, float]:
    """Band of the mean of ``draws`` independent squared Mahalanobis distances with 2 degrees of freedom each, which
    holds this share of the means, the same outside on both sides."""
    tail = 0.5 * (1.0 - confidence)
    return _quantile(draws, tail), _quantile(draws, 1.0 - tail)


def judge_claims(inside: float, mean_nees: float, draws: int, confidence: float) -> tuple[Verdict, str]:
    """Verdict, and the reason for it.

    ``inside``: share of the truth in the 95 % ellipse. ``mean_nees``: of ``draws`` independent errors."""
    low, high = nees_band(draws, confidence)
    assert COVERAGE.low is not None and COVERAGE.high is not None
    why = f"mean NEES {mean_nees:.2g}, its {100.0 * confidence:g} % band {low:.2g} to {high:.2g}"
    if mean_nees < low:
        return Verdict.BELOW, f"{why}; too wide"
    if mean_nees > high or inside < COVERAGE.low:
        return Verdict.BELOW, f"{why}; too narrow"
    if inside <= COVERAGE.high:
        return Verdict.PASS, why
    if INSIDE**draws > 0.5 * (1.0 - confidence):  # a consistent covariance has all errors inside so often
        amount = "one flight, or several over one map" if draws == 1 else f"{draws} flights"
        return Verdict.NOT_MEASURABLE, f"{why}; too few to judge: too wide or not is not decidable in {amount}"
    return Verdict.BELOW, f"{why}; too wide"


def _quantile(draws: int, share: float) -> float:
    """Of the mean of ``draws`` chi-square variables with 2 degrees of freedom, by bisection."""
    low, high = 0.0, 2.0 + 40.0 / math.sqrt(draws)
    for _ in range(60):
        mean = 0.5 * (low + high)
        low, high = (mean, high) if _distribution(draws, mean) < share else (low, mean)
    return 0.5 * (low + high)


def _distribution(draws: int, mean: float) -> float:
    """Share of the means below ``mean``: half the sum has an Erlang distribution."""
    half = 0.5 * mean * draws
    if half == 0.0:
        return 0.0
    return 1.0 - sum(math.exp(k * math.log(half) - half - math.lgamma(k + 1)) for k in range(draws))
