"""Sequential test of a relocalized place over new ground: is the vehicle there, or elsewhere (core/agreement.py)?

A sequential probability ratio test (Wald, "Sequential tests of statistical hypotheses", 1945) in martingale form. A
frame counts by the share of ground that the search has not used. On wrong ground it multiplies the odds by a factor
with a mean below one, so the odds of a wrong place exceed a bound with a probability of at most one over that bound
(Ville, "Etude critique de la notion de collectif", 1939). Until the test ends, the reported position is the mixture of
"here" and "anywhere".
"""

import math

from terrafix.anchor.matching.frame_matcher import View
from terrafix.anchor.verification.hypothesis_tracker import NEW_EVIDENCE, TRACK_LLR_MAX, HypothesisTracker
from terrafix.anchor.verification.lock_monitor import MIN_GAIN, START_LOG_ODDS
from terrafix.anchor.verification.place_verifier import FINE_PLACE_CELL_PER_AGL, PlaceVerifier
from terrafix.core.agreement import Agreement, Cause, Range
from terrafix.core.node import Image
from terrafix.map.null_model import Tail

# Prior: even odds. The reported 1-sigma is then 0.7 of "anywhere"; 1.2 % of pairs of places are more than three times
# that apart. [spec: no prior preference]
PRIOR_LOG_ODDS = 0.0
# log odds of a start coordinate; a wrong place reaches them once in 400 times [spec: START_LOG_ODDS]
PASS_LOG_ODDS = START_LOG_ODDS
# One in eight: six stretches of new ground without evidence, each MIN_GAIN, since changed or leaning ground gives none
# in any of them. [tuned]
FAIL_LOG_ODDS = -math.log(8.0)
# Exponent of the e-value: it gives the most for a clear frame while the mean under the null model is at most one, with
# MIN_GAIN as the lower bound and a tenth of the null model as its tail: 0.9 exp(-0.4) + 0.1^0.4 = 1.
# [spec: that equation]
E_VALUE_EXPONENT = 0.4


def log_e_value(log_probability: float) -> float:
    """Log e-value of an observation with this log probability under the null model: k p^(k - 1), with a mean of at most
    one under the null model (Vovk and Wang, "E-values: calibration, combination and applications", 2021, eq. 1)."""
    return math.log(E_VALUE_EXPONENT) + (E_VALUE_EXPONENT - 1.0) * log_probability


class Probation:
    def __init__(self, tracker: HypothesisTracker, frame: Tail, agl_m: float) -> None:
        """``tracker``: of the search that found the place, with the null model that it has estimated; ``frame``: tail
        of single frames at wrong places."""
        self._verifier: PlaceVerifier = tracker.verifier
        self._null = tracker.null
        self._frame_tail = frame
        self._agreement = Agreement({Cause.ELSEWHERE: Range(-PRIOR_LOG_ODDS, -math.inf, math.inf)})
        self._stretch_m = NEW_EVIDENCE * agl_m
        self._path_m = 0.0  # since new ground was last counted

    @property
    def wrong_probability(self) -> float:
        """Probability that the place is wrong."""
        return self._agreement.probability(Cause.ELSEWHERE)

    @property
    def passed(self) -> bool:
        return -self._agreement.log_odds[Cause.ELSEWHERE] >= PASS_LOG_ODDS

    @property
    def failed(self) -> bool:
        return -self._agreement.log_odds[Cause.ELSEWHERE] <= FAIL_LOG_ODDS

    def predict(self, path_m: float) -> None:
        """``path_m``: length by odometry since the frame before."""
        self._path_m += path_m

    def update(self, image: Image, view: View | None) -> None:
        """Measurement update. ``view``: camera at the belief's mode, by odometry and frames since the search; None: the
        belief has no dominant mode, as on wrong ground."""
        found = None if view is None else self._verifier.verify(image, view, FINE_PLACE_CELL_PER_AGL)
        sigmas = None if found is None else self._null.sigmas(found.consensus, fine=True)
        gain = MIN_GAIN if sigmas is None else log_e_value(self._frame_tail.log_probability(sigmas))
        nats = min(self._path_m / self._stretch_m, 1.0) * min(max(gain, MIN_GAIN), TRACK_LLR_MAX)
        self._agreement.add(Cause.ELSEWHERE, -nats)
        self._path_m = 0.0
