"""Reported heights and headings against those of camera poses on the map."""

import math

from terrafix.estimator.monitors.cusum import Cusum, threshold

POSES_PER_HOUR = 3600.0  # 1/h: at most one pose a second counts for the false alarm rate [tuned]
# Allowed constant error, in its configured 1-sigmas.
ALLOWED_SIGMAS = 3.0  # [spec: 0.3 % of correct descriptions are beyond 3 sigmas]
HEIGHT_NOISE = 0.05  # 1-sigma of one pose's height, share of it [tuned]
FIRST_POSES = 5  # [spec: two seconds at 2 Hz: shorter than a zoom that is seen by nothing else]
# 1-sigma by which the ratio of the two changes in flight: the elevation of the map, and a barometer that drifts, by
# 2 m each over 110 m [spec: of a Copernicus DEM, and of an hour of weather]
HEIGHT_CHANGE_SIGMA = 0.025
# 1-sigma of one pose's height over one kind of ground, share of it
HEIGHT_CHANGE_NOISE = 0.025  # [measured: docs/decisions/059-images-against-inertial-sensors.md]


class OffsetMonitor:
    """CUSUM of one reported quantity less that of map poses. ``sigma``: 1-sigma of its constant error as configured;
    ``noise``: 1-sigma of one pose."""

    def __init__(self, sigma: float, noise: float) -> None:
        self._allowed, self._noise = ALLOWED_SIGMAS * sigma, noise
        self._test = Cusum(threshold(POSES_PER_HOUR))
        self.mean = 0.0

    @property
    def active(self) -> bool:
        return self._test.active

    def add(self, offset: float) -> None:
        """Reported less observed. H1: an error of 2 noise sigmas beyond the allowed one; H0: the allowed error."""
        excess = (abs(offset) - self._allowed) / self._noise
        self._test.add(2.0 * (excess - 1.0))  # log ratio of N(allowed + 2 noise, noise^2) and N(allowed, noise^2)
        self.mean += 0.2 * (offset - self.mean) if self.mean else offset


def log_height_ratio(reported_m: float, observed_m: float) -> float:
    """Logarithm of the ratio of two heights above the ground below."""
    return math.log(max(reported_m, 1.0) / max(observed_m, 1.0))


class ChangeMonitor(OffsetMonitor):
    """Of a quantity less that of the first poses, which moves with the weather within an hour: a constant error is no
    change."""

    def __init__(self, sigma: float, noise: float) -> None:
        super().__init__(sigma, noise)
        self._usual, self._poses = 0.0, 0

    def add(self, offset: float) -> None:
        self._poses += 1
        gain = 1.0 / (self._poses if self._poses <= FIRST_POSES else POSES_PER_HOUR)
        self._usual += gain * (offset - self._usual)
        super().add(offset - self._usual)
