"""Whether the map has confirmed the description of the flight, from the success of correlations over new ground.

Two hypotheses in log odds (Wald's SPRT). H0: the description is right. H1: something in it that no other monitor names
(heading, height, focal length, mount, the map) is wrong, so that the matcher finds no place. Once H0 is confirmed the
test ends: none of these changes in flight."""

import math

from terrafix.estimator.monitors.cusum import threshold

PRIOR_WRONG = 0.05  # probability of H1 before the first correlation [tuned]
# Probability under H0 and H1 that a correlation over textured ground finds nothing. With a focal length doubled, a
# heading 90 and 180 degrees off or a camera mounted sideways, one pose entered the graph in 450 correlations of five
# simulated flights. [measured: docs/decisions/024-calibration-monitors.md]
P_NOTHING, P_NOTHING_IF_WRONG = 0.2, 0.99
MIN_SPACING_HEIGHTS = 0.25  # heights flown between two correlations that count: closer ones see the same ground [tuned]
CONFIRMED = -math.log(100_000.0)  # nats: log odds of H1 at which H0 is confirmed [tuned]
ATTEMPTS_PER_HOUR = 3600.0  # 1/h: correlations that count for the false alarm rate [tuned]
# Position error per path length in the worst case, a heading that is off by 180 degrees.
ERROR_PER_PATH = 2.0  # [spec: geometry]
LLR_NOTHING = math.log(P_NOTHING_IF_WRONG / P_NOTHING)  # nats [spec: of the probabilities above]
LLR_FOUND = math.log((1.0 - P_NOTHING_IF_WRONG) / (1.0 - P_NOTHING))  # nats [spec: of the probabilities above]


class Registration:
    """``confirmed``: H0 is accepted, for the rest of the flight. ``active``: the alarm, H1 is accepted."""

    def __init__(self) -> None:
        self._log_odds = math.log(PRIOR_WRONG / (1.0 - PRIOR_WRONG))  # of H1
        self._limit = threshold(ATTEMPTS_PER_HOUR)
        self._heights = math.inf  # flown since the last correlation that counted
        self._path_m = 0.0  # flown since the last accepted pose
        self.confirmed = False
        self.active = False

    @property
    def probability(self) -> float:
        """Probability, 0..1, of H1: the description is wrong; 0 once H0 is confirmed."""
        return 0.0 if self.confirmed else 1.0 / (1.0 + math.exp(-self._log_odds))

    @property
    def sigma_m(self) -> float:
        """1-sigma per horizontal axis of the position error that a wrong description may have caused.

        Only the probability beyond the prior counts: the covariance of the graph covers the prior's share."""
        return math.sqrt(max(0.0, self.probability - PRIOR_WRONG)) * self.path_error_m

    @property
    def path_error_m(self) -> float:
        """Largest position error that a wrong description causes over the path since the last accepted pose."""
        return ERROR_PER_PATH * self._path_m

    def add_path(self, path_m: float, agl_m: float) -> None:
        """Path since the frame before and height above ground, both by the estimate; their ratio does not depend on
        the scale."""
        self._path_m += path_m
        self._heights += path_m / max(agl_m, 1.0)

    def add_attempt(self, *, found: bool) -> None:
        """A correlation over textured ground. ``found``: the estimator accepted a camera pose on the map."""
        if found and not self.active:
            self._path_m = 0.0
        if self.confirmed or self._heights < MIN_SPACING_HEIGHTS:
            return
        self._heights = 0.0
        self._log_odds = min(self._limit, self._log_odds + (LLR_FOUND if found else LLR_NOTHING))
        self.active = self._log_odds >= self._limit or (self.active and self._log_odds > 0.0)
        self.confirmed = self._log_odds <= CONFIRMED
