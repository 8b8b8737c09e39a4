"""Odometry against a keyframe that the graph no longer has.

A graph that begins anew at a frame drops the keyframe of vision, which stays vision's keyframe for as long as the
pictures share enough: seconds of a slow vehicle, of which all odometry would be lost. Where two later pictures saw the
same features of it, the first of the two is keyframe as well."""

import math
from dataclasses import dataclass

import msgspec

from terrafix.messages import Odometry, Verdict


@dataclass(frozen=True)
class KeyframeSubstitution:
    """Frame ``frame_id`` in the place of ``keyframe_id``. ``seen``: features of that keyframe (x, y) -> the same in
    the frame; ``sigma_norm``: 1-sigma of one coordinate of these. All normalised image coordinates."""

    keyframe_id: int
    frame_id: int
    seen: dict[tuple[float, float], tuple[float, float]]
    sigma_norm: float

    @classmethod
    def of(cls, first: Odometry) -> "KeyframeSubstitution | None":
        """``first``: odometry, as vision has it, of the frame at which the graph begins. None: it tracks no keyframe
        before itself."""
        if first.verdict is not Verdict.ACCEPTED or not first.pairs or first.keyframe_id == first.frame_id:
            return None
        seen = {(x_kf, y_kf): (x, y) for x_kf, y_kf, x, y in first.pairs}
        return cls(first.keyframe_id, first.frame_id, seen, first.sigma_norm)

    def applied(self, odometry: Odometry) -> Odometry:
        """The same motion against ``frame_id``, without triples, whose third picture is the lost keyframe; unchanged
        where it refers to another keyframe."""
        if odometry.keyframe_id != self.keyframe_id or odometry.frame_id == self.frame_id:
            return odometry
        pairs = [(*self.seen[x_kf, y_kf], x, y) for x_kf, y_kf, x, y in odometry.pairs if (x_kf, y_kf) in self.seen]
        return msgspec.structs.replace(
            odometry,
            keyframe_id=self.frame_id,
            pairs=pairs,
            sigma_norm=math.hypot(self.sigma_norm, odometry.sigma_norm),  # the keyframe's own points were exact
            triples=[],
        )
