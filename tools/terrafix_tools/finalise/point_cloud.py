"""Sparse point cloud of each fragment: the features of odometry, triangulated from the finalised cameras.

A feature of a keyframe and its matches in later frames are one track. Its point is the least squares intersection of
the rays (Hartley and Zisserman, "Multiple View Geometry", 2004, ch. 12), each weighted by its distance."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import gtsam
import numpy as np

from terrafix.core.errors import OutputError, SourceError
from terrafix.core.geodesy import LocalFrame
from terrafix.messages import Odometry
from terrafix_tools.estimates import PARTIAL
from terrafix_tools.finalise.lens import Lens

POINTS = "points.ply"
# Rays that meet at a smaller angle give no depth. [spec: COLMAP, mapper.filter_min_tri_angle]
MIN_ANGLE_RAD = np.radians(1.5)
MAX_RESIDUAL_SIGMAS = 3.0  # rms distance of a point from its rays: above it a match is wrong [spec: 3 sigma]
ROUNDS = 3  # of the weights, which need the distance; the first one takes it as equal [spec: changes below 1e-3]
VERTEX = np.dtype(
    [(name, "<f8") for name in ("x", "y", "z")]
    + [("sigma", "<f4"), ("views", "<u2"), ("fragment", "<i4"), ("keyframe", "<u4")]
)  # [spec: PLY, a scalar property for each column]
END_OF_HEADER = b"end_header\n"
PLY_TYPES = {"<f8": "double", "<f4": "float", "<u2": "ushort", "<i4": "int", "<u4": "uint"}


@dataclass(frozen=True)
class _Matches:
    """``pairs`` (N, 4): normalised (x_kf, y_kf, x, y), 1-sigma ``sigma`` of a coordinate."""

    frame_id: int
    pairs: np.ndarray
    sigma: float


@dataclass
class FeatureTracks:
    """Features of the keyframes of a flight, and where other frames show them."""

    _by_keyframe: dict[int, list[_Matches]] = field(default_factory=dict)
    _fragments: dict[int, int] = field(default_factory=dict)  # of the keyframes

    def add(self, odometry: Odometry) -> None:
        """``odometry`` of a frame that the estimator has registered to its keyframe."""
        self._add(odometry.keyframe_id, odometry, odometry.two_view, odometry.sigma_norm)
        for link in odometry.links:
            self._add(link.keyframe_id, odometry, link.two_view, link.sigma_norm)

    def _add(
        self, keyframe_id: int, of: Odometry, pairs: list[tuple[float, float, float, float]], sigma: float
    ) -> None:
        if pairs:
            self._by_keyframe.setdefault(keyframe_id, []).append(_Matches(of.frame_id, np.array(pairs), sigma))
            self._fragments[keyframe_id] = of.fragment_id

    def triangulated(self, cameras: Mapping[int, gtsam.Pose3], lens: Lens) -> np.ndarray:
        """``cameras``: finalised pose of each frame that has one; east, north, AMSL height. -> (N,) of VERTEX."""
        parts = [np.zeros(0, VERTEX)]
        for keyframe_id, matches in self._by_keyframe.items():
            placed = [one for one in matches if one.frame_id in cameras]
            if keyframe_id in cameras and placed:
                points = _points(_Rays.of(keyframe_id, placed, cameras, lens))
                points["keyframe"], points["fragment"] = keyframe_id, self._fragments[keyframe_id]
                parts.append(points)
        return np.concatenate(parts)


@dataclass(frozen=True)
class _Rays:
    """Rays of the features of one keyframe: ``track`` (N,) index of the feature, ``from_m`` (N, 3), unit vector
    ``along`` (N, 3), ``sigma_rad`` (N,). The first ``tracks`` ones are those of the keyframe."""

    tracks: int
    track: np.ndarray
    from_m: np.ndarray
    along: np.ndarray
    sigma_rad: np.ndarray

    @staticmethod
    def of(keyframe_id: int, matches: list[_Matches], cameras: Mapping[int, gtsam.Pose3], lens: Lens) -> "_Rays":
        features, track = np.unique(np.vstack([one.pairs[:, :2] for one in matches]), axis=0, return_inverse=True)
        views = [(keyframe_id, features, matches[0].sigma)]
        views += [(one.frame_id, one.pairs[:, 2:], one.sigma) for one in matches]
        from_m, along, sigma = [], [], []
        for frame_id, xy, sigma_norm in views:
            pose = cameras[frame_id]
            rays = np.column_stack([lens.rays(xy), np.ones(len(xy))])
            length = np.linalg.norm(rays, axis=1)
            along.append(rays / length[:, None] @ pose.rotation().matrix().T)
            from_m.append(np.broadcast_to(pose.translation(), (len(xy), 3)))
            sigma.append(sigma_norm / length)
        tracks = np.concatenate([np.arange(len(features)), track.ravel()])
        return _Rays(len(features), tracks, np.vstack(from_m), np.vstack(along), np.concatenate(sigma))


def _points(rays: _Rays) -> np.ndarray:
    """(N,) of VERTEX: the tracks whose rays meet."""
    count, track, along = rays.tracks, rays.track, rays.along
    across = np.eye(3) - along[:, :, None] * along[:, None, :]
    distance_m = np.ones(len(track))
    for _ in range(ROUNDS):
        weight = 1.0 / np.square(rays.sigma_rad * distance_m)
        information, vector = np.zeros((count, 3, 3)), np.zeros((count, 3))
        weighted = across * weight[:, None, None]
        np.add.at(information, track, weighted)
        np.add.at(vector, track, np.einsum("nij,nj->ni", weighted, rays.from_m))
        meets = np.linalg.cond(information) < 1.0 / np.finfo(float).eps  # parallel rays meet nowhere
        point_m = np.full((count, 3), np.nan)
        point_m[meets] = np.linalg.solve(information[meets], vector[meets][:, :, None])[:, :, 0]
        distance_m = np.abs(np.einsum("ni,ni->n", point_m[track] - rays.from_m, along))
    off = np.einsum("nij,nj->ni", across, point_m[track] - rays.from_m) / (rays.sigma_rad * distance_m)[:, None]
    views = np.bincount(track, minlength=count)
    # Two numbers of each ray, less the three of the point.
    residual = np.sqrt(np.bincount(track, np.sum(off**2, axis=1), count) / (2 * views - 3))
    cos_angle = np.full(count, 1.0)
    np.minimum.at(cos_angle, track, np.einsum("ni,ni->n", along, along[track]))
    behind = np.zeros(count, bool)
    np.logical_or.at(behind, track, np.einsum("ni,ni->n", point_m[track] - rays.from_m, along) <= 0.0)
    good = meets & (residual <= MAX_RESIDUAL_SIGMAS) & (cos_angle <= np.cos(MIN_ANGLE_RAD)) & ~behind
    points = np.zeros(int(good.sum()), VERTEX)
    points["x"], points["y"], points["z"] = point_m[good].T
    variance_m2 = np.trace(np.linalg.inv(information[good]), axis1=1, axis2=2) * np.maximum(residual[good], 1.0) ** 2
    points["sigma"], points["views"] = np.sqrt(variance_m2), views[good]
    return points


def cloud_name(flight: int) -> str:
    """Of the flight of this number, from 0, in a record."""
    return POINTS if not flight else f"points-{flight + 1}.ply"


def read_ply(path: Path) -> np.ndarray:
    """-> points (N,) of VERTEX, of a file that ``write_ply`` wrote. Raises SourceError."""
    try:
        _, end, body = path.read_bytes().partition(END_OF_HEADER)
        if not end:
            raise ValueError("no header")
        return np.frombuffer(body, VERTEX)
    except (OSError, ValueError) as error:
        raise SourceError(f"{path}: cannot be read ({error}); write it again with 'terrafix finalise'") from None


def write_ply(path: Path, points: np.ndarray, axes: LocalFrame) -> None:
    """``points`` (N,) of VERTEX, in ``axes``: east, north, AMSL height. Raises OutputError."""
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment x east, y north [m] of latitude {axes.lat_deg:.8f}, longitude {axes.lon_deg:.8f} (WGS84)",
        "comment z above mean sea level [m]; sigma [m] relative to the cameras",
        f"element vertex {len(points)}",
        *(f"property {PLY_TYPES[VERTEX[name].str]} {name}" for name in VERTEX.names or ()),
        "end_header",
    ]
    partial = path.with_name(path.name + PARTIAL)
    try:
        partial.write_bytes("\n".join([*header, ""]).encode("ascii") + points.tobytes())
        partial.replace(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); is the disk full, or read-only?") from None
