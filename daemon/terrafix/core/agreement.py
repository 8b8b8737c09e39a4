"""Agreement of a position with the map: one posterior over what may be wrong with the position.

Each cause is compared with "the position is right" by its log odds [nats]; together they are normalised, so that the
probabilities of all causes and of "right" sum to one. ``NATS`` is the table of likelihoods: what was observed, and
the log likelihood ratio of each cause over "right" for one unit of new ground. The anchor decides by it whether it
searches, the estimator how wide its claim is.

Not a cause: images of another camera or an old buffer. They are refused before the map
(estimator/integrity/fragments.py, motion_gate.py)."""

import math
from dataclasses import dataclass
from enum import Enum, StrEnum

from terrafix.core.gate import MIN_COMPONENT_WEIGHT


class Cause(StrEnum):
    ELSEWHERE = "elsewhere"  # the vehicle is at another place of this map
    OTHER_GROUND = "other ground"  # the map does not show the ground below
    START = "start"  # the start coordinate is wrong by far more than it claims, and no map match has placed the flight
    DESCRIPTION = "description"  # heading, height, focal length, mount or map: what no other monitor names


class Observed(Enum):
    """What a frame that was compared with the map has shown."""

    POSE = "a camera pose that was fused"
    REJECTED = "a camera pose outside of the innovation gate that agrees with no pose before it"
    NOTHING = "textured ground on which no pose was found or fused"


# Probability of a lone rejected pose: of a right position, up to a tenth on a map of another year, and over other
# ground, where poses are wherever patterns look alike. [measured: docs/integrity.md]
P_REJECTED, P_REJECTED_OTHER_GROUND = 0.1, 0.9
# Probability that a correlation over textured ground finds nothing. With a focal length doubled, a heading 90 and 180
# degrees off or a camera mounted sideways, one pose entered the graph in 450 correlations of five simulated flights.
# [measured: docs/decisions/024-calibration-monitors.md]
P_NOTHING, P_NOTHING_DESCRIPTION = 0.2, 0.99
# ... and over ground that the map does not show, where one in five gives a pose. [measured: docs/monte-carlo.md]
P_NOTHING_OTHER_GROUND = 0.8
# Log likelihood ratio of a place by the standardised correlation of a frame there: nats per standard deviation, fitted
# to right and wrong places on seven pairs of real images of the same ground at two dates. Right places have 3 to 8
# (median 3.6 to 6.9 by pair); the best of tens of thousands of wrong places has 3.0 in the median, 98 % are below 4.1.
# [measured: this comment]
NATS_PER_SCORE, WRONG_SCORE = 3.0, 4.1

# Rows: for a unit of new ground, which for OTHER_GROUND is the share of the pose that is independent of those before
# (correlated_fixes.py), for START and DESCRIPTION one correlation over other ground than before. Correlations without a
# pose count for OTHER_GROUND by the hit rate of the flight (other_ground.py): over bare ground they are frequent. For
# ELSEWHERE the anchor correlates each frame at that place as well (anchor/verification/alternative_place.py).
NATS: dict[Observed, dict[Cause, float]] = {
    Observed.POSE: {
        Cause.OTHER_GROUND: math.log((1.0 - P_REJECTED_OTHER_GROUND) / (1.0 - P_REJECTED)),
        Cause.START: -math.inf,  # from then on the map has the position
        Cause.DESCRIPTION: math.log((1.0 - P_NOTHING_DESCRIPTION) / (1.0 - P_NOTHING)),
    },
    Observed.REJECTED: {Cause.OTHER_GROUND: math.log(P_REJECTED_OTHER_GROUND / P_REJECTED)},
    Observed.NOTHING: dict.fromkeys((Cause.START, Cause.DESCRIPTION), math.log(P_NOTHING_DESCRIPTION / P_NOTHING)),
}


@dataclass(frozen=True)
class Range:
    """Log odds of a cause over "right" [nats]: ``prior``, and the limits ``least`` and ``most``, which keep the
    posterior alert. ``settles``: at ``least`` the cause is excluded for the rest of the flight."""

    prior: float
    least: float
    most: float
    settles: bool = False


# One start or description in twenty is wrong, as people state it, and does not change in flight; a receiver may have
# been spoofed. Upper limit: 3600 correlations an hour, one false alarm in 1000 hours. [tuned]
STATED = Range(math.log(0.05 / 0.95), -math.log(100_000.0), math.log(3600.0 * 1000.0), settles=True)
RANGES: dict[Cause, Range] = {
    # Until map matches that agree with each other contradict the estimate, there is no evidence for another place.
    Cause.ELSEWHERE: Range(-math.inf, -math.inf, 0.0),
    # A map that was right for a kilometre can still end. [tuned]
    Cause.OTHER_GROUND: Range(-6.0, -6.0, 4.0),
    Cause.START: STATED,
    Cause.DESCRIPTION: STATED,
}


class Agreement:
    """Posterior of the causes. ``log_odds``: of each over "the position is right", before normalisation."""

    def __init__(self, ranges: dict[Cause, Range] | None = None) -> None:
        """``ranges``: of the causes that this posterior has; None: ``RANGES``."""
        self._ranges = RANGES if ranges is None else ranges
        self.log_odds = {cause: limits.prior for cause, limits in self._ranges.items()}

    def observe(self, observed: Observed, cause: Cause, new_ground: float = 1.0) -> None:
        """An observation with so much new ground, in the unit of ``cause``."""
        self.add(cause, new_ground * NATS[observed].get(cause, 0.0))

    def add(self, cause: Cause, nats: float) -> None:
        """Evidence for ``cause`` over "right"."""
        limits = self._ranges[cause]
        if self.log_odds[cause] == -math.inf:  # excluded
            return
        self.log_odds[cause] = min(limits.most, max(limits.least, self.log_odds[cause] + nats))
        if limits.settles and self.log_odds[cause] <= limits.least:
            self.log_odds[cause] = -math.inf

    def begin(self, cause: Cause, log_odds: float = 0.0) -> None:
        """``cause`` begins anew with these log odds; 0: it is as probable as "right"."""
        self.log_odds[cause] = log_odds

    def at_most(self, cause: Cause, probability: float) -> None:
        """Other evidence leaves ``cause`` at most this probability (against "right")."""
        if probability <= 0.0:
            self.log_odds[cause] = -math.inf
        elif probability < 1.0:
            self.log_odds[cause] = min(self.log_odds[cause], math.log(probability / (1.0 - probability)))

    def forget(self, *causes: Cause) -> None:
        """The position is another one: what was observed before says nothing of it."""
        for cause in causes:
            self.log_odds[cause] = self._ranges[cause].prior

    def probability(self, cause: Cause) -> float:
        """Posterior probability, 0..1, of ``cause``."""
        return self._shares()[cause]

    def weight(self, cause: Cause) -> float:
        """``probability``, as the weight of a mixture component: 0 below MIN_COMPONENT_WEIGHT."""
        probability = self.probability(cause)
        return probability if probability > MIN_COMPONENT_WEIGHT else 0.0

    def _shares(self) -> dict[Cause, float]:
        largest = max(0.0, *self.log_odds.values())
        odds = {cause: math.exp(log_odds - largest) for cause, log_odds in self.log_odds.items()}
        total = math.exp(-largest) + sum(odds.values())
        return {cause: one / total for cause, one in odds.items()}
