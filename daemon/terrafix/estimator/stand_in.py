"""Odometry against a keyframe that the estimator never had.

After a restart the first picture may be left out (node.py), and it is vision's keyframe for as long as the pictures
share enough: seconds of a slow vehicle, of which all odometry would be lost. Where two later pictures saw the same
features of it, the first of the two is keyframe as well."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec

from terrafix.messages import Odometry


@dataclass(frozen=True)
class StandIn:
    """``frame_id`` in the place of ``keyframe_id``; ``seen``: where it saw the features of that, normalised."""

    keyframe_id: int
    frame_id: int
    seen: dict[tuple[float, float], tuple[float, float]]
    sigma_norm: float  # 1-sigma of one coordinate of these

    @classmethod
    def of(cls, first: Odometry, left_out: Sequence[Odometry]) -> "StandIn | None":
        """``first``: after those that were left out. None: it does not refer to one of them."""
        if first.keyframe_id not in {odometry.frame_id for odometry in left_out}:
            return None
        seen = {(x_kf, y_kf): (x, y) for x_kf, y_kf, x, y in first.pairs}
        return cls(first.keyframe_id, first.frame_id, seen, first.sigma_norm)

    def instead(self, odometry: Odometry) -> Odometry:
        """The same against ``frame_id``; as it is where it refers to another keyframe."""
        if odometry.keyframe_id != self.keyframe_id or odometry.frame_id == self.frame_id:
            return odometry
        pairs = [(*self.seen[x_kf, y_kf], x, y) for x_kf, y_kf, x, y in odometry.pairs if (x_kf, y_kf) in self.seen]
        sigma = math.hypot(self.sigma_norm, odometry.sigma_norm)  # the keyframe's own points are exact by definition
        return msgspec.structs.replace(odometry, keyframe_id=self.frame_id, pairs=pairs, sigma_norm=sigma)
