"""A place that a search has found, tested further over new ground: is the vehicle there, or on none of this map?

A sequential probability ratio test (Wald, "Sequential tests of statistical hypotheses", 1945), as a martingale: what a
frame says counts for the ground that the find itself has not seen, and on wrong ground it multiplies the odds by less
than one in the mean, so that the odds of a wrong place pass a bound with a probability of at most one in that bound
(Ville, "Etude critique de la notion de collectif", 1939). Meanwhile the position is the mixture of both."""

import math

from terrafix.anchor.matching.frame_matcher import View
from terrafix.anchor.relocalization.hypothesis_tracker import LLR_MAX, NEW_EVIDENCE, HypothesisTracker
from terrafix.anchor.verification.lock_monitor import LOOK_MIN, START_ODDS
from terrafix.anchor.verification.place_verifier import FINE_PER_AGL, PlaceCheck
from terrafix.core.node import Image
from terrafix.map.null_model import Tail

# The prior: even odds. The claim is 0.7 of "anywhere" then; 1.2 % of pairs of places are three times that apart.
FIRST_ODDS = 0.0
PASSED_ODDS = START_ODDS  # as sure as a start: a wrong place comes to this once in 400 times
# One in eight: six stretches of new ground that say nothing, each LOOK_MIN, for what changed or leans does so in all.
FAILED_ODDS = -math.log(8.0)
# The exponent of the e-value: the one that tells most of a clear frame while the mean over chance stays at most one
# with LOOK_MIN as the least, where a tenth of chance counts as a tail: 0.9 exp(-0.4) + 0.1^0.4 = 1.
CALIBRATOR = 0.4


def log_e_value(log_probability: float) -> float:
    """Evidence against chance of something that chance gives with this probability: k p^(k - 1), at most one in the
    mean over chance (Vovk and Wang, "E-values: calibration, combination and applications", 2021, eq. 1)."""
    return math.log(CALIBRATOR) + (CALIBRATOR - 1.0) * log_probability


class Probation:
    def __init__(self, tracks: HypothesisTracker, frame: Tail, agl_m: float) -> None:
        """``tracks``: of the search that found the place, which knows what chance comes to on this map; ``frame``: what
        single frames come to at wrong places."""
        self._check: PlaceCheck = tracks.check
        self._chance = tracks.chance
        self._frame = frame
        self._odds = FIRST_ODDS
        self._stretch_m = NEW_EVIDENCE * agl_m
        self._way_m = 0.0  # since ground was counted last

    @property
    def doubt(self) -> float:
        """Probability that the place is wrong."""
        return 1.0 / (1.0 + math.exp(self._odds))

    @property
    def passed(self) -> bool:
        return self._odds >= PASSED_ODDS

    @property
    def failed(self) -> bool:
        return self._odds <= FAILED_ODDS

    def move(self, way_m: float) -> None:
        """``way_m``: by odometry, since the frame before."""
        self._way_m += way_m

    def look(self, image: Image, view: View | None) -> None:
        """A frame from where the camera is, if it was at the place that was found: by odometry and looks since. None:
        these leave several places, as they do on wrong ground."""
        found = None if view is None else self._check.at(image, view, FINE_PER_AGL)
        sigmas = None if found is None else self._chance.sigmas(found.agreement, fine=True)
        gain = LOOK_MIN if sigmas is None else log_e_value(self._frame.log_probability(sigmas))
        self._odds += min(self._way_m / self._stretch_m, 1.0) * min(max(gain, LOOK_MIN), LLR_MAX)
        self._way_m = 0.0
