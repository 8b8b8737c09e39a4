"""How rugged the ground is that no DEM tells, learnt in flight from the heights above it that map matches give."""

import numpy as np

# 1-sigma by which ground rises for the root of a metre of way: relief is close to a random walk (Turcotte 1997,
# "Fractals and Chaos in Geology and Geophysics", ch. 7). Over a kilometre 10, 32 and 95 m: gentle country, hills,
# mountains; and how likely each is before anything was seen, and again where hills begin at the end of a plain.
CANDIDATES = np.array([0.3, 1.0, 3.0])
PRIOR = np.array([0.35, 0.5, 0.15])
FORGOTTEN_M = 1000.0
# Of the height: a frame shows about so much ground, and levels of the same ground share their errors. Over less, relief
# is smoother than that walk (it has breaks of scale: Mark and Aronson 1984, "Scale-dependent fractal dimensions of
# topographic surfaces"), and rises by less than a match gets wrong: hills would be taken for plains.
APART = 1.0


class TerrainRoughness:
    """A Kalman filter of the level of the ground for each candidate, weighted by how well it foretold the levels
    (multiple model adaptive estimation; Magill 1965, "Optimal adaptive estimation of sampled stochastic processes")."""

    def __init__(self) -> None:
        self._weights = PRIOR
        self._level_m = np.zeros(len(CANDIDATES))
        self._var_m2 = np.full(len(CANDIDATES), np.inf)
        self._at_m: np.ndarray | None = None  # of the last level

    @property
    def rise(self) -> float:
        """1-sigma, metres for the root of a metre, with what is open between the candidates."""
        return float(np.sqrt(self._weights @ CANDIDATES**2))

    def measured(self, at_m: np.ndarray, height_m: float, level_m: float, sigma_m: float) -> None:
        """The level of the ground below ``at_m`` (east, north), seen from this height; any zero will do."""
        way_m = 0.0 if self._at_m is None else float(np.hypot(*(at_m - self._at_m)))
        if self._at_m is not None and way_m < APART * height_m:
            return
        self._at_m = at_m
        var_m2 = self._var_m2 + CANDIDATES**2 * way_m
        expected = var_m2 + sigma_m**2
        off_m = level_m - self._level_m
        if np.isfinite(expected).all():
            weights = self._weights * np.exp(-0.5 * off_m**2 / expected) / np.sqrt(expected)
            kept = float(np.exp(-way_m / FORGOTTEN_M)) if weights.sum() > 0.0 else 0.0
            self._weights = kept * weights / max(weights.sum(), 1e-300) + (1.0 - kept) * PRIOR
        gain = 1.0 / (1.0 + sigma_m**2 / var_m2)
        self._level_m = self._level_m + gain * off_m
        self._var_m2 = gain * sigma_m**2
