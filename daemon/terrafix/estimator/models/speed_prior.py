"""Prior of the ground speed for dead reckoning without odometry."""

import numpy as np

from terrafix.estimator.state import HORIZONTAL

TYPICAL_SPEED_MPS = 10.0  # speed of a vehicle that has not been seen to fly [tuned]
CRUISE_MEMORY_S = 300.0  # a vehicle that hovers for minutes may continue at its former speed [tuned]


class SpeedPrior:
    """``speed_mps``: the larger of the last observed speed and of the decayed cruise speed, because a hovering vehicle
    may fly on."""

    def __init__(self) -> None:
        self.speed_mps = self._cruise_mps = TYPICAL_SPEED_MPS
        self._updated_s: float | None = None

    def update(self, t_s: float, velocity_mps: np.ndarray, cov: np.ndarray) -> None:
        """``velocity_mps`` (3,) in the world with ``cov`` (3, 3), of the frame at ``t_s``, from odometry."""
        speed2 = float(velocity_mps[HORIZONTAL] @ velocity_mps[HORIZONTAL])
        variance = float(np.trace(cov[HORIZONTAL, HORIZONTAL]))
        lower_mps = float(np.sqrt(speed2) - np.sqrt(variance))
        elapsed_s = 0.0 if self._updated_s is None else t_s - self._updated_s
        self._updated_s = t_s
        self._cruise_mps = max(self._cruise_mps * float(np.exp(-elapsed_s / CRUISE_MEMORY_S)), lower_mps)
        self.speed_mps = max(float(np.sqrt(speed2 + variance)), self._cruise_mps)

    def update_by_map(self, t_s: float, velocity_mps: np.ndarray, cov: np.ndarray) -> None:
        """The same with a velocity that a map match has corrected, the only source where photos do not overlap. The
        first map match leaves the velocity unknown and is ignored."""
        if float(np.trace(cov[HORIZONTAL, HORIZONTAL])) < self.speed_mps**2:
            self.update(t_s, velocity_mps, cov)
