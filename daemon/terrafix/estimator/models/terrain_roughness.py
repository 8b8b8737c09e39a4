"""Roughness of terrain without a DEM, estimated in flight from the ground levels that map matches give."""

import numpy as np

# Candidates for the 1-sigma of the rise of the ground, m per root of a metre: relief is close to a random walk
# (Turcotte 1997, "Fractals and Chaos in Geology and Geophysics", ch. 7). Over a kilometre 10, 32 and 95 m: gentle
# country, hills, mountains. [tuned]
ROUGHNESS_CANDIDATES = np.array([0.3, 1.0, 3.0])
PRIOR = np.array([0.35, 0.5, 0.15])  # of the candidates, at the start and again after FORGOTTEN_M [tuned]
FORGOTTEN_M = 1000.0  # distance over which the weights return to the prior: hills begin at the end of a plain [tuned]
# Least distance between two levels, in heights: a frame shows about that much ground, and levels of the same ground
# share their errors. Over less, relief is smoother than the random walk (breaks of scale: Mark and Aronson 1984,
# "Scale-dependent fractal dimensions of topographic surfaces"), and rises by less than the error of a match: hills
# would be taken for plains. [tuned]
ROUGHNESS_SPACING_HEIGHTS = 1.0


class TerrainRoughness:
    """Multiple model estimation: a Kalman filter of the ground level per candidate, weighted by likelihood (Magill
    1965, "Optimal adaptive estimation of sampled stochastic processes")."""

    def __init__(self) -> None:
        self._weights = PRIOR
        self._level_m = np.zeros(len(ROUGHNESS_CANDIDATES))
        self._var_m2 = np.full(len(ROUGHNESS_CANDIDATES), np.inf)
        self._at_m: np.ndarray | None = None  # of the last level

    @property
    def walk_sigma(self) -> float:
        """1-sigma of the rise, m per root of a metre, marginal over the candidates."""
        return float(np.sqrt(self._weights @ ROUGHNESS_CANDIDATES**2))

    def update(self, at_m: np.ndarray, height_m: float, level_m: float, sigma_m: float) -> None:
        """Ground level ``level_m``, from any datum, with 1-sigma ``sigma_m``, below ``at_m`` (east, north), seen from
        ``height_m``."""
        distance_m = 0.0 if self._at_m is None else float(np.hypot(*(at_m - self._at_m)))
        if self._at_m is not None and distance_m < ROUGHNESS_SPACING_HEIGHTS * height_m:
            return
        self._at_m = at_m
        var_m2 = self._var_m2 + ROUGHNESS_CANDIDATES**2 * distance_m
        innovation_var = var_m2 + sigma_m**2
        innovation_m = level_m - self._level_m
        if np.isfinite(innovation_var).all():
            weights = self._weights * np.exp(-0.5 * innovation_m**2 / innovation_var) / np.sqrt(innovation_var)
            retained = float(np.exp(-distance_m / FORGOTTEN_M)) if weights.sum() > 0.0 else 0.0
            self._weights = retained * weights / max(weights.sum(), 1e-300) + (1.0 - retained) * PRIOR
        gain = 1.0 / (1.0 + sigma_m**2 / var_m2)
        self._level_m = self._level_m + gain * innovation_m
        self._var_m2 = gain * sigma_m**2
