"""The anchor's belief over the map while the place of the frame lies outside of the window of the prediction.

The point-mass filter is that of the anchor. Its correlation surfaces are noise, with the peak of the true place where
heading, scale and tilt are within the range that the anchor searches."""

import math

import numpy as np

from terrafix.anchor.localizer import (
    MIN_OBSERVATION_WEIGHT,
    NEW_GROUND_SHARE,
    initial_belief,
    predict_belief,
)
from terrafix.anchor.matching.point_mass_filter import MODE_RADIUS_CELLS, Belief, Mode, Surface, belief_cell_m
from terrafix.anchor.matching.predicted_view import VAR_E, VAR_N, VAR_STEP_E, VAR_STEP_N, position_sigma_m
from terrafix.messages import Prediction

# Cells of the noise, in cells of the belief: the best of a window of 260 cells then has a correlation of 3.2 in the
# median; on real imagery it is 3.0 (anchor/matching/point_mass_filter.py).
NOISE_CELLS = 8
NOISE_SIDE = 189  # cells of the noise: the largest window of the belief
PEAK_CELLS = 1.0  # 1-sigma of the peak of the true place, in cells of the belief
REPORTED_MODES = 2


class TrackedBelief:
    """``update`` with every prediction of a frame that is not found near it."""

    def __init__(self, prediction: Prediction, footprint_m: float, *, at_start: bool, rng: np.random.Generator) -> None:
        """``at_start``: no frame of the flight was found before. ``footprint_m``: side of the ground in the picture."""
        e_m, n_m, _ = prediction.p_c_in_w_m
        cell_m = belief_cell_m(prediction.agl_m, 0.0)
        sigma_m = max(position_sigma_m(prediction), cell_m)
        self._belief = initial_belief(prediction, cell_m)[0] if at_start else Belief(e_m, n_m, sigma_m, cell_m)
        self._footprint_m, self._rng = footprint_m, rng
        self._noise = rng.normal(size=(NOISE_SIDE, NOISE_SIDE))
        self._variance_m2 = _variance_m2(prediction)
        self._fresh = True  # the first observation counts in full

    @property
    def belief(self) -> Belief:
        return self._belief

    def update(self, prediction: Prediction, place_m: np.ndarray | None, score: float) -> list[Mode]:
        """``place_m`` (2,): apparent position of the camera, with a correlation of ``score``; None: heading, scale or
        tilt are out of range. -> the heaviest modes."""
        new = self._predict(prediction)
        cell_m = self._belief.cell_m
        kept = math.sqrt(1.0 - new)  # the same ground gives the same surface
        self._noise = kept * self._noise + math.sqrt(new) * self._rng.normal(size=self._noise.shape)
        e_m, n_m = self._belief.centre
        half_m = NOISE_SIDE // 2 * NOISE_CELLS * cell_m
        surfaces = [Surface(self._noise, e_m - half_m, n_m + half_m, NOISE_CELLS * cell_m)]
        if place_m is not None:
            surfaces.append(_peak(place_m, score, cell_m))
        self._belief.update(tuple(surfaces), max(new, MIN_OBSERVATION_WEIGHT))
        return self._belief.modes(REPORTED_MODES)

    def is_at(self, mode: Mode, place_m: np.ndarray | None) -> bool:
        """Whether ``mode`` is the true place."""
        if place_m is None:
            return False
        off_m = float(np.hypot(mode.e_m - place_m[0], mode.n_m - place_m[1]))
        return off_m <= MODE_RADIUS_CELLS * self._belief.cell_m

    def _predict(self, prediction: Prediction) -> float:
        """-> share 0..1 of new ground."""
        if self._fresh:
            self._fresh = False
            return 1.0
        step_m2 = max(prediction.step_cov_m2[VAR_STEP_E], prediction.step_cov_m2[VAR_STEP_N])
        growth_m2, self._variance_m2 = _variance_m2(prediction) - self._variance_m2, _variance_m2(prediction)
        sigma_m = math.sqrt(max(step_m2, growth_m2))
        predict_belief(self._belief, prediction, sigma_m, belief_cell_m(prediction.agl_m, 0.0))
        moved_m = math.hypot(*prediction.step_m, sigma_m)
        return min(moved_m / (NEW_GROUND_SHARE * self._footprint_m), 1.0)


def _variance_m2(prediction: Prediction) -> float:
    return max(prediction.cov[VAR_E], prediction.cov[VAR_N])


def _peak(place_m: np.ndarray, score: float, cell_m: float) -> Surface:
    """The surface around the true place: ``score`` there, unknown beyond a few cells."""
    axis = np.arange(-4, 5)
    r2 = (axis[:, None] ** 2 + axis[None, :] ** 2) / PEAK_CELLS**2
    z = np.where(r2 <= 16.0, score * np.exp(-0.5 * r2), np.nan)
    return Surface(z, float(place_m[0]) - 4 * cell_m, float(place_m[1]) + 4 * cell_m, cell_m)
