"""Position as one Gaussian mixture, whose weights sum to one: the graph's estimate, and what the vehicle's position may
be otherwise by each cause of core/agreement.py. What the anchor adds ("anywhere") comes weighted already.

The heaviest component is published, with the second moments of the mixture about it. The mean of two separate places
would be neither of them (Gaussian sum filter: Alspach and Sorenson 1972)."""

import math
from dataclasses import dataclass, replace

import numpy as np

from terrafix.core.agreement import Agreement, Cause, Observed
from terrafix.core.gate import GATE, MIN_COMPONENT_WEIGHT
from terrafix.core.initial_position import SEARCH_START_SIGMA_M, START_WINDOW_MAX_M, START_WINDOW_SIGMAS
from terrafix.core.pose import positive_part
from terrafix.estimator.integrity.alternative_position import AlternativePosition
from terrafix.estimator.integrity.other_ground import OtherGround
from terrafix.messages import BeliefSummary, Origin, SearchResult, Verdict

# Share of the height above ground. With a smaller 1-sigma, map poses have placed the graph. A mode of the belief
# elsewhere then widens the published covariance and does not move the position; that takes a pose. [tuned]
PLACED_SIGMA_HEIGHTS = 0.15
# Largest weight of a mode without a pose in it. [measured: of 8 modes over wide beliefs, mass up to 0.97, 1 was wrong]
MAX_WEIGHT_WITHOUT_POSE = 0.8
# A mode is published as the best place from this weight on, and from this ratio to the weight of the second one. The
# rest of the mixture is in the moments about it: these decide on the centre of the ellipse, not on its size. [tuned]
MIN_LEADING_WEIGHT, MIN_LEADING_RATIO = 0.25, 2.5
# 1-sigma of a mode as a share of the height: relief displacement of buildings (anchor/matching/match_message.py)
MODE_SIGMA_HEIGHTS = 0.03  # [tuned]


@dataclass(frozen=True)
class Component:
    """``offset_m`` (2,): from the estimate, east and north; ``cov_m2`` (2, 2) of the place; ``weight`` 0..1."""

    offset_m: np.ndarray
    cov_m2: np.ndarray
    weight: float

    def moments_about(self, p_m: np.ndarray) -> np.ndarray:
        """Second moments (2, 2) about ``p_m`` (2,), an offset from the estimate as well."""
        return np.asarray(self.cov_m2 + np.outer(self.offset_m - p_m, self.offset_m - p_m))


class PositionHypotheses:
    """``anywhere_m``: 1-sigma per horizontal axis of a position that is wrong, times the root of its probability.
    ``other``: the alternative position, which consecutive map matches support against the graph."""

    def __init__(self, origin: Origin | None = None) -> None:
        """``origin``: of a new flight. The uncertainty of a start that has to be searched for is held here and not in
        the graph's prior, which would make the graph ill-conditioned."""
        stated_m = 0.0 if origin is None else origin.start_sigma_m
        self._start_sigma_m = stated_m if stated_m > SEARCH_START_SIGMA_M else 0.0
        # 1-sigma per axis of a start that is wrong, of a uniform distribution
        self._start_error_m = min(START_WINDOW_SIGMAS * stated_m, START_WINDOW_MAX_M) / math.sqrt(3.0)
        self.anywhere_m = 0.0
        self.use(Agreement())
        self._modes: tuple[Component, ...] = ()  # of the anchor's belief, heaviest first
        self._belief: Component | None = None  # moments of the whole belief, while no pose has placed the graph
        self._estimate_cov_m2 = np.zeros((2, 2))  # of the estimate that modes and belief were compared with

    def use(self, agreement: Agreement) -> None:
        """``agreement``: of the flight, whose description may have been judged before this graph began."""
        self._agreement = agreement
        self._agreement.forget(Cause.ELSEWHERE, Cause.OTHER_GROUND)
        self.other, self.other_ground = AlternativePosition(agreement), OtherGround(agreement)

    @property
    def is_multimodal(self) -> bool:
        """Whether the published position may differ from the estimate, or its covariance is inflated by the map."""
        multimodal = bool(self._modes) or self._belief is not None
        return multimodal or any(self._agreement.weight(cause) > 0.0 for cause in set(Cause) - {Cause.DESCRIPTION})

    def on_match(self, verdict: Verdict, search: SearchResult) -> str:
        """-> detail of the verdict on a match that is LOST; empty for any other."""
        self.anywhere_m = search.sigma_m
        return f"lost; search: {search.step.value}" if verdict is Verdict.LOST else ""

    def update_modes(self, belief: BeliefSummary, p_m: np.ndarray, cov: np.ndarray, agl_m: float) -> None:
        """Compares the anchor's belief with the estimate of the same frame: ``p_m`` (3,), ``cov`` (6, 6), world axes.

        Where poses have placed the graph, a mode inside the gate is the estimate's own position and is left out.
        Elsewhere the belief replaces the estimate: the estimate was its prior, so that the belief contains it."""
        lever_m2 = agl_m**2 * np.diag([cov[4, 4], cov[3, 3]])  # of a position on the ground, by tilt
        placed = float(np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1])) < PLACED_SIGMA_HEIGHTS * agl_m
        modes, self._estimate_cov_m2 = [], cov[:2, :2].copy()
        for seen in belief.modes:
            cov_m2 = (seen.variance_m2 + (MODE_SIGMA_HEIGHTS * agl_m) ** 2) * np.eye(2) + lever_m2
            mode = Component(np.array([seen.e_m, seen.n_m]) - p_m[:2], cov_m2, seen.mass)
            innovation_m2 = cov[:2, :2] + lever_m2 + cov_m2
            own = placed and float(mode.offset_m @ np.linalg.solve(innovation_m2, mode.offset_m)) <= GATE[2]
            if seen.mass >= MIN_COMPONENT_WEIGHT and not own:
                modes.append(mode)
        self._modes = tuple(sorted(modes, key=lambda mode: -mode.weight))
        belief_m2 = np.array(belief.cov_m2).reshape(2, 2) + lever_m2
        self._belief = None if placed else Component(np.array(belief.mean_m) - p_m[:2], belief_m2, 1.0)

    def on_match_accepted(self) -> None:
        """A map match agreed with the estimate."""
        self._start_sigma_m, self._modes, self._belief = 0.0, (), None
        self._agreement.observe(Observed.POSE, Cause.START)

    def on_relocalized(self) -> None:
        """What matches said before does not count: a search over several frames has found the position, or they were
        of another time."""
        self.use(self._agreement)

    def on_reset(self, anywhere_m: float) -> None:
        """The graph was reset to a map match. ``anywhere_m``: not 0 while the anchor still verifies that place."""
        self.on_match_accepted()
        self.anywhere_m = anywhere_m

    def claim(self, cov: np.ndarray, path_error_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """-> offset (2,) of the published position from the estimate, and its covariance (6, 6), from ``cov`` (6, 6) of
        the estimate; east and north first. ``path_error_m``: position error by a wrong description."""
        cov = cov.copy()
        offset_m, moments_m2, own_weight = (
            self._moments_with_belief(cov[:2, :2]) if self._belief else self._moments_with_modes(cov[:2, :2])
        )
        right = 1.0 - sum(self._agreement.weight(cause) for cause in Cause)
        # Only within the estimate's own component are position, height and attitude correlated.
        cov[:2, 2:] *= right * own_weight
        cov[2:, :2] *= right * own_weight
        wrong_m2 = self._agreement.weight(Cause.DESCRIPTION) * path_error_m**2 + self.other_ground.variance_m2
        wrong_m2 += self._agreement.weight(Cause.START) * self._start_error_m**2
        anywhere_m2 = max(self.anywhere_m, self._start_sigma_m) ** 2
        # By a cause that is no place of its own the vehicle has moved as the estimate has, and as uncertainly.
        moved = 1.0 - self._agreement.weight(Cause.START)
        cov[:2, :2] = moved * moments_m2 + self.other.moments_m2() + (wrong_m2 + anywhere_m2) * np.eye(2)
        return offset_m, cov

    def _moments_with_modes(self, estimate_m2: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Mixture of the estimate, with covariance ``estimate_m2`` (2, 2), and the modes elsewhere. -> offset (2,) of
        the published position, moments (2, 2) about it, and the weight of the estimate in these."""
        modes = [self._propagated(mode, estimate_m2) for mode in self._modes]
        own = Component(np.zeros(2), estimate_m2, 1.0 - sum(mode.weight for mode in modes))
        moments_m2 = np.sum([c.weight * c.moments_about(own.offset_m) for c in (own, *modes)], axis=0)
        return own.offset_m, moments_m2, own.weight

    def _moments_with_belief(self, estimate_m2: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """For an estimate that no pose has placed: the leading mode, and the wider one of belief and prior as the rest.
        Returns the same as ``_moments_with_modes``."""
        assert self._belief is not None
        prior, belief = Component(np.zeros(2), estimate_m2, 1.0), self._propagated(self._belief, estimate_m2)
        mode = self._leading_mode or Component(np.zeros(2), np.zeros((2, 2)), 0.0)
        weight = min(mode.weight, MAX_WEIGHT_WITHOUT_POSE)
        rest = max(prior, belief, key=lambda component: float(np.trace(component.moments_about(mode.offset_m))))
        mode_m2 = self._propagated(mode, estimate_m2).cov_m2
        moments_m2 = weight * mode_m2 + (1.0 - weight) * rest.moments_about(mode.offset_m)
        return mode.offset_m, moments_m2, 1.0 - weight if rest is prior else 0.0

    @property
    def _leading_mode(self) -> Component | None:
        mode, second = (*self._modes, None, None)[:2]
        second_weight = second.weight if second else 0.0
        if mode is None or mode.weight < max(MIN_LEADING_WEIGHT, MIN_LEADING_RATIO * second_weight):
            return None
        return mode

    def _propagated(self, component: Component, estimate_m2: np.ndarray) -> Component:
        """``component``, from an earlier frame, widened by the growth of the estimate's covariance since then."""
        return replace(component, cov_m2=component.cov_m2 + positive_part(estimate_m2 - self._estimate_cov_m2))
