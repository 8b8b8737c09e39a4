"""Point clouds of the fragments of a flight, from points that three keyframes see."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from terrafix.estimator.factors.three_view import ThreeViewPose, triangulate
from terrafix.estimator.state import UP
from terrafix.messages import Odometry
from terrafix_tools.finalise.point_cloud import POINTS, read_ply
from terrafix_tools.finalised import SUMMARY, read_flights
from terrafix_tools.locate.views import CameraView, FlightViews

Elevation = Callable[[np.ndarray, np.ndarray], np.ndarray | None]  # east, north (N,) [m] -> AMSL (N,) [m], NaN: unknown


@dataclass(frozen=True)
class PointCloud:
    """``points_m`` (N, 3): in the local frame of the flight. ``sigma_m`` (N,): 1-sigma of the height of each by its
    image errors; the common level of all is that of the reference (``build_cloud``)."""

    points_m: np.ndarray
    sigma_m: np.ndarray

    def seen_near(self, view: CameraView, xy: np.ndarray, radius: float, count: int) -> tuple["PointCloud", np.ndarray]:
        """The ``count`` points that ``view`` sees nearest to ``xy`` (2,), at most ``radius`` away, and where it sees
        them relative to that (M, 2), normalised image coordinates."""
        in_c = (self.points_m - view.p_c_in_w_m) @ view.r_w_c
        away = np.full((len(in_c), 2), np.inf)
        ahead = in_c[:, 2] > 0.0
        away[ahead] = in_c[ahead, :2] / in_c[ahead, 2:] - xy
        distance = np.hypot(*away.T)
        nearest = np.argsort(distance)[:count]
        nearest = nearest[distance[nearest] < radius]
        return PointCloud(self.points_m[nearest], self.sigma_m[nearest]), away[nearest]


def finalised_cloud(folder: Path) -> PointCloud | None:
    """All points that `terrafix finalise` has triangulated, in the axes of its only flight; None: the record in
    ``folder`` was not finalised. Raises SourceError, EvaluationError."""
    if len(read_flights(folder / SUMMARY)) != 1 or not (folder / POINTS).is_file():
        return None
    points = read_ply(folder / POINTS)
    return PointCloud(np.column_stack([points[axis] for axis in "xyz"]), points["sigma"].astype(float))


def build_cloud(flight: FlightViews, fragment_id: int, elevation: Elevation | None) -> PointCloud:
    """Point cloud of one fragment.

    The images determine the shape of three views and not its size. Size and level are those that put the median point
    on ``elevation``, or without it on the ground level by which the estimator took the height."""
    parts = [
        part
        for odometry in flight.triples
        if (seen := _three_views(flight, odometry)) is not None and seen[1].fragment_id == fragment_id
        if (part := _points(odometry, seen, flight.origin.camera.focal_sigma, elevation)) is not None
    ]
    if not parts:
        return PointCloud(np.zeros((0, 3)), np.zeros(0))
    return PointCloud(np.concatenate([p for p, _ in parts]), np.concatenate([s for _, s in parts]))


def _three_views(flight: FlightViews, odometry: Odometry) -> tuple[CameraView, CameraView, CameraView] | None:
    """Cameras of the previous keyframe, of the keyframe and of the frame; None: one has no position."""
    ids = (odometry.previous_keyframe_id, odometry.keyframe_id, odometry.frame_id)
    first, middle, last = (flight.views.get(frame_id) for frame_id in ids)
    return None if first is None or middle is None or last is None else (first, middle, last)


def _points(
    odometry: Odometry,
    seen: tuple[CameraView, CameraView, CameraView],
    focal_sigma: float,
    elevation: Elevation | None,
) -> tuple[np.ndarray, np.ndarray] | None:
    """-> points (N, 3) and the 1-sigma of their heights (N,); None: the three views do not determine them."""
    view = seen[1]
    cameras = [(camera.r_w_c, camera.p_c_in_w_m) for camera in seen]
    guess = ThreeViewPose.of(cameras, height_m=view.height_m, ground_m=view.ground_m, k1=view.calibration.radial_k1)
    found = triangulate(np.array(odometry.three_view), odometry.three_view_sigma_norm, guess, focal_sigma)
    if found is None:
        return None
    in_c, relative_sigma = found
    rays_m = in_c @ view.r_w_c.T
    below_m = -rays_m[:, UP]
    level_m = np.full(len(rays_m), view.ground_m)
    if elevation is not None:
        at_m = view.p_c_in_w_m + rays_m
        known_m = elevation(at_m[:, 0], at_m[:, 1])
        if known_m is not None and np.isfinite(known_m).any():
            level_m = known_m
    scale = float(np.nanmedian((view.p_c_in_w_m[UP] - level_m) / below_m))
    return view.p_c_in_w_m + scale * rays_m, relative_sigma * scale * below_m
