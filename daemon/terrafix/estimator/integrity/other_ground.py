"""How far away the vehicle may be if the map does not show the ground below (``Cause.OTHER_GROUND``): as far as the
camera poses are that the innovation gate rejects and that agree with no other one."""

import math

import numpy as np

from terrafix.core.agreement import (
    NATS_PER_SCORE,
    P_NOTHING_OTHER_GROUND,
    P_REJECTED,
    P_REJECTED_OTHER_GROUND,
    RANGES,
    WRONG_SCORE,
    Agreement,
    Cause,
    Observed,
)
from terrafix.estimator.integrity.innovation import Innovation
from terrafix.estimator.monitors.registration import REGISTRATION_SPACING_HEIGHTS

OFFSET_MEMORY = 0.7  # weight of the earlier mean in that of the squared offsets of rejected poses [tuned]
# Distance of a wrong pose from the place, in heights, before any was rejected [spec: half of a view of 70 degrees]
WRONG_POSE_HEIGHTS = 0.7


class OtherGround:
    def __init__(self, agreement: Agreement) -> None:
        self.agreement = agreement
        self._offset2_m2 = 0.0  # mean squared distance of rejected poses from the estimate
        self._nothing_at_m: np.ndarray | None = None  # the last correlation without a pose that counted

    @property
    def variance_m2(self) -> float:
        """Per horizontal axis, times the weight of the cause."""
        return self.agreement.weight(Cause.OTHER_GROUND) * self._offset2_m2

    def on_rejected(self, offset_m: np.ndarray) -> None:
        """A camera pose outside the gate, ``offset_m`` (2,) from the estimate, that agrees with no pose before it."""
        self.agreement.observe(Observed.REJECTED, Cause.OTHER_GROUND)
        offset2_m2 = float(offset_m @ offset_m)
        self._offset2_m2 = (
            OFFSET_MEMORY * self._offset2_m2 + (1.0 - OFFSET_MEMORY) * offset2_m2 if self._offset2_m2 else offset2_m2
        )

    def on_nothing(self, at_m: np.ndarray, height_m: float, p_nothing: float) -> None:
        """No pose was found over textured ground at ``at_m`` (2,), ``height_m`` above it. ``p_nothing``: probability of
        that over ground which the map shows (MapHitRate). By itself it widens no claim: it is the prior by which a
        pose that is found there, or is rejected, is weighed."""
        if (
            self._nothing_at_m is None
            or np.hypot(*(at_m - self._nothing_at_m)) >= REGISTRATION_SPACING_HEIGHTS * height_m
        ):
            self._nothing_at_m = at_m
            # A hit rate below that over other ground is one of other ground.
            self.agreement.add(Cause.OTHER_GROUND, max(math.log(P_NOTHING_OTHER_GROUND / p_nothing), 0.0))

    def on_score(self, information_share: float, score: float) -> None:
        """The best place of a frame, whose pose was fused, has this standardised correlation: more than over ground
        that the map does not show."""
        nats = min(NATS_PER_SCORE * (WRONG_SCORE - score), 0.0)
        self.agreement.add(Cause.OTHER_GROUND, information_share * nats)

    def on_pose(self, information_share: float, position: Innovation, height_m: float) -> None:
        """A camera pose that was fused, weighted by the share 0..1 of the ground in it that is new. ``position``: the
        innovation of its position, with the tilt that was predicted. Poses of a wrong map are as far away as the
        rejected ones; a gate that is wider than that accepts them too, and its poses say nothing, as those that are
        outside of it do. Where they are wrong, the vehicle is where it was predicted without them."""
        if not position.is_accepted:
            return
        reach2_m2 = position.limit * math.sqrt(max(float(np.linalg.det(position.covariance)), 0.0))
        in_gate = 1.0 - math.exp(-reach2_m2 / (self._offset2_m2 or (WRONG_POSE_HEIGHTS * height_m) ** 2))
        if in_gate > 1.0 - P_REJECTED_OTHER_GROUND:
            nats = min(math.log(in_gate / (1.0 - P_REJECTED)), 0.0)
            self.agreement.add(Cause.OTHER_GROUND, information_share * nats)
            off_m = position.residual
            self._offset2_m2 = max(self._offset2_m2, float(off_m @ off_m + np.trace(position.covariance)))
        else:
            self.agreement.observe(Observed.POSE, Cause.OTHER_GROUND, information_share)
        if self.agreement.log_odds[Cause.OTHER_GROUND] <= RANGES[Cause.OTHER_GROUND].least:
            self._offset2_m2 = 0.0
