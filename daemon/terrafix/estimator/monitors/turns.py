"""Turns by the image against turns by the attitude: in a mirrored image they have opposite signs."""

import math

from terrafix.estimator.monitors.cusum import COMPARISONS_PER_HOUR, Cusum, threshold

VISUAL_TURN_SIGMA_RAD = math.radians(1.0)  # 1-sigma of a turn between two images [tuned]


class TurnMonitor:
    """``yaw_sigma_rad``: configured 1-sigma of a reported heading; a turn is the difference of two of them."""

    def __init__(self, yaw_sigma_rad: float) -> None:
        self._variance = VISUAL_TURN_SIGMA_RAD**2 + 2.0 * yaw_sigma_rad**2
        self._test = Cusum(threshold(COMPARISONS_PER_HOUR))

    @property
    def mirrored(self) -> bool:
        return self._test.active

    def add(self, reported_rad: float, turned_rad: float) -> None:
        """A turn by the attitude and by the image. H0: they are equal; H1: opposite."""
        self._test.add(-2.0 * reported_rad * turned_rad / self._variance)
