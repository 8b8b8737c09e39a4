"""Poses of keyframes that have left the window of the graph, for relocalisation against them.

A pose stays as it was estimated when its node left, with the covariance that it had then: later measurements may
improve the trajectory, and the kept pose claims no more for that."""

from dataclasses import dataclass

import gtsam
import numpy as np

from terrafix.estimator.integrity.fragments import Fragment
from terrafix.estimator.keyframe_view import KeyframeView
from terrafix.estimator.state import POSE_SIZE

# Keyframes, the oldest of which are dropped first: at one a second, which is the most that vision keeps, almost three
# hours of flight, in 4 MB that are reserved at the start. [spec: vision keeps at most one keyframe a second]
MAX_STORED_KEYFRAMES = 10_000

_ROW = np.dtype(
    [("rotation", float, (3, 3)), ("p_m", float, (3,)), ("cov", float, (POSE_SIZE, POSE_SIZE)), ("ground_m", float)]
)


@dataclass(frozen=True, slots=True)
class KeptKeyframe:
    """``view`` of a keyframe, and its ``fragment``, which may be joined to the flight later."""

    view: KeyframeView
    fragment: Fragment


class KeyframeStore:
    """Keyframes by frame id. ``add`` those of nodes that are about to leave the window, each once.

    They lie in arrays that are written once at the start: objects of their own would take twice the memory, and would
    keep the heap around them from being used again. ``max_keyframes``: the oldest are dropped."""

    def __init__(self, max_keyframes: int = MAX_STORED_KEYFRAMES) -> None:
        self._rows = np.zeros(max_keyframes, _ROW)
        self._rows["rotation"] = 0.0  # written, so that the kernel gives all of the memory now
        self._fragments: list[Fragment | None] = [None] * max_keyframes
        self._row_of: dict[int, int] = {}  # by frame id, oldest first
        self._next = 0  # row of the next keyframe: that of the oldest one when all are taken

    @property
    def size_bytes(self) -> int:
        return self._rows.nbytes

    def __len__(self) -> int:
        return len(self._row_of)

    def add(self, frame_id: int, keyframe: KeptKeyframe) -> None:
        if len(self._row_of) == len(self._rows):
            del self._row_of[next(iter(self._row_of))]
        view, row = keyframe.view, self._rows[self._next]
        row["rotation"], row["p_m"] = view.pose.rotation().matrix(), view.pose.translation()
        row["cov"], row["ground_m"] = view.cov, view.ground_m
        self._fragments[self._next] = keyframe.fragment
        self._row_of[frame_id] = self._next
        self._next = (self._next + 1) % len(self._rows)

    def get(self, frame_id: int) -> KeptKeyframe | None:
        index = self._row_of.get(frame_id)
        fragment = None if index is None else self._fragments[index]
        if index is None or fragment is None:
            return None
        row = self._rows[index]
        pose = gtsam.Pose3(gtsam.Rot3(row["rotation"]), row["p_m"])
        return KeptKeyframe(KeyframeView(pose, row["cov"].copy(), float(row["ground_m"])), fragment)

    def clear(self) -> None:
        """The poses so far have turned out to be wrong."""
        self._row_of.clear()
        self._fragments = [None] * len(self._rows)
        self._next = 0
