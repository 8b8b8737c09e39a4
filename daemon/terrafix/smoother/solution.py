"""Poses of all keyframes that map matches or relocalisations place, and of the frames that follow them."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import gtsam
import numpy as np

from terrafix.core.pose import tangent_to_world
from terrafix.smoother.keyframe_graph import Join, KeyframeGraph, with_scale
from terrafix.smoother.sim3_pose_graph import merge
from terrafix.smoother.submap_types import AbsoluteConstraint, MergedSubmaps, RelativeConstraint, Submap

SAME_SCALE = 0.01  # 1-sigma of the ratio of two scales, as a share [spec: as of two nodes of one frame]
MAX_HEIGHT_SIGMA = 0.3  # a height known no better does not give the scale [spec: of sim3_pose_graph]


@dataclass(frozen=True)
class Placed:
    """``pose`` of a camera in the world, and its covariance (6, 6): position, then rotation, world axes.
    ``m_per_unit``: scale of its submap."""

    pose: gtsam.Pose3
    cov: np.ndarray
    m_per_unit: float


def solve(graph: KeyframeGraph) -> dict[int, Placed]:
    """Pose of every keyframe that an accepted map match or relocalisation places; none of trees whose system is
    indeterminate."""
    pieces = list(graph.pieces())
    joins = [join for given in graph.joins if (join := graph.on_keyframes(given)) is not None]
    placed: dict[int, Placed] = {}
    for group in _connected(pieces, joins):
        members = {keyframe for piece in group for keyframe in piece}
        own = [join for join in joins if join.first in members]
        if own or any(keyframe in graph.anchors for keyframe in members):
            with suppress(RuntimeError):  # of GTSAM: indeterminate
                placed |= _placed(graph, group, own)
    return placed


def _connected(pieces: list[list[int]], joins: list[Join]) -> list[list[list[int]]]:
    """Pieces in groups that joins connect."""
    piece_of = {keyframe: number for number, piece in enumerate(pieces) for keyframe in piece}
    group = list(range(len(pieces)))
    for join in joins:
        old, new = sorted((group[piece_of[join.first]], group[piece_of[join.second]]), reverse=True)
        group = [new if g == old else g for g in group]
    return [[pieces[i] for i, g in enumerate(group) if g == number] for number in sorted(set(group))]


def _placed(graph: KeyframeGraph, group: list[list[int]], joins: list[Join]) -> dict[int, Placed]:
    at = {keyframe: (number, i) for number, piece in enumerate(group) for i, keyframe in enumerate(piece)}
    anchors = [
        _absolute(at[keyframe], anchor.pose, anchor.cov)
        for keyframe in at
        for anchor in graph.anchors.get(keyframe, [])
    ]
    starts = [_absolute((number, 0), *_start(graph, piece[0])) for number, piece in enumerate(group)]
    relative = [
        RelativeConstraint(
            at[join.first],
            at[join.second],
            join.between.rotation().matrix(),
            np.asarray(join.between.translation()),
            join.cov,
            1.0,
            max(join.scale_sigma, SAME_SCALE),
        )
        for join in joins
    ]
    merged = merge([_submap(graph, piece) for piece in group], [*anchors, *starts], relative)
    if not (merged.anchors[: len(anchors)].any() or merged.joins.any()):
        return {}
    return _poses(group, merged)


def _poses(group: list[list[int]], merged: MergedSubmaps) -> dict[int, Placed]:
    poses = {}
    for piece, placement in zip(group, merged.placements, strict=True):
        if placement is None:
            continue
        for i, keyframe in enumerate(piece):
            r_w_c = placement.r_w_c[i]
            pose = gtsam.Pose3(gtsam.Rot3.ClosestTo(r_w_c), placement.p_c_in_w_m[i])
            cov = tangent_to_world(placement.cov[i], r_w_c)
            poses[keyframe] = Placed(pose, cov, float(placement.m_per_unit[i]))
    return poses


def _start(graph: KeyframeGraph, root: int) -> tuple[gtsam.Pose3, np.ndarray]:
    node = graph.frames[root]
    return node.between, node.cov


def _absolute(at: tuple[int, int], pose: gtsam.Pose3, cov: np.ndarray) -> AbsoluteConstraint:
    return AbsoluteConstraint(*at, pose.rotation().matrix(), np.asarray(pose.translation()), cov)


def _submap(graph: KeyframeGraph, piece: list[int]) -> Submap:
    """By the relative poses alone, in metres by the heights of the flight."""
    n, index = len(piece), {keyframe: i for i, keyframe in enumerate(piece)}
    poses, parent = [graph.frames[piece[0]].between], np.full(n, -1)
    cov, walk, sigmas = np.zeros((n, 6, 6)), np.zeros(n), []
    for i, keyframe in enumerate(piece[1:], start=1):
        node = graph.frames[keyframe]
        assert node.parent is not None, "only the first keyframe of a tree has no parent"
        parent[i] = index[node.parent]
        poses.append(poses[parent[i]].compose(node.between))
        cov[i], walk[i] = node.cov, np.sqrt(node.walk2)
        sigmas.append(node.scale_sigma)
    known = float(np.median(sigmas)) if sigmas else 0.0
    scale_sigma = float(np.hypot(known, SAME_SCALE)) if known <= MAX_HEIGHT_SIGMA else None
    r_f_c, p_c_in_f = np.array([pose.rotation().matrix() for pose in poses]), np.array([p.translation() for p in poses])
    return Submap(r_f_c, p_c_in_f, parent, cov, scale_sigma, walk)


def predict(graph: KeyframeGraph, frame_id: int, placed: dict[int, Placed]) -> Placed | None:
    """A frame, world axes, by the relative poses from the nearest placed keyframe that its tree has before it; None:
    there is none."""
    between, cov = gtsam.Pose3(), np.zeros((6, 6))
    while (keyframe := placed.get(frame_id)) is None:
        node = graph.frames[frame_id]
        if node.parent is None:
            return None
        back = between.inverse().AdjointMap()
        cov = cov + back @ with_scale(node) @ back.T
        between, frame_id = node.between.compose(between), node.parent
    pose = keyframe.pose.compose(between)
    moved = np.eye(6)
    moved[:3, 3:] = -_skew(pose.translation() - keyframe.pose.translation())
    own = tangent_to_world(cov, pose.rotation().matrix())
    return Placed(pose, moved @ keyframe.cov @ moved.T + own, keyframe.m_per_unit)


def followers(graph: KeyframeGraph, keyframe: int, placed: dict[int, Placed]) -> Iterator[tuple[int, Placed]]:
    """Frames that hang on a keyframe and are none, world axes, the newest first; none if the keyframe is not placed."""
    if keyframe not in placed:
        return
    after_id: int | None = None
    for frame_id in reversed(graph.children(keyframe)):
        if frame_id in placed:
            after_id = frame_id
        else:
            yield frame_id, _follower(graph, frame_id, after_id, placed)


def _follower(graph: KeyframeGraph, frame_id: int, after_id: int | None, placed: dict[int, Placed]) -> Placed:
    """A frame by its keyframe, and by what is left at the next keyframe ``after_id`` in proportion to the time."""
    node = graph.frames[frame_id]
    assert node.parent is not None
    keyframe = placed[node.parent]
    here = keyframe.pose.compose(node.between)
    own = tangent_to_world(with_scale(node), here.rotation().matrix())
    lever = here.translation() - keyframe.pose.translation()
    moved = np.eye(6)
    moved[:3, 3:] = -_skew(lever)
    begin_cov = moved @ keyframe.cov @ moved.T
    if after_id is None:
        return Placed(here, begin_cov + own, keyframe.m_per_unit)
    after, end = graph.frames[after_id], placed[after_id]
    share = (node.t_ns - graph.frames[node.parent].t_ns) / max(after.t_ns - graph.frames[node.parent].t_ns, 1)
    share = min(max(share, 0.0), 1.0)
    expected = keyframe.pose.compose(after.between)
    shift = share * (end.pose.translation() - expected.translation())
    turn = share * gtsam.Rot3.Logmap(end.pose.rotation().compose(expected.rotation().inverse()))
    pose = gtsam.Pose3(gtsam.Rot3.Expmap(turn).compose(here.rotation()), here.translation() + shift)
    bridge = share * (1.0 - share) * tangent_to_world(with_scale(after), expected.rotation().matrix())
    return Placed(pose, (1.0 - share) * keyframe.cov + share * end.cov + bridge, keyframe.m_per_unit)


def _skew(v: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
