"""Probability that the map does not show the ground below, from camera poses that the innovation gate rejects.

Two hypotheses in log odds. H0: the map shows the ground, and a small share of the poses is wrong. H1: it does not, and
poses are wherever patterns look alike, so that hardly one agrees with the estimate. Correlations that find no pose are
not used: over bare ground they are frequent under both (registration.py, anchor/verification/lock_monitor.py)."""

import math

import numpy as np

from terrafix.core.gate import MIN_COMPONENT_WEIGHT
from terrafix.estimator.integrity.innovation import Innovation

# Probability under H0 and under H1 that a pose is rejected and agrees with no other one. Up to a tenth of the poses is
# wrong on a map of another year. [measured: docs/integrity.md]
P_REJECTED, P_REJECTED_WRONG_MAP = 0.1, 0.9
# Limits of the log odds of H1 [nats]. The lower one keeps the test alert: a map that was right for a kilometre can
# still end. [tuned]
MIN_LOG_ODDS, MAX_LOG_ODDS = -6.0, 4.0
OFFSET_MEMORY = 0.7  # weight of the earlier mean in that of the squared offsets of rejected poses [tuned]


class MapConsistency:
    def __init__(self) -> None:
        self._log_odds = MIN_LOG_ODDS  # of H1
        self._offset2_m2 = 0.0  # mean squared distance of rejected poses from the estimate

    @property
    def probability(self) -> float:
        """Probability, 0..1, of H1: the map shows other ground."""
        return 1.0 / (1.0 + math.exp(-self._log_odds))

    @property
    def variance_m2(self) -> float:
        """Addition to the published variance per horizontal axis: the vehicle may be as far away as rejected poses are.
        0 while the probability is below MIN_COMPONENT_WEIGHT."""
        return self.probability * self._offset2_m2 if self.probability >= MIN_COMPONENT_WEIGHT else 0.0

    def add_rejected(self, offset_m: np.ndarray) -> None:
        """A camera pose outside the gate, ``offset_m`` (2,) from the estimate, that agrees with no pose before it."""
        self._add(math.log(P_REJECTED_WRONG_MAP / P_REJECTED))
        offset2_m2 = float(offset_m @ offset_m)
        self._offset2_m2 = (
            OFFSET_MEMORY * self._offset2_m2 + (1.0 - OFFSET_MEMORY) * offset2_m2 if self._offset2_m2 else offset2_m2
        )

    def add_accepted(self, information_share: float, position: Innovation) -> None:
        """A camera pose that was fused, weighted by the share 0..1 of the ground in it that is new. ``position``: the
        innovation of its position, with the tilt that was predicted. Poses of a wrong map are as far away as the
        rejected ones; a gate that is wider than that accepts them too, and its poses say nothing, as those that are
        outside of it do."""
        if not position.is_accepted:
            return
        reach2_m2 = position.limit * math.sqrt(max(float(np.linalg.det(position.covariance)), 0.0))
        in_gate = 1.0 - math.exp(-reach2_m2 / self._offset2_m2) if self._offset2_m2 else 0.0
        p_accepted_wrong_map = max(1.0 - P_REJECTED_WRONG_MAP, in_gate)
        self._add(information_share * min(math.log(p_accepted_wrong_map / (1.0 - P_REJECTED)), 0.0))
        if self._log_odds <= MIN_LOG_ODDS:
            self._offset2_m2 = 0.0

    def _add(self, llr: float) -> None:
        self._log_odds = min(MAX_LOG_ODDS, max(MIN_LOG_ODDS, self._log_odds + llr))
