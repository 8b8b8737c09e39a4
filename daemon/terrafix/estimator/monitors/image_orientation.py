"""Images that are turned by quarter turns, or mirrored, against the description of the camera.

A camera that restarts may come back with another setting of rotation or flip, and its images agree with each other as
before. What contradicts it is the motion that they show, against the velocity that inertial sensors carry on, and in
mirrored ones the turns, against the reported heading. One CUSUM for each of the seven ways, against upright images."""

import math
from dataclasses import dataclass
from itertools import product

import msgspec
import numpy as np

from terrafix.estimator.monitors.cusum import MAX_STEP, Cusum, threshold
from terrafix.estimator.monitors.inertial import FIT_MEMORY, MIN_LOG_LIKELIHOOD
from terrafix.messages import Odometry

FRAMES_PER_HOUR = 36_000.0  # [spec: ten frames a second]


@dataclass(frozen=True)
class Orientation:
    """``turned_deg``: of the images, about the optical axis, clockwise as the mount yaw of the camera counts it;
    ``mirrored``: left and right are exchanged before that."""

    turned_deg: int
    mirrored: bool = False

    @property
    def quantity(self) -> str:
        """Name of the fault."""
        if self.mirrored:
            return "picture mirrored"
        return "picture upside down" if self.turned_deg == 180 else "picture turned"

    @property
    def detail(self) -> str:
        """Evidence of the fault, and what to set."""
        seen = "the images move against the velocity of the inertial sensors as if"
        if self.mirrored:
            return f"{seen} mirrored: switch off the flip of the camera"
        return f"{seen} turned: set the rotation of the camera back, or add {self.turned_deg} to mount yaw_deg"

    @property
    def matrix(self) -> np.ndarray:
        """(2, 2): normalised coordinates of the image that the description expects, from those of the image."""
        turn = math.radians(self.turned_deg)
        c, s = math.cos(turn), math.sin(turn)
        return np.array([[c, -s], [s, c]]) @ np.diag([-1.0 if self.mirrored else 1.0, 1.0])

    def righted(self, odometry: Odometry) -> Odometry:
        """``odometry``, whose pairs are those of upright images."""
        pairs = np.array(odometry.two_view).reshape(-1, 2) @ self.matrix.T
        return msgspec.structs.replace(odometry, two_view=[tuple(row) for row in pairs.reshape(-1, 4).tolist()])


# [spec: symmetries of a square but for the identity]
ORIENTATIONS = tuple(
    Orientation(deg, mirrored) for mirrored, deg in product((False, True), (0, 90, 180, -90)) if mirrored or deg
)


class OrientationMonitor:
    """``refuses``: the fault is active, and the newest frame shows it, so that the map can tell nothing of it."""

    def __init__(self) -> None:
        limit = threshold(FRAMES_PER_HOUR, len(ORIENTATIONS))
        self._tests = {orientation: Cusum(limit) for orientation in ORIENTATIONS}
        self._fits = dict.fromkeys(ORIENTATIONS, 0.0)  # of the last frames: select among active tests [nats]
        self.refuses = False

    @property
    def fault(self) -> Orientation | None:
        """The most likely of the orientations whose alarm is active; None: none is."""
        active = [orientation for orientation, test in self._tests.items() if test.active]
        return max(active, key=self._fits.__getitem__, default=None)

    @property
    def suspects(self) -> bool:
        """Whether there is more evidence for one of them than for upright images."""
        return any(test.sum > 0.0 for test in self._tests.values())

    def add(self, upright: float, others: dict[Orientation, float | None]) -> None:
        """Log likelihoods of one frame's motion by upright images and by each orientation [nats]; None: it gives
        none."""
        for orientation, test in self._tests.items():
            likelihood = others[orientation]
            other = MIN_LOG_LIKELIHOOD if likelihood is None else max(likelihood, MIN_LOG_LIKELIHOOD)
            test.add(-MAX_STEP if likelihood is None else other - max(upright, MIN_LOG_LIKELIHOOD))
            self._fits[orientation] = FIT_MEMORY * self._fits[orientation] + other
        fault = self.fault
        shown = None if fault is None else others[fault]
        self.refuses = shown is not None and shown > upright
