"""Sequential test of the place to which a belief over unknown ground has converged: is the vehicle there, or nowhere on
this map?

Over a wide belief some place gathers most of the mass on any map. It is published when the frames that follow give it
more than wrong places gain (Wald's sequential test). Every place that is tested spends a share of the flight's
false-alarm budget, so that all of them together are wrong as rarely as the budget says."""

from terrafix.anchor.matching.point_mass_filter import BELIEF_LLR_MIN
from terrafix.anchor.verification.lock_monitor import MAX_GAIN
from terrafix.map.null_model import FalseAlarmBudget

# Nats of a full observation that are no evidence. Over wrong places the likelihood ratio of a drawn layer has a mean of
# 0.35, which would allow less than nothing; observations of one road are not independent.
# [measured: docs/decisions/042-vectors-as-a-layer.md]
PLACE_NULL_GAIN = 1.0


class PlaceTest:
    def __init__(self, budget: FalseAlarmBudget) -> None:
        """``budget``: of the flight."""
        self._budget = budget
        self._log_odds = 0.0

    def update(self, evidence_nats: float, weight: float, *, dominant: bool) -> bool:
        """-> whether the place has passed. ``evidence_nats``: result of ``Belief.update`` for an observation of mapped
        features with ``weight``; ``dominant``: whether one mode held the belief before and after it."""
        if not dominant:
            self._log_odds = 0.0
            return False
        if self._log_odds <= 0.0:
            self._log_odds = 0.0
            self._budget.spend()
        self._log_odds += min(max(evidence_nats - PLACE_NULL_GAIN * weight, BELIEF_LLR_MIN * weight), MAX_GAIN * weight)
        return self._log_odds >= -self._budget.log_probability
