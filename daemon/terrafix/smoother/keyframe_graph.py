"""Frames of the flight as trees: each hangs on the keyframe that it was measured against. Keyframes are the variables
of the pose graph; all other frames follow theirs.

A tree is a piece of the flight that odometry connects. It begins with a frame whose relation to the frames before is
not measured (a new fragment, a graph that began anew), at the pose that the estimator predicted there."""

from bisect import insort
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field

import gtsam
import numpy as np

from terrafix.core.gate import GATE
from terrafix.core.pose import TRANSLATION

# Keyframes in the graph, which bounds the time of a solution: beyond, the keyframe whose neighbours are closest in time
# follows the one before it. [measured: docs/decisions/039-smoother-in-flight.md]
MAX_SMOOTHED_KEYFRAMES = 256
# Frames, of which the oldest without others that hang on them are dropped first: 34 minutes at 2 Hz, in 5.5 MB. What
# was published of a dropped one stays. [measured: docs/decisions/039-smoother-in-flight.md]
MAX_SMOOTHED_FRAMES = 4096
MAX_ANCHORS = 3  # of one keyframe that contradict each other [spec: one more than can outvote each other]
LONE_FRAMES = 32  # newer frames after which one that nothing hangs on is dropped [spec: twice the estimator's window]


NO_AMBIGUITY_M2 = np.zeros((2, 2))  # one for all frames; nothing writes into it [spec: most frames have one position]
NO_AMBIGUITY_M2.flags.writeable = False


@dataclass(slots=True)
class FrameNode:
    """A frame: in the camera of its ``parent`` at ``between`` with covariance ``cov`` (6, 6), tangent order, without
    the error of the length of the translation, ``scale_sigma`` (share); ``walk2``: variance of the change of scale
    since the parent. ``parent`` None: the frame begins a tree, at ``between`` in the world."""

    frame_id: int
    t_ns: int
    fragment_id: int
    agl_m: float
    between: gtsam.Pose3
    cov: np.ndarray
    parent: int | None = None
    scale_sigma: float = 0.0
    walk2: float = 0.0
    ambiguity_m2: np.ndarray = field(default_factory=lambda: NO_AMBIGUITY_M2)


@dataclass(frozen=True, slots=True)
class Anchor:
    """Pose of a keyframe in the world by map matches, with covariance (6, 6), tangent order."""

    pose: gtsam.Pose3
    cov: np.ndarray


@dataclass(frozen=True, slots=True)
class Join:
    """A relocalisation: frame ``second`` in the camera of frame ``first``."""

    first: int
    second: int
    between: gtsam.Pose3
    cov: np.ndarray
    scale_sigma: float


class KeyframeGraph:
    """``frames`` by id, in the order of the flight; ``anchors`` by the id of their keyframe; ``joins``."""

    def __init__(self, max_keyframes: int = MAX_SMOOTHED_KEYFRAMES) -> None:
        self.frames: OrderedDict[int, FrameNode] = OrderedDict()
        self.anchors: dict[int, list[Anchor]] = {}
        self.joins: list[Join] = []
        self._children: dict[int, list[int]] = {}  # of each keyframe, ascending
        self._max_keyframes = max_keyframes
        self._lone: OrderedDict[int, None] = OrderedDict()  # frames that begin a tree and have no child

    @property
    def keyframes(self) -> list[int]:
        """Frames that others hang on, ascending."""
        return sorted(self._children)

    def children(self, keyframe: int) -> list[int]:
        """Frames that hang on it, ascending."""
        return self._children.get(keyframe, [])

    def root(self, frame_id: int) -> int:
        """The frame that begins its tree."""
        while (parent := self.frames[frame_id].parent) is not None:
            frame_id = parent
        return frame_id

    def add_start(self, node: FrameNode) -> None:
        """A frame, at its predicted pose: it begins a tree unless a link follows."""
        if node.frame_id in self.frames:
            return
        self.frames[node.frame_id] = node
        self._lone[node.frame_id] = None
        if len(self._lone) > LONE_FRAMES:
            self._drop(next(iter(self._lone)))
        if len(self.frames) > MAX_SMOOTHED_FRAMES:
            self._drop(next(frame_id for frame_id in self.frames if frame_id not in self._children))

    def add_link(self, node: FrameNode) -> bool:
        """A frame with its parent. False: the parent is not known (it was dropped, or came before a restart)."""
        parent, before = node.parent, self.frames.get(node.frame_id)
        if parent is None or parent not in self.frames or node.frame_id in self._children or node.frame_id == parent:
            return False
        if before is not None and before.parent is not None:
            return False
        self._lone.pop(parent, None)
        self._lone.pop(node.frame_id, None)
        self.frames[node.frame_id] = node
        insort(self._children.setdefault(parent, []), node.frame_id)
        for anchor in self.anchors.pop(node.frame_id, []):
            self._put_anchor(node.frame_id, anchor)
        while len(self._children) > self._max_keyframes and (thinned := self._closest()) is not None:
            self._thin(thinned)
        return True

    def add_anchor(self, frame_id: int, anchor: Anchor) -> bool:
        """A map match of a frame, at its keyframe. False: the frame is not known."""
        if frame_id not in self.frames:
            return False
        self._lone.pop(frame_id, None)
        self._put_anchor(frame_id, anchor)
        return True

    def add_join(self, join: Join) -> bool:
        """False: one of the frames is not known."""
        if join.first not in self.frames or join.second not in self.frames:
            return False
        self.joins.append(join)
        if len(self.joins) > self._max_keyframes:
            del self.joins[0]
        return True

    def on_keyframes(self, join: Join) -> Join | None:
        """The join between the keyframes of its two frames; None: it is one keyframe, or a frame was dropped."""
        if join.first not in self.frames or join.second not in self.frames:
            return None
        (first, from_first, first_cov), (second, from_second, second_cov) = map(
            self._keyframe_of, (join.first, join.second)
        )
        if first == second:
            return None
        back = from_second.inverse()
        between = from_first.compose(join.between).compose(back)
        onward = join.between.compose(back).inverse().AdjointMap()
        turned = from_second.AdjointMap()
        cov = onward @ first_cov @ onward.T + turned @ (join.cov + second_cov) @ turned.T
        return Join(first, second, between, cov, join.scale_sigma)

    def pieces(self) -> Iterator[list[int]]:
        """Keyframes of each tree, ascending; a tree of one frame only where it has an anchor or a join."""
        joined = {
            frame_id
            for join in self.joins
            for frame_id in (join.first, join.second)
            if frame_id in self.frames and self.frames[frame_id].parent is None
        }
        of_root: dict[int, list[int]] = {}
        for keyframe in sorted({*self._children, *self.anchors, *joined}):
            of_root.setdefault(self.root(keyframe), []).append(keyframe)
        yield from of_root.values()

    def _keyframe_of(self, frame_id: int) -> tuple[int, gtsam.Pose3, np.ndarray]:
        """-> the keyframe of a frame, the frame in that, and the covariance (6, 6) of this."""
        node = self.frames[frame_id]
        if frame_id in self._children or node.parent is None:
            return frame_id, gtsam.Pose3(), np.zeros((6, 6))
        return node.parent, node.between, with_scale(node)

    def _put_anchor(self, frame_id: int, anchor: Anchor) -> None:
        """At the keyframe of the frame; as one with an anchor there that agrees."""
        keyframe, between, cov = self._keyframe_of(frame_id)
        turned = between.AdjointMap()
        anchor = Anchor(anchor.pose.compose(between.inverse()), turned @ (anchor.cov + cov) @ turned.T)
        there = self.anchors.setdefault(keyframe, [])
        for i, other in enumerate(there):
            residual = other.pose.logmap(anchor.pose)
            if float(residual @ np.linalg.solve(other.cov + anchor.cov, residual)) <= GATE[6]:
                there[i] = _fused(other, anchor, residual)
                return
        there.append(anchor)
        if len(there) > MAX_ANCHORS:
            there.remove(max(there, key=lambda a: float(np.trace(a.cov[TRANSLATION, TRANSLATION]))))

    def _closest(self) -> int | None:
        """The keyframe whose parent and last child that is a keyframe are closest in time; the oldest of several. The
        newest keyframe stays."""
        best: tuple[int, int] | None = None
        for keyframe in self.keyframes[:-1]:
            node = self.frames[keyframe]
            if node.parent is None:
                continue
            after = self.frames[self._children[keyframe][-1]].t_ns
            span = after - self.frames[node.parent].t_ns, keyframe
            best = span if best is None else min(best, span)
        return None if best is None else best[1]

    def _thin(self, keyframe: int) -> None:
        """What hangs on a keyframe hangs on its parent from now on, and so does the keyframe itself."""
        node = self.frames[keyframe]
        assert node.parent is not None
        for child_id in self._children.pop(keyframe):
            child = self.frames[child_id]
            back = child.between.inverse().AdjointMap()
            child.cov = back @ node.cov @ back.T + child.cov
            child.between = node.between.compose(child.between)
            child.parent, child.walk2 = node.parent, node.walk2 + child.walk2
            child.scale_sigma = max(child.scale_sigma, node.scale_sigma)
            insort(self._children[node.parent], child_id)
        for anchor in self.anchors.pop(keyframe, []):
            self._put_anchor(keyframe, anchor)

    def _drop(self, frame_id: int) -> None:
        node = self.frames.pop(frame_id)
        self._lone.pop(frame_id, None)
        self.anchors.pop(frame_id, None)
        if node.parent is not None:
            siblings = self._children[node.parent]
            siblings.remove(frame_id)
            if not siblings:
                del self._children[node.parent]


def with_scale(node: FrameNode) -> np.ndarray:
    """Covariance (6, 6) of a frame in its parent, tangent order, with the error of the length of the translation."""
    cov, t = node.cov.copy(), node.between.rotation().unrotate(node.between.translation())
    cov[TRANSLATION, TRANSLATION] += node.scale_sigma**2 * np.outer(t, t)
    return cov


def _fused(one: Anchor, other: Anchor, residual: np.ndarray) -> Anchor:
    """Product of two independent anchors. ``residual`` (6,): of the other from the one, tangent order."""
    gain = np.linalg.solve(one.cov + other.cov, one.cov).T
    return Anchor(one.pose.retract(gain @ residual), one.cov - gain @ one.cov)
