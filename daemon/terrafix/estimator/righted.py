"""How much farther off the autopilot's attitude may be than is said of it: by how much it was put right lately.

An attitude that turns otherwise than the gyroscopes felt is being corrected: by gravity, by the compass, and by what we
tell the autopilot of its motion. In flight that is a tenth of a degree a second. A plane whose filter had been without
a position in a turn (ArduPilot's firmware) was put right by 1 to 5 degrees a second when one came back: from an
attitude that sways so, pictures tell of a velocity that nobody flies, the autopilot believes it, and sways by it. What
was sent claimed 0.5 m/s and was 10 m/s off. Who says how far the attitude moved by itself is not believed so."""

import math
from collections import deque

import numpy as np

from terrafix.estimator.telemetry import Telemetry
from terrafix.estimator.velocity import TILT_S

# What gyroscopes are off by hours after their calibration (InvenSense DS-000347: 0.005 degrees a second for each degree
# of temperature): so much of a turn nobody has put right.
GYROSCOPE_RADPS = math.radians(0.2)


class Righted:
    """``rad`` at every frame, in order of time."""

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._lately: deque[tuple[float, np.ndarray]] = deque()  # seconds, tilt (2,) by which it was put right since

    def rad(self, t_ns: int, said: Telemetry, sigma_rad: float) -> float:
        """1-sigma of the tilt, besides the ``sigma_rad`` (each axis) that is said of it: the farthest that it was put
        right within TILT_S, less what two attitudes that are off by that differ by."""
        since_ns, self._last_ns = self._last_ns, t_ns
        apart = None if since_ns is None else said.turned_otherwise(since_ns, t_ns)
        if since_ns is not None and apart is not None:
            self._lately.append((since_ns * 1e-9, np.zeros(2)))
            for _, turned in self._lately:
                turned += apart
        now_s = t_ns * 1e-9
        while self._lately and now_s - self._lately[0][0] > TILT_S:
            self._lately.popleft()
        unfelt = (float(np.hypot(*turned)) - GYROSCOPE_RADPS * (now_s - since_s) for since_s, turned in self._lately)
        farthest_rad = max(0.0, max(unfelt, default=0.0))
        return math.sqrt(max(0.0, farthest_rad**2 - 4.0 * sigma_rad**2))
