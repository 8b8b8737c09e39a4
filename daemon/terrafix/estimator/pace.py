"""How fast a flight may go on while nobody sees it."""

import numpy as np

TYPICAL_SPEED_MPS = 10.0  # of one that has not been seen to fly
CRUISE_S = 300.0  # a flight that hovers for minutes may go on as fast as before


class Pace:
    """``mps``: of the flight as it was seen last, or as it cruised before: one that hovers is about to fly on."""

    def __init__(self) -> None:
        self.mps = self._cruise_mps = TYPICAL_SPEED_MPS

    def seen(self, velocity_mps: np.ndarray, cov: np.ndarray, dt_s: float) -> None:
        """``velocity_mps`` (3,) in the world, ``cov`` (3, 3); ``dt_s`` since the frame before."""
        speed2, variance = float(velocity_mps[:2] @ velocity_mps[:2]), float(np.trace(cov[:2, :2]))
        for_sure_mps = float(np.sqrt(speed2) - np.sqrt(variance))
        self._cruise_mps = max(self._cruise_mps * float(np.exp(-dt_s / CRUISE_S)), for_sure_mps)
        self.mps = max(float(np.sqrt(speed2 + variance)), self._cruise_mps)
