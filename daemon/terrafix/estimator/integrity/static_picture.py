"""Distinguishes a hovering vehicle from a frozen camera when consecutive images show the same view."""

import math

from terrafix.estimator.measurements.telemetry_buffer import Attitude

# Change of roll or pitch under a static image. An attitude filter of a vehicle at rest drifts less in a minute.
MIN_TILT_CHANGE_RAD = math.radians(1.0)  # [tuned]
# Longest static image in the air [s]. "Static" means below 0.006 degrees; no multirotor holds its attitude that well.
MAX_STATIC_S = 3.0  # [tuned]


class StaticPicture:
    """State of the current run of static images."""

    def __init__(self) -> None:
        self._since_s: float | None = None
        self._attitude: Attitude | None = None  # at the first static image
        self._frozen = False

    def is_frozen(self, t_s: float, attitude: Attitude, *, static: bool, is_moving: bool) -> bool:
        """Whether the camera is frozen at the frame of ``t_s``; if so, until the view changes.

        ``static``: the frame shows the view of the frame before. ``is_moving``: by velocity or inertial readings the
        vehicle cannot stand still."""
        if not static or attitude.stands:
            self._since_s, self._attitude, self._frozen = None, None, False
            return False
        if self._since_s is None or self._attitude is None:
            self._since_s, self._attitude = t_s, attitude
        has_tilted = _tilt_change_rad(self._attitude, attitude) > MIN_TILT_CHANGE_RAD
        self._frozen = self._frozen or is_moving or has_tilted or t_s - self._since_s >= MAX_STATIC_S
        return self._frozen


def _tilt_change_rad(a: Attitude, b: Attitude) -> float:
    """Larger of the differences of roll and pitch; 0 where they are not reported."""
    pairs = ((a.roll_rad, b.roll_rad), (a.pitch_rad, b.pitch_rad))
    return max((abs(y - x) for x, y in pairs if x is not None and y is not None), default=0.0)
