"""Odometry against a keyframe that the graph does not have.

A graph that begins anew at a frame drops the keyframe of vision, which remains vision's keyframe while the images
overlap: for a slow vehicle that is seconds, of which all odometry would be lost. The first frame of the new graph
replaces it, for features that both it and a later frame have matched to the keyframe."""

import math
from dataclasses import dataclass

import msgspec

from terrafix.messages import Odometry, Verdict


@dataclass(frozen=True)
class KeyframeSubstitution:
    """Frame ``frame_id`` replaces ``keyframe_id``. ``seen``: features of that keyframe (x, y) -> the same in the frame;
    ``sigma_norm``: 1-sigma of one coordinate. All normalised image coordinates."""

    keyframe_id: int
    frame_id: int
    seen: dict[tuple[float, float], tuple[float, float]]
    sigma_norm: float

    @classmethod
    def of(cls, first: Odometry) -> "KeyframeSubstitution | None":
        """``first``: odometry, as vision published it, of the first frame of the graph. None: it has no earlier
        keyframe."""
        if first.verdict is not Verdict.ACCEPTED or not first.two_view or first.keyframe_id == first.frame_id:
            return None
        seen = {(x_kf, y_kf): (x, y) for x_kf, y_kf, x, y in first.two_view}
        return cls(first.keyframe_id, first.frame_id, seen, first.sigma_norm)

    def applied(self, odometry: Odometry) -> Odometry:
        """The same motion against ``frame_id``, without ``three_view``, which need the lost keyframe; unchanged
        where it refers to another keyframe."""
        if odometry.keyframe_id != self.keyframe_id or odometry.frame_id == self.frame_id:
            return odometry
        pairs = [(*self.seen[x_kf, y_kf], x, y) for x_kf, y_kf, x, y in odometry.two_view if (x_kf, y_kf) in self.seen]
        return msgspec.structs.replace(
            odometry,
            keyframe_id=self.frame_id,
            two_view=pairs,
            sigma_norm=math.hypot(self.sigma_norm, odometry.sigma_norm),  # the keyframe's own points have no error
            three_view=[],
        )
