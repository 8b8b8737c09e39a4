"""Poses of keyframes that have left the window of the graph, for relocalisation against them.

A pose stays as it was estimated when its node left, with the covariance that it had then: later measurements may
improve the trajectory, and the kept pose claims no more for that."""

from dataclasses import dataclass

from terrafix.estimator.integrity.fragments import Fragment
from terrafix.estimator.keyframe_view import KeyframeView

# Keyframes, the oldest of which are dropped first: at one a second, which is the most that vision keeps, more than five
# hours of flight in 14 MB. [spec: vision keeps at most one keyframe a second]
MAX_KEYFRAMES = 20_000


@dataclass(frozen=True, slots=True)
class KeptKeyframe:
    """``view`` of a keyframe, and its ``fragment``, which may be joined to the flight later."""

    view: KeyframeView
    fragment: Fragment


class KeyframeStore:
    """Keyframes by frame id. ``add`` those of nodes that are about to leave the window."""

    def __init__(self) -> None:
        self._kept: dict[int, KeptKeyframe] = {}

    def add(self, frame_id: int, keyframe: KeptKeyframe) -> None:
        self._kept[frame_id] = keyframe
        if len(self._kept) > MAX_KEYFRAMES:
            del self._kept[next(iter(self._kept))]

    def get(self, frame_id: int) -> KeptKeyframe | None:
        return self._kept.get(frame_id)

    def clear(self) -> None:
        """The poses so far have turned out to be wrong."""
        self._kept.clear()
