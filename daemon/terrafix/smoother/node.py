"""The smoother: past poses of all fragments, refined in flight (AC-4, AC-8).

It runs beside the estimator and never before it: it gets the relative poses and the map matches that the estimator has
accepted, and no other process waits for what it publishes. All times are those of messages, so that a replay is equal.
"""

import math
from collections.abc import Callable, Iterable
from itertools import chain

import gtsam
import numpy as np

from terrafix.core.geodesy import LocalFrame, quat_from_rot, rot_from_quat
from terrafix.core.map_error import shared_variance_m2
from terrafix.core.node import NodeBase, NodeContext
from terrafix.core.pose import HORIZONTAL, tangent_to_world, world_to_tangent
from terrafix.messages import (
    CovarianceMode,
    Message,
    Origin,
    PoseAnchor,
    PoseLink,
    Prediction,
    Quat,
    RefinedPose,
    Refinement,
    RefinementSource,
    Vec3,
)
from terrafix.smoother.keyframe_graph import NO_AMBIGUITY_M2, Anchor, FrameNode, Join, KeyframeGraph
from terrafix.smoother.solution import Placed, followers, predict, solve

REFINEMENT_PERIOD_NS = 1_000_000_000  # from one Refinement to the next, at least [spec: once a second]
# from one solution to the next, while map matches move nothing [spec: a merge within 5 s]
IDLE_SOLUTION_NS = 5_000_000_000
MAX_POSES = 128  # of a Refinement; the others follow in the next ones [spec: 50 kB]
# Change of a pose, or of its 1-sigma, in 1-sigma, from which it is published again. [spec: changes no decision below]
MOVED_POSE_SIGMAS = 0.25
# Random walk of the scale from frame to frame, as a share: of a height that is known, and of one that is not.
KNOWN_HEIGHT_WALK, ASSUMED_HEIGHT_WALK = 0.002, 0.02  # [spec: of finalise]
KNOWN_HEIGHT = 0.1  # 1-sigma of a known height, as a share [spec: docs/finalise.md]


class SmootherNode(NodeBase):
    def __init__(self, *, enabled: bool = True, graph: KeyframeGraph | None = None) -> None:
        self._enabled = enabled
        self._graph = graph or KeyframeGraph()
        self._axes: LocalFrame | None = None
        self._amsl_known = False  # the Origin has the elevation of the ground
        self._waiting: list[Message] = []  # for the Origin, which comes from another process
        self._solved: dict[int, Placed] = {}
        self._published: dict[int, np.ndarray] = {}  # frame -> (2, 3): position, and the columns of its covariance
        self._changed = False  # there is a constraint that the solution does not have ...
        self._shift2 = 0.0  # ... and these move what was published by so much, in squared 1-sigma
        self._solved_ns: int | None = None  # time of the solution
        self._behind = False  # not all that has moved is published
        self._moved_keyframes: set[int] = set()  # keyframes whose followers are to be published
        self._hot = False
        self._now_ns = 0  # time of the newest message
        self._published_ns: int | None = None  # time of the newest Refinement
        self._map_var_m2 = 0.0
        self._axis, self._axis_cov = np.zeros(2), np.zeros((2, 2))
        self._handlers: dict[type[Message], Callable[..., None]] = {
            Prediction: self._on_prediction,
            PoseLink: self._on_link,
            PoseAnchor: self._on_anchor,
        }

    def on(self, message: Message) -> Iterable[Message]:
        if isinstance(message, Origin):
            return self._on_origin(message)
        if not self._enabled or type(message) not in self._handlers:
            return ()
        if self._axes is None:
            self._waiting = [*self._waiting[-MAX_POSES:], message]
            return ()
        return self._take(message)

    def _on_origin(self, origin: Origin) -> Iterable[Message]:
        axes = LocalFrame(origin.lat_deg, origin.lon_deg)
        if self._axes is not None:  # published again, after a restart of vision
            return
        self._axes, self._amsl_known = axes, origin.ground_amsl_m is not None
        waiting, self._waiting = self._waiting, []
        for message in waiting:
            yield from self._take(message)

    def _take(self, message: Message) -> Iterable[Message]:
        self._handlers[type(message)](message)
        now_ns = self._now_ns = max(message.t_ns, self._now_ns)  # a map match has the time of its frame
        period_ns = REFINEMENT_PERIOD_NS if self._shift2 > MOVED_POSE_SIGMAS**2 else IDLE_SOLUTION_NS
        solves = self._changed and _passed(self._solved_ns, now_ns, period_ns)
        if self._hot or not (solves or self._behind) or not _passed(self._published_ns, now_ns, REFINEMENT_PERIOD_NS):
            return
        if solves:
            self._changed, self._shift2, self._solved_ns = False, 0.0, now_ns
            self._solved, self._behind = solve(self._graph), True
        poses = list(self._moved())
        if poses:
            self._published_ns = now_ns
            yield Refinement(t_ns=now_ns, poses=poses, source=RefinementSource.SMOOTHER)

    # --- inputs --------------------------------------------------------------------------------------------------

    def _on_prediction(self, seen: Prediction) -> None:
        pose = _pose(seen.q_w_c, seen.p_c_in_w_m)
        cov = world_to_tangent(np.array(seen.cov).reshape(6, 6), pose.rotation().matrix())
        self._graph.add_start(FrameNode(seen.frame_id, seen.t_ns, seen.fragment_id, seen.agl_m, pose, cov))

    def _on_link(self, link: PoseLink) -> None:
        between, cov = _pose(link.q_parent_c, link.p_in_parent_m), np.array(link.cov).reshape(6, 6)
        if link.relocalization:
            join = Join(link.parent_id, link.frame_id, between, cov, link.scale_sigma)
            if self._graph.add_join(join):
                self._changed, self._shift2 = True, math.inf
            return
        walk = KNOWN_HEIGHT_WALK if link.scale_sigma <= KNOWN_HEIGHT else ASSUMED_HEIGHT_WALK
        added = self._graph.add_link(
            FrameNode(
                link.frame_id,
                link.t_ns,
                link.fragment_id,
                link.agl_m,
                between,
                cov,
                link.parent_id,
                link.scale_sigma,
                walk**2 * max(link.frame_id - link.parent_id, 1),
                np.array(link.ambiguity_m2).reshape(2, 2) if any(link.ambiguity_m2) else NO_AMBIGUITY_M2,
            )
        )
        if added:
            self._moved_keyframes.add(link.parent_id)

    def _on_anchor(self, seen: PoseAnchor) -> None:
        self._hot = seen.covariance_mode is CovarianceMode.JACOBIAN
        self._map_var_m2 = shared_variance_m2(seen.map_sigma_m)
        self._axis, self._axis_cov = np.array(seen.axis), np.array(seen.axis_cov).reshape(2, 2)
        anchor = Anchor(_pose(seen.q_w_c, seen.p_c_in_w_m), np.array(seen.cov).reshape(6, 6))
        if self._graph.add_anchor(seen.frame_id, anchor):
            self._changed, self._shift2 = True, self._shift2 + self._shift2_of(seen.frame_id, anchor)

    def _shift2_of(self, frame_id: int, anchor: Anchor) -> float:
        """Square of the shift by which a map match of a frame moves the poses before it, in their published 1-sigma."""
        expected = predict(self._graph, frame_id, self._solved)
        if expected is None:
            return math.inf
        offset_m = (anchor.pose.translation() - expected.pose.translation())[HORIZONTAL]
        ours_m2 = expected.cov[HORIZONTAL, HORIZONTAL]
        theirs_m2 = tangent_to_world(anchor.cov, anchor.pose.rotation().matrix())[HORIZONTAL, HORIZONTAL]
        shift_m = ours_m2 @ np.linalg.solve(ours_m2 + theirs_m2, offset_m)
        claimed_m2 = ours_m2 + self._map_var_m2 * np.eye(2)
        return float(shift_m @ np.linalg.solve(claimed_m2, shift_m))

    # --- outputs -------------------------------------------------------------------------------------------------

    def _moved(self) -> Iterable[RefinedPose]:
        """Poses that have moved since they were published: of keyframes first, the newest first, then of the frames
        that follow those."""
        self._behind, count = True, 0
        if len(self._published) > len(self._graph.frames) + MAX_POSES:
            self._published = {frame: was for frame, was in self._published.items() if frame in self._graph.frames}
        for frame_id, placed in chain(self._placed_keyframes(), self._followers()):
            p_m, cov = self._with_common_errors(self._graph.frames[frame_id], placed)
            if not np.isfinite(placed.cov).all() or not self._has_moved(frame_id, p_m, cov):
                continue
            if count == MAX_POSES:
                return
            count += 1
            self._published[frame_id] = np.column_stack([p_m, cov])
            if frame_id in self._solved:
                self._moved_keyframes |= {frame_id, self._graph.frames[frame_id].parent or frame_id}
            yield self._refined(frame_id, placed, p_m, cov)
        self._behind = False

    def _placed_keyframes(self) -> Iterable[tuple[int, Placed]]:
        for keyframe in sorted(self._solved.keys() & self._graph.frames.keys(), reverse=True):
            yield keyframe, self._solved[keyframe]

    def _followers(self) -> Iterable[tuple[int, Placed]]:
        """Of keyframes that have moved, and those with a new frame."""
        self._moved_keyframes &= set(self._graph.keyframes)
        for keyframe in sorted(self._moved_keyframes, reverse=True):
            yield from followers(self._graph, keyframe, self._solved)
            if keyframe in self._solved:
                self._moved_keyframes.discard(keyframe)

    def _with_common_errors(self, node: FrameNode, placed: Placed) -> tuple[np.ndarray, np.ndarray]:
        """-> horizontal position (2,) and covariance (2, 2), with what no number of map matches averages away."""
        jacobian = node.agl_m * placed.pose.rotation().matrix()[HORIZONTAL, HORIZONTAL]
        p_m = placed.pose.translation()[HORIZONTAL] + jacobian @ self._axis
        common = self._map_var_m2 * np.eye(2) + jacobian @ self._axis_cov @ jacobian.T
        return p_m, placed.cov[HORIZONTAL, HORIZONTAL] + common + node.ambiguity_m2

    def _has_moved(self, frame_id: int, p_m: np.ndarray, cov: np.ndarray) -> bool:
        if frame_id not in self._published:
            return True
        was = self._published[frame_id]
        was_m, was_cov = was[:, 0], was[:, 1:]
        moved, sigma = p_m - was_m, np.sqrt(np.diag(cov))
        was_sigma = np.sqrt(np.diag(was_cov))
        distance2 = float(moved @ np.linalg.solve(cov, moved))
        return distance2 > MOVED_POSE_SIGMAS**2 or bool(
            (np.abs(sigma - was_sigma) > MOVED_POSE_SIGMAS * was_sigma).any()
        )

    def _refined(self, frame_id: int, placed: Placed, p_m: np.ndarray, cov: np.ndarray) -> RefinedPose:
        assert self._axes is not None
        lat_deg, lon_deg = self._axes.to_wgs84(float(p_m[0]), float(p_m[1]))
        full = placed.cov.copy()
        full[HORIZONTAL, HORIZONTAL] = cov
        return RefinedPose(
            frame_id=frame_id,
            lat_deg=lat_deg,
            lon_deg=lon_deg,
            alt_amsl_m=float(placed.pose.translation()[2]) if self._amsl_known else None,
            sigma_e_m=float(np.sqrt(cov[0, 0])),
            sigma_n_m=float(np.sqrt(cov[1, 1])),
            cov_en_m2=float(cov[0, 1]),
            fragment_id=self._graph.frames[frame_id].fragment_id,
            q_w_c=quat_from_rot(placed.pose.rotation().matrix()),
            cov=tuple(full.ravel().tolist()),
            m_per_unit=placed.m_per_unit,
        )


def _passed(since_ns: int | None, now_ns: int, period_ns: int) -> bool:
    return since_ns is None or now_ns - since_ns >= period_ns


def _pose(q: Quat, p: Vec3) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.ClosestTo(rot_from_quat(q)), np.array(p))


def make_node(ctx: NodeContext) -> SmootherNode:
    return SmootherNode(enabled=ctx.config.smoother.enabled)
