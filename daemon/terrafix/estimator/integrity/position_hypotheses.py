"""Where the vehicle may be, as one mixture: where the graph has it, other places that the map speaks for, anywhere.

What is published is the heaviest component, with the second moments of the mixture about it: the mean of two places
would be neither of them (Gaussian sum filter: Alspach and Sorenson 1972)."""

from dataclasses import dataclass, replace

import numpy as np

from terrafix.core.gate import GATE, LEAST_WEIGHT
from terrafix.core.initial_position import SEARCHED_START_M
from terrafix.estimator.integrity.map_consistency import MapConsistency
from terrafix.estimator.integrity.other_place import OtherPlace
from terrafix.messages import MapMatch, Origin, Verdict

# Of the height: with a position that is known better, poses have placed the graph. A mode of the belief elsewhere
# widens the claim then and does not move it: a pose on the other place is what it takes to leave.
PLACED = 0.15
# What a mode is believed at most without a pose in it: of eight over wide beliefs, with up to 0.97 of the mass, one was
# the wrong place.
MOST_WEIGHT = 0.8
# What a mode must hold, and how many times the weight of its best rival, to be the best single place. The rest of the
# mixture is in the moments about it, so that this decides where the ellipse is, not how far it reaches.
LEADING_WEIGHT, LEADS = 0.25, 2.5
MODE_SIGMA = 0.03  # of the height: buildings that lean shift a whole picture (anchor/matching/match_message.py)


@dataclass(frozen=True)
class Component:
    """``offset_m`` (2,): from the estimate, east and north; ``cov_m2`` (2, 2) of the place; ``weight`` 0..1."""

    offset_m: np.ndarray
    cov_m2: np.ndarray
    weight: float

    def about(self, at_m: np.ndarray) -> np.ndarray:
        """Second moments (2, 2) about a place."""
        return np.asarray(self.cov_m2 + np.outer(self.offset_m - at_m, self.offset_m - at_m))


class PositionHypotheses:
    """``anywhere_m``: 1-sigma per horizontal axis of "the place may be wrong", its probability counted in. ``other``:
    the place that map matches in a row speak for, against the graph."""

    def __init__(self, origin: Origin | None = None) -> None:
        """``origin``: of a flight that begins. A start that is searched is all doubt: as a prior so wide it would make
        the graph ill-conditioned."""
        searched = origin is not None and origin.start_sigma_m > SEARCHED_START_M
        self._start_m = origin.start_sigma_m if origin is not None and searched else 0.0
        self.anywhere_m = 0.0
        self.other = OtherPlace()
        self.map_consistency = MapConsistency()
        self._modes: tuple[Component, ...] = ()  # of the belief, heaviest first
        self._belief: Component | None = None  # all of it, while no pose has placed the graph
        self._own_m2 = np.zeros((2, 2))  # of the estimate that these were weighed against

    @property
    def are_several(self) -> bool:
        several = bool(self._modes) or self._belief is not None or self.other.probability > 0.0
        return several or self.map_consistency.variance_m2 > 0.0

    def hear(self, match: MapMatch) -> str:
        """-> what to say of a match whose verdict is LOST; empty for any other."""
        self.anywhere_m = match.lost_sigma_m
        return f"lost; search: {match.step.value}" if match.verdict is Verdict.LOST else ""

    def weigh(self, match: MapMatch, p_m: np.ndarray, cov: np.ndarray, height_m: float) -> None:
        """The anchor's belief against the estimate of that frame: ``p_m`` (3,) with ``cov`` (6, 6), world axes. Where
        poses have placed the graph, a mode that is as near as both claim is the estimate's own place; else the belief,
        whose prior the estimate was, knows the place better than that."""
        lever_m2 = height_m**2 * np.diag([cov[4, 4], cov[3, 3]])  # of a place that is seen, by tilt
        placed = float(np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1])) < PLACED * height_m
        modes, self._own_m2 = [], cov[:2, :2].copy()
        for e_m, n_m, mass, var_m2 in match.modes:
            cov_m2 = (var_m2 + (MODE_SIGMA * height_m) ** 2) * np.eye(2) + lever_m2
            mode = Component(np.array([e_m, n_m]) - p_m[:2], cov_m2, mass)
            apart_m2 = cov[:2, :2] + lever_m2 + cov_m2
            own = placed and float(mode.offset_m @ np.linalg.solve(apart_m2, mode.offset_m)) <= GATE[2]
            if mass >= LEAST_WEIGHT and not own:
                modes.append(mode)
        self._modes = tuple(sorted(modes, key=lambda mode: -mode.weight))
        belief_m2 = np.array(match.belief_cov_m2).reshape(2, 2) + lever_m2
        self._belief = None if placed else Component(np.array(match.belief_m) - p_m[:2], belief_m2, 1.0)

    def confirmed(self) -> None:
        """A map match agreed with the estimate."""
        self._start_m, self._modes, self._belief = 0.0, (), None

    def moved(self, anywhere_m: float) -> None:
        """The graph has begun anew where the map has it, a place that is still tested when ``anywhere_m`` is not 0."""
        self.confirmed()
        self.anywhere_m = anywhere_m

    def claim(self, cov: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """-> by how much (2,) what is published is off the estimate, and its covariance (6, 6), from that of the
        estimate, east and north first."""
        cov = cov.copy()
        at_m, moments_m2, own = self._of_belief(cov[:2, :2]) if self._belief else self._of_modes(cov[:2, :2])
        # Only in the estimate's own share are place, height and attitude correlated.
        cov[:2, 2:] *= own
        cov[2:, :2] *= own
        anywhere_m2 = max(self.anywhere_m, self._start_m) ** 2 + self.map_consistency.variance_m2
        cov[:2, :2] = moments_m2 + self.other.spread_m2() + anywhere_m2 * np.eye(2)
        return at_m, cov

    def _of_modes(self, own_m2: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """The estimate, known to ``own_m2`` (2, 2), and the places that the belief has elsewhere. -> offset (2,),
        moments (2, 2) about it, and the weight of the estimate in these."""
        modes = [self._by_now(mode, own_m2) for mode in self._modes]
        own = Component(np.zeros(2), own_m2, 1.0 - sum(mode.weight for mode in modes))
        moments_m2 = np.sum([c.weight * c.about(own.offset_m) for c in (own, *modes)], axis=0)
        return own.offset_m, moments_m2, own.weight

    def _of_belief(self, own_m2: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """An estimate that no pose has placed: the belief, and what is left to the prior. Returns as ``_of_modes``."""
        assert self._belief is not None
        prior, belief = Component(np.zeros(2), own_m2, 1.0), self._by_now(self._belief, own_m2)
        mode = self._leading_mode or Component(np.zeros(2), np.zeros((2, 2)), 0.0)
        weight = min(mode.weight, MOST_WEIGHT)
        rest = max(prior, belief, key=lambda component: float(np.trace(component.about(mode.offset_m))))
        moments_m2 = weight * self._by_now(mode, own_m2).cov_m2 + (1.0 - weight) * rest.about(mode.offset_m)
        return mode.offset_m, moments_m2, 1.0 - weight if rest is prior else 0.0

    @property
    def _leading_mode(self) -> Component | None:
        mode, rival = (*self._modes, None, None)[:2]
        if mode is None or mode.weight < max(LEADING_WEIGHT, LEADS * (rival.weight if rival else 0.0)):
            return None
        return mode

    def _by_now(self, place: Component, own_m2: np.ndarray) -> Component:
        """A place that was weighed against an older estimate, by now as much wider as the estimate has become."""
        values, axes = np.linalg.eigh(own_m2 - self._own_m2)
        return replace(place, cov_m2=place.cov_m2 + (axes * np.maximum(values, 0.0)) @ axes.T)
