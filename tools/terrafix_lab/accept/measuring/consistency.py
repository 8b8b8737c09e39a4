"""Claimed covariance against the errors (AC-13): share of the truth inside the 95 % ellipse, and mean NEES.

Most of a claim is the error of the map, which is one draw for all frames over it. So the frames of a flight
count as one draw, those of several flights over the same map too."""

from terrafix_lab.accept.measuring.results import Bounds, Verdict
from terrafix_tools.score import COVERAGE_FLOORS, INSIDE, nees_band

COVERAGE = Bounds(*COVERAGE_FLOORS)
RUN_CONFIDENCE = 0.95  # of the band of the NEES of all flights of a run
# Of the band for each flight: a run has some twenty, and one in five hundred consistent ones is outside.
FLIGHT_CONFIDENCE = 0.998


def judge_claims(inside: float, mean_nees: float, draws: int, confidence: float) -> tuple[Verdict, str]:
    """Verdict, and the reason for it.

    ``inside``: share of the truth in the 95 % ellipse. ``mean_nees``: of ``draws`` independent errors."""
    low, high = nees_band(draws, confidence=confidence)
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
