"""Whether the map has confirmed the description of the flight: what else is wrong if looks at new ground find nothing.

Two hypotheses, in log odds (Wald's SPRT): the description is right, or something in it that no monitor here names
(heading, height, focal length, mount, the map) is wrong. A wrong one hides every place from the matcher. Confirmed
once, the description is no more in question: none of these changes in flight."""

import math

from terrafix.estimator.monitors.cusum import threshold

PRIOR = 0.05  # probability that a description is wrong, before the first look
# Probabilities of a look at textured ground. With a focal length doubled, a heading 90 and 180 degrees off or a camera
# mounted sideways, one pose entered the graph in 450 looks of five simulated flights.
FINDS_NOTHING, FINDS_NOTHING_IF_WRONG = 0.2, 0.99
NEW_GROUND = 0.25  # heights flown between two looks that count: nearer ones show the same ground
CONFIRMED = -math.log(100_000.0)  # log odds
LOOKS_PER_HOUR = 3600.0
REACH = 2.0  # of the way flown: how far aside a heading that is off by 180 degrees leads, the worst of them
WORSE = math.log(FINDS_NOTHING_IF_WRONG / FINDS_NOTHING)
BETTER = math.log((1.0 - FINDS_NOTHING_IF_WRONG) / (1.0 - FINDS_NOTHING))


class Registration:
    def __init__(self) -> None:
        self._log_odds = math.log(PRIOR / (1.0 - PRIOR))
        self._limit = threshold(LOOKS_PER_HOUR)
        self._heights = math.inf  # flown since the last look that counted
        self._way_m = 0.0  # flown since the map was accepted
        self.confirmed = False
        self.active = False

    @property
    def probability(self) -> float:
        """That the description is wrong."""
        return 0.0 if self.confirmed else 1.0 / (1.0 + math.exp(-self._log_odds))

    @property
    def sigma_m(self) -> float:
        """1-sigma per horizontal axis of where a wrong description may have led the estimate, by what looks have said:
        the claim of the graph allows for as much as is doubted before the first one."""
        return math.sqrt(max(0.0, self.probability - PRIOR)) * REACH * self._way_m

    def flew(self, way_m: float, height_m: float) -> None:
        """Since the frame before, as odometry has it; a ratio of the two is right whatever scale is wrong."""
        self._way_m += way_m
        self._heights += way_m / max(height_m, 1.0)

    def looked(self, *, found: bool) -> None:
        """A look at ground that has texture. ``found``: the estimator has accepted a camera pose on the map."""
        if self.confirmed or self._heights < NEW_GROUND:
            return
        self._heights = 0.0
        self._log_odds = min(self._limit, self._log_odds + (BETTER if found else WORSE))
        self.active = self._log_odds >= self._limit or (self.active and self._log_odds > 0.0)
        if found and not self.active:
            self._way_m = 0.0
        self.confirmed = self._log_odds <= CONFIRMED
