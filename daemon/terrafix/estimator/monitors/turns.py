"""Turns that pictures show against turns of the attitude: a mirrored picture turns the other way."""

import math

from terrafix.estimator.monitors.cusum import Cusum, threshold

STEPS_PER_HOUR = 3600.0  # at most one keyframe a second
SEEN_RAD = math.radians(1.0)  # 1-sigma of a turn between two pictures


class TurnMonitor:
    """``yaw_sigma_rad``: of the attitude's heading as described; two of them make a turn."""

    def __init__(self, yaw_sigma_rad: float) -> None:
        self._variance = SEEN_RAD**2 + 2.0 * yaw_sigma_rad**2
        self._test = Cusum(threshold(STEPS_PER_HOUR))

    @property
    def mirrored(self) -> bool:
        return self._test.active

    def add(self, said_rad: float, turned_rad: float) -> None:
        """A turn by the attitude, and as pictures show it: the same, or the opposite if they are mirrored."""
        self._test.add(-2.0 * said_rad * turned_rad / self._variance)
