"""How fast a flight may go on while nobody sees it."""

import numpy as np

TYPICAL_SPEED_MPS = 10.0  # of one that has not been seen to fly
CRUISE_S = 300.0  # a flight that hovers for minutes may go on as fast as before


class SpeedPrior:
    """``mps``: of the flight as it was seen last, or as it cruised before: one that hovers is about to fly on."""

    def __init__(self) -> None:
        self.mps = self._cruise_mps = TYPICAL_SPEED_MPS
        self._seen_s: float | None = None

    def seen(self, t_s: float, velocity_mps: np.ndarray, cov: np.ndarray) -> None:
        """``velocity_mps`` (3,) in the world, ``cov`` (3, 3), of the frame at ``t_s``, by odometry."""
        speed2, variance = float(velocity_mps[:2] @ velocity_mps[:2]), float(np.trace(cov[:2, :2]))
        for_sure_mps = float(np.sqrt(speed2) - np.sqrt(variance))
        since_s = 0.0 if self._seen_s is None else t_s - self._seen_s
        self._seen_s = t_s
        self._cruise_mps = max(self._cruise_mps * float(np.exp(-since_s / CRUISE_S)), for_sure_mps)
        self.mps = max(float(np.sqrt(speed2 + variance)), self._cruise_mps)

    def fixed(self, t_s: float, velocity_mps: np.ndarray, cov: np.ndarray) -> None:
        """The same, with what a map match added: all that there is where photos do not overlap. The first one leaves
        the velocity as it was, anything, and tells nothing."""
        if float(np.trace(cov[:2, :2])) < self.mps**2:
            self.seen(t_s, velocity_mps, cov)
