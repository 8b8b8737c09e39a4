"""Whether camera poses on the map agree with the flight at all, or are those of a map that shows some other ground.

Two hypotheses in log odds: the map shows the ground below, and now and then a pose is wrong; or it does not, and poses
are wherever patterns look alike, so that hardly one agrees with the estimate. Looks that find no pose say nothing here:
over bare ground they are many (registration.py, anchor/verification/lock_monitor.py)."""

import math

import numpy as np

from terrafix.core.gate import LEAST_WEIGHT

# Probabilities that a pose is refused by the innovation gate and agrees with no other one.
REFUSED, REFUSED_ELSEWHERE = 0.1, 0.9  # up to a tenth of the poses is wrong on a map of another year
LEAST, MOST = -6.0, 4.0  # log odds: a map that was right for a kilometre may end all the same
REMEMBERED = 0.7  # of the squared distances of refused poses, from one to the next


class MapConsistency:
    def __init__(self) -> None:
        self._log_odds = LEAST  # of "elsewhere"
        self._away_m2 = 0.0  # squared distance of refused poses from the estimate

    @property
    def probability(self) -> float:
        """That the map shows other ground than that below."""
        return 1.0 / (1.0 + math.exp(-self._log_odds))

    @property
    def variance_m2(self) -> float:
        """Per horizontal axis, to be added to what is claimed: the vehicle may be as far off as refused poses are."""
        return self.probability * self._away_m2 if self.probability >= LEAST_WEIGHT else 0.0

    def refused(self, offset_m: np.ndarray) -> None:
        """A camera pose, ``offset_m`` (2,) from the estimate and beyond the gate, that agrees with none before it."""
        self._add(math.log(REFUSED_ELSEWHERE / REFUSED))
        away_m2 = float(offset_m @ offset_m)
        self._away_m2 = REMEMBERED * self._away_m2 + (1.0 - REMEMBERED) * away_m2 if self._away_m2 else away_m2

    def agreed(self, new_share: float) -> None:
        """A camera pose passed the gate; ``new_share`` 0..1 of the ground that it saw is new."""
        self._add(new_share * math.log((1.0 - REFUSED_ELSEWHERE) / (1.0 - REFUSED)))
        if self._log_odds <= LEAST:
            self._away_m2 = 0.0

    def _add(self, nats: float) -> None:
        self._log_odds = min(MOST, max(LEAST, self._log_odds + nats))
