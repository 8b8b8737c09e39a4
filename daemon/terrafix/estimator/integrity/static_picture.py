"""Distinguishes a hovering vehicle from a frozen camera when consecutive images show the same view."""

import math

import numpy as np

from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.messages import Odometry, Verdict

# Change of roll or pitch under a static image. An attitude filter of a vehicle at rest drifts less in a minute.
MIN_TILT_CHANGE_RAD = math.radians(1.0)  # [tuned]
# Longest static image in the air [s]. "Static" means below 0.006 degrees; no multirotor holds its attitude that well.
MAX_STATIC_S = 3.0  # [tuned]

MIN_MATCHES = 8  # for an affine map between two images [spec: of plane_motion.MIN_PAIRS]
# 1-sigma of a matched coordinate: images whose matches moved by less on average show the same view to the tracker,
# as those of a frozen picture do that an encoder or a stabiliser shifts from frame to frame.
UNCHANGED_SIGMAS = 3.0  # [spec: three sigmas]


class ViewChange:
    """Whether the view of a frame is that of the frame before, as far as the tracker can tell."""

    def __init__(self) -> None:
        self._before: Odometry | None = None
        self._image: np.ndarray | None = None  # (3, 2): of the frame before, from its keyframe

    def is_unchanged(self, odometry: Odometry) -> bool:
        """``odometry``: of each frame in turn. False also where the two have no keyframe in common."""
        before, image, self._before, self._image = self._before, self._image, odometry, None
        if odometry.verdict is not Verdict.ACCEPTED or len(odometry.two_view) < MIN_MATCHES:
            return False
        pairs = np.array(odometry.two_view)
        keyframe = np.column_stack([pairs[:, :2], np.ones(len(pairs))])
        self._image = np.linalg.lstsq(keyframe, pairs[:, 2:], rcond=None)[0]
        if before is None:
            return False
        if odometry.keyframe_id == before.frame_id:
            moved = pairs[:, 2:] - pairs[:, :2]
        elif odometry.keyframe_id == before.keyframe_id and image is not None:
            moved = keyframe @ (self._image - image)
        else:
            return False
        return float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))) <= UNCHANGED_SIGMAS * odometry.sigma_norm


class StaticPicture:
    """State of the current run of static images."""

    def __init__(self) -> None:
        self.since_s: float | None = None  # time of the first static image of the run; None: the view has changed
        self._attitude: Attitude | None = None  # at the first static image
        self._frozen = False

    @property
    def is_repeating(self) -> bool:
        """The newest image was one of a frozen camera."""
        return self._frozen

    def is_frozen(self, t_s: float, attitude: Attitude, *, static: bool, is_moving: bool) -> bool:
        """Whether the camera is frozen at the frame of ``t_s``; if so, until the view changes.

        ``static``: the frame shows the view of the frame before. ``is_moving``: by velocity or inertial readings the
        vehicle cannot stand still."""
        if not static or attitude.stands:
            self.since_s, self._attitude, self._frozen = None, None, False
            return False
        if self.since_s is None or self._attitude is None:
            self.since_s, self._attitude = t_s, attitude
        has_tilted = _tilt_change_rad(self._attitude, attitude) > MIN_TILT_CHANGE_RAD
        self._frozen = self._frozen or is_moving or has_tilted or t_s - self.since_s >= MAX_STATIC_S
        return self._frozen


def _tilt_change_rad(a: Attitude, b: Attitude) -> float:
    """Larger of the differences of roll and pitch; 0 where they are not reported."""
    pairs = ((a.roll_rad, b.roll_rad), (a.pitch_rad, b.pitch_rad))
    return max((abs(y - x) for x, y in pairs if x is not None and y is not None), default=0.0)
