"""Inputs of the smoother without an estimator: a true track, relative poses with a drift, and map matches."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from simulated_flight import ORIGIN, PLACE
from terrafix.core.geodesy import quat_from_rot
from terrafix.core.pose import exp_so3, tangent_to_world
from terrafix.messages import CovarianceMode, Message, PoseAnchor, PoseLink, Prediction, RefinedPose, Refinement
from terrafix.smoother.node import SmootherNode

STEP_M, AGL_M = 10.0, 100.0
DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # camera that looks down, image top east
LINK_COV = np.diag([0.003, 0.003, 0.003, 0.2, 0.2, 0.2]) ** 2
ANCHOR_COV = np.diag([0.01, 0.01, 0.01, 1.0, 1.0, 2.0]) ** 2
START_COV = np.diag([0.02, 0.02, 0.1, 30.0, 30.0, 5.0]) ** 2


def flat(cov: np.ndarray) -> tuple[float, ...]:
    return tuple(float(v) for v in cov.ravel())


@dataclass
class Track:
    """A square of ``side_m`` flown once a ``lap`` of frames, 1 s apart, each a keyframe. Relative poses turn by
    ``drift_rad`` too much from frame to frame and are too long by ``drift_share``."""

    side_m: float = 200.0
    drift_rad: float = 0.0
    drift_share: float = 0.0
    smoother: SmootherNode = field(default_factory=SmootherNode)
    published: list[Refinement] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.feed([ORIGIN])

    def pose(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """True orientation (3, 3) and position (3,) at frame ``i``."""
        lap = 4 * self.side_m
        side, along = divmod((i * STEP_M) % lap, self.side_m)
        corner = [(0.0, 0.0), (self.side_m, 0.0), (self.side_m, self.side_m), (0.0, self.side_m)][int(side)]
        towards = 0.5 * math.pi * side
        turn = exp_so3(np.array([0.0, 0.0, towards]))
        p = np.array([*corner, AGL_M]) + along * turn[:, 0]
        return turn @ DOWN, p

    def feed(self, messages: Iterable[Message]) -> list[Refinement]:
        new = [m for message in messages for m in self.smoother.on(message) if isinstance(m, Refinement)]
        self.published += new
        return new

    def prediction(self, i: int, offset_m: tuple[float, float] = (0.0, 0.0), fragment_id: int = 0) -> Prediction:
        r, p = self.pose(i)
        p = p + np.array([*offset_m, 0.0])
        return Prediction(
            t_ns=i * 10**9,
            frame_id=i,
            p_c_in_w_m=(float(p[0]), float(p[1]), float(p[2])),
            q_w_c=quat_from_rot(r),
            cov=flat(tangent_to_world(START_COV, r)),
            agl_m=AGL_M,
            agl_sigma_m=1.0,
            step_m=(0.0, 0.0),
            step_cov_m2=(1.0, 0.0, 0.0, 1.0),
            fragment_id=fragment_id,
        )

    def link(self, i: int, parent: int, fragment_id: int = 0, *, relocalization: bool = False) -> PoseLink:
        (r_a, p_a), (r_b, p_b) = self.pose(parent), self.pose(i)
        between, r = r_a.T @ (p_b - p_a), r_a.T @ r_b
        if not relocalization:
            between, r = (1.0 + self.drift_share) * between, r @ exp_so3(np.array([0.0, 0.0, self.drift_rad]))
        return PoseLink(
            t_ns=i * 10**9,
            frame_id=i,
            parent_id=parent,
            fragment_id=fragment_id,
            p_in_parent_m=(float(between[0]), float(between[1]), float(between[2])),
            q_parent_c=quat_from_rot(r),
            cov=flat(LINK_COV),
            scale_sigma=0.02,
            agl_m=AGL_M,
            relocalization=relocalization,
        )

    def anchor(
        self, i: int, offset_m: tuple[float, float] = (0.0, 0.0), *, map_sigma_m: float = 0.0, hot: bool = False
    ) -> PoseAnchor:
        r, p = self.pose(i)
        p = p + np.array([*offset_m, 0.0])
        return PoseAnchor(
            t_ns=i * 10**9,
            frame_id=i,
            fragment_id=0,
            p_c_in_w_m=(float(p[0]), float(p[1]), float(p[2])),
            q_w_c=quat_from_rot(r),
            cov=flat(ANCHOR_COV),
            map_sigma_m=map_sigma_m,
            covariance_mode=CovarianceMode.JACOBIAN if hot else CovarianceMode.MARGINALS,
        )

    def fly(
        self,
        first: int,
        end: int,
        fragment_id: int = 0,
        *,
        offset_m: tuple[float, float] = (0.0, 0.0),
        goes_on: bool = False,
    ) -> list[Refinement]:
        """Frames first .. end - 1, of one fragment, which begins with ``first`` unless it ``goes_on`` there.
        ``offset_m``: of the predictions from the truth."""
        new = self.feed([self.prediction(first, offset_m, fragment_id)])
        new += self.feed([self.link(first, first - 1, fragment_id)] if goes_on else [])
        for i in range(first + 1, end):
            new += self.feed([self.prediction(i, offset_m, fragment_id), self.link(i, i - 1, fragment_id)])
        return new

    @property
    def refined(self) -> dict[int, RefinedPose]:
        """Newest refined pose of each frame."""
        return {pose.frame_id: pose for message in self.published for pose in message.poses}

    def error_m(self, i: int) -> float:
        """Horizontal error of the newest refined pose of a frame."""
        pose = self.refined[i]
        return float(np.hypot(*(np.array(PLACE.to_local(pose.lat_deg, pose.lon_deg)) - self.pose(i)[1][:2])))
