"""Point-mass filter on a grid of horizontal camera positions.

The update multiplies the mass by the likelihood of the frame's whole correlation surface; the prediction shifts and
blurs it by odometry. All position hypotheses are kept until the frames discriminate between them (Bergman, "Recursive
Bayesian estimation: navigation and tracking applications", 1999, ch. 5).
"""

from dataclasses import dataclass

import cv2
import numpy as np

from terrafix.core.agreement import NATS_PER_SCORE

# Standardised correlation z at which the log likelihood ratio "here against elsewhere" is zero; its slope is
# NATS_PER_SCORE. [measured: core/agreement.py]
BELIEF_LLR_ZERO_Z = 1.9
BELIEF_LLR_MIN, BELIEF_LLR_MAX = -3.0, 9.0  # bounds of the log likelihood ratio of one frame [tuned]
# share of the mass that a full observation redistributes uniformly over the window, so that no position is excluded
# [tuned]
LEAK = 0.004
BELIEF_CELL_PER_AGL = 1 / 50  # belief cell as a share of the height: 2 m at 100 m, two cells of the correlation [tuned]
MIN_CELL_M = 1.0  # metres [tuned]
# smallest half width of the window, cells, so that the next position error still lies inside [tuned]
MIN_HALF_CELLS = 60
MAX_HALF_CELLS = 750  # largest half width of the window, cells; bounds time and memory [tuned]
MARGIN_CELLS = 30  # cells of the window beyond three (when fitted) or four (at the start) sigmas of the belief [tuned]
WIDE_BLUR_CELLS = 6.0  # sigma in cells above which the blur is computed at a lower resolution [tuned]
MODE_RADIUS_CELLS = 7  # radius around a peak whose mass is one mode [tuned]


def belief_cell_m(agl_m: float, correlation_cell_m: float) -> float:
    """Size of a belief cell in metres, in octaves: a share of the height, not finer than the correlation's cells."""
    wanted = max(agl_m * BELIEF_CELL_PER_AGL, correlation_cell_m, MIN_CELL_M)
    return float(2.0 ** round(np.log2(wanted)))


@dataclass(frozen=True)
class Mode:
    e_m: float
    n_m: float
    mass: float
    second_mass: float  # largest mass of another mode
    var_m2: float  # variance of the position within the mode, per axis


@dataclass(frozen=True)
class Surface:
    """``z`` (H, W): standardised correlation with the camera at east e0_m + c cell_m, north n0_m - r cell_m; NaN =
    unknown. ``unmapped`` (H, W): no feature is mapped there, so that ``z`` is no evidence; None: all is mapped."""

    z: np.ndarray
    e0_m: float
    n0_m: float
    cell_m: float
    unmapped: np.ndarray | None = None

    def best(self, e_m: float, n_m: float, radius_m: float) -> tuple[float, float, float]:
        """Highest value within ``radius_m`` of a position, and its east and north; -9 outside of the surface."""
        r, c = (self.n0_m - n_m) / self.cell_m, (e_m - self.e0_m) / self.cell_m
        k = max(radius_m / self.cell_m, 1.0)
        rows = slice(max(round(r - k), 0), max(round(r + k) + 1, 0))
        columns = slice(max(round(c - k), 0), max(round(c + k) + 1, 0))
        near = np.nan_to_num(self.z[rows, columns], nan=-9.0)
        if not near.size:
            return -9.0, e_m, n_m
        dr, dc = np.unravel_index(int(np.argmax(near)), near.shape)
        there_e_m = self.e0_m + (columns.start + int(dc)) * self.cell_m
        return float(near[dr, dc]), there_e_m, self.n0_m - (rows.start + int(dr)) * self.cell_m

    def at(self, e_m: float, n_m: float, radius_m: float) -> float:
        """Highest value within ``radius_m`` of a position; -9 outside of the surface."""
        return self.best(e_m, n_m, radius_m)[0]

    def is_mapped(self, e_m: float, n_m: float) -> bool:
        """Whether a feature is mapped at the cell of a position; True outside of the surface."""
        if self.unmapped is None:
            return True
        r, c = round((self.n0_m - n_m) / self.cell_m), round((e_m - self.e0_m) / self.cell_m)
        inside = 0 <= r < self.unmapped.shape[0] and 0 <= c < self.unmapped.shape[1]
        return not (inside and self.unmapped[r, c])


class Belief:
    """Probability mass over horizontal camera positions (local east, north). The grid moves with the camera, so that a
    motion needs no resampling."""

    def __init__(
        self, e_m: float, n_m: float, sigma_m: float, cell_m: float, uniform_share: float = 0.0, min_half_m: float = 0.0
    ) -> None:
        """Normal density with ``sigma_m`` per axis. The share ``uniform_share`` of the mass is uniform over the window,
        whose half width is at least ``min_half_m`` until ``confirm``."""
        self._min_half_m = min_half_m
        self.cell_m = cell_m
        half = min(max(4.0 * sigma_m / cell_m + MARGIN_CELLS, MIN_HALF_CELLS, min_half_m / cell_m), MAX_HALF_CELLS)
        cells = 2 * int(np.ceil(half)) + 1
        self._e0 = e_m - (cells // 2) * self.cell_m  # east of column 0
        self._n0 = n_m + (cells // 2) * self.cell_m  # north of row 0
        axis = (np.arange(cells) - cells // 2) * self.cell_m
        log = -0.5 * (axis**2) / sigma_m**2
        normal = np.exp(log[:, None] + log[None, :])
        self._mass = (1.0 - uniform_share) * normal / normal.sum() + uniform_share / normal.size

    def predict(self, east_m: float, north_m: float, sigma_m: float) -> None:
        """Prediction by odometry: shifts by the step and blurs by its 1-sigma."""
        self._e0 += east_m
        self._n0 += north_m
        cells = min(sigma_m / self.cell_m, MAX_HALF_CELLS / 3)
        if cells * 6 > len(self._mass) // 2:
            self._resize(4.0 * cells + len(self._mass) // 2)
        if cells > 0.05:
            self._mass = np.maximum(_blurred(self._mass, cells), 0.0)
            self._mass /= self._mass.sum()

    def update(self, surfaces: tuple[Surface, ...], weight: float) -> float:
        """Measurement update with the surfaces of one frame, one per rotation and scale; the best hypothesis counts in
        each cell. ``weight`` 0..1: share of new ground (a second observation of the same ground is not independent).

        -> evidence [nats]: log likelihood ratio "the camera is distributed as the belief says, against elsewhere".
        """
        llr = self._log_likelihood(surfaces[0])
        for surface in surfaces[1:]:  # one at a time: a wide window with many yaw hypotheses would need a gigabyte
            np.maximum(llr, self._log_likelihood(surface), out=llr)
        self._mass = self._mass * np.exp(weight * llr)
        total = float(self._mass.sum())
        self._mass /= total
        leak = LEAK * weight
        self._mass = (1 - leak) * self._mass + leak / self._mass.size
        return float(np.log(total))

    def _log_likelihood(self, surface: Surface) -> np.ndarray:
        """Log likelihood ratio of a surface on the belief's grid; unknown cells count slightly worse than random
        alignment."""
        z = np.nan_to_num(surface.z, nan=-9.0).astype(np.float32)
        if surface.cell_m < self.cell_m:  # a coarse cell takes the maximum of the finer ones
            k = int(np.ceil(self.cell_m / surface.cell_m)) | 1
            z = cv2.dilate(z, np.ones((k, k), np.uint8))
        axis = np.arange(len(self._mass)) * self.cell_m
        map_x, map_y = np.meshgrid(
            ((self._e0 - surface.e0_m + axis) / surface.cell_m).astype(np.float32),
            ((surface.n0_m - self._n0 + axis) / surface.cell_m).astype(np.float32),
        )
        here = cv2.remap(z, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=-9.0)
        return log_likelihood_ratio(here)

    def mode(self) -> Mode:
        """The heaviest mode: centroid and mass within MODE_RADIUS_CELLS, and the mass of the second one."""
        return self.modes(1)[0]

    def modes(self, count: int) -> list[Mode]:
        """The ``count`` heaviest modes, at least two mode radii apart."""
        radius = MODE_RADIUS_CELLS
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)).astype(np.float64)
        gathered = cv2.filter2D(self._mass, -1, disc, borderType=cv2.BORDER_CONSTANT)
        modes = []
        remaining = gathered.copy()
        for _ in range(count):
            r, c = (int(v) for v in np.unravel_index(int(np.argmax(remaining)), remaining.shape))
            modes.append(self._mode_at(r, c, gathered))
            remaining[self._around(r, c)] = 0.0
        return modes

    def _around(self, r: int, c: int) -> tuple[slice, slice]:
        """Rows and columns within two mode radii of a cell."""
        reach = 2 * MODE_RADIUS_CELLS
        return slice(max(r - reach, 0), r + reach + 1), slice(max(c - reach, 0), c + reach + 1)

    def _mode_at(self, r: int, c: int, gathered: np.ndarray) -> Mode:
        """``gathered``: mass within MODE_RADIUS_CELLS of each cell. Only cells around the mode are visited: passes over
        a belief of a kilometre take longer than its correlation."""
        around = self._around(r, c)
        held = self._mass[around]
        rows, columns = np.ogrid[: held.shape[0], : held.shape[1]]
        rows, columns = rows + around[0].start, columns + around[1].start
        distance2 = (rows - r) ** 2 + (columns - c) ** 2
        near = np.where(distance2 <= MODE_RADIUS_CELLS**2, held, 0.0)
        mass = float(near.sum())
        e_m = self._e0 + float((near * columns).sum()) / mass * self.cell_m
        n_m = self._n0 - float((near * rows).sum()) / mass * self.cell_m
        var = float((near * distance2).sum()) / mass / 2 * self.cell_m**2
        of_mode = gathered[around].copy()
        gathered[around][distance2 <= (2 * MODE_RADIUS_CELLS) ** 2] = 0.0
        second_mass = float(gathered.max())
        gathered[around] = of_mode
        return Mode(e_m, n_m, min(mass, 1.0), second_mass, var)

    def confirm(self, mode: Mode, likelihood_ratio: float) -> None:
        """Multiplies the mass within the mode by the likelihood ratio of independent evidence that the camera is
        there."""
        self._min_half_m = 0.0
        axis = np.arange(len(self._mass)) * self.cell_m
        distance2 = (self._n0 - axis - mode.n_m)[:, None] ** 2 + (self._e0 + axis - mode.e_m)[None, :] ** 2
        self._mass = np.where(
            distance2 <= (MODE_RADIUS_CELLS * self.cell_m) ** 2, self._mass * likelihood_ratio, self._mass
        )
        self._mass /= self._mass.sum()

    def covariance(self) -> tuple[float, float, float]:
        """(ee, en, nn) in m^2 of the whole belief, over all modes."""
        axis = np.arange(len(self._mass)) * self.cell_m
        p_e, p_n = self._mass.sum(0), self._mass.sum(1)
        mean_e, mean_n = float(p_e @ axis), float(p_n @ axis)
        en = -float((axis - mean_n) @ self._mass @ (axis - mean_e))
        return float(p_e @ (axis - mean_e) ** 2), en, float(p_n @ (axis - mean_n) ** 2)

    @property
    def mean(self) -> tuple[float, float]:
        """East and north of the whole belief, over all modes."""
        axis = np.arange(len(self._mass)) * self.cell_m
        return self._e0 + float(self._mass.sum(0) @ axis), self._n0 - float(self._mass.sum(1) @ axis)

    def fit_window(self, at_least_half_m: float) -> None:
        """Centres the window on the mean and makes it as wide as the belief needs: three sigmas and a margin."""
        ee, _, nn = self.covariance()
        spread = 3.0 * float(np.sqrt(max(ee, nn))) / self.cell_m + MARGIN_CELLS
        self._resize(max(MIN_HALF_CELLS, max(at_least_half_m, self._min_half_m) / self.cell_m, spread))

    def set_cell(self, cell_m: float) -> None:
        """Resamples to another cell size after a large change of height; coarser than asked if the window would exceed
        MAX_HALF_CELLS."""
        while self.half_m / cell_m > MAX_HALF_CELLS:
            cell_m *= 2.0
        if cell_m == self.cell_m:
            return
        scale = self.cell_m / cell_m
        half = int(np.ceil(len(self._mass) // 2 * scale))
        e_m, n_m = self.centre
        side = 2 * half + 1
        self._mass = np.maximum(cv2.resize(self._mass, (side, side), interpolation=cv2.INTER_AREA), 1e-15)
        self._mass /= self._mass.sum()
        self.cell_m = cell_m
        self._e0, self._n0 = e_m - half * cell_m, n_m + half * cell_m

    @property
    def half_m(self) -> float:
        return len(self._mass) // 2 * self.cell_m

    @property
    def centre(self) -> tuple[float, float]:
        return self._e0 + self.half_m, self._n0 - self.half_m

    def _resize(self, half_cells: float) -> None:
        cells = 2 * int(np.ceil(min(half_cells, MAX_HALF_CELLS))) + 1
        p_e, p_n = self._mass.sum(0), self._mass.sum(1)
        mean_c, mean_r = round(float(p_e @ np.arange(len(p_e)))), round(float(p_n @ np.arange(len(p_n))))
        new = np.full((cells, cells), 1e-12 / cells**2)
        r0, c0 = cells // 2 - mean_r, cells // 2 - mean_c  # where the old row 0 and column 0 go
        rs = slice(max(r0, 0), min(r0 + len(self._mass), cells))
        cs = slice(max(c0, 0), min(c0 + len(self._mass), cells))
        new[rs, cs] += self._mass[rs.start - r0 : rs.stop - r0, cs.start - c0 : cs.stop - c0]
        self._mass = new / new.sum()
        self._e0 -= c0 * self.cell_m
        self._n0 += r0 * self.cell_m


def log_likelihood_ratio(z: np.ndarray) -> np.ndarray:
    """Log likelihood ratio "here against elsewhere" of a standardised correlation; an unknown one (NaN or below -5)
    counts slightly worse than random alignment."""
    known = np.nan_to_num(z, nan=-9.0)
    return np.where(
        known < -5.0, -1.0, np.clip(NATS_PER_SCORE * (known - BELIEF_LLR_ZERO_Z), BELIEF_LLR_MIN, BELIEF_LLR_MAX)
    )


def _blurred(mass: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian blur of ``sigma`` cells; a wide one is computed on a reduced grid at the cost of a narrow one."""
    shrink = max(1, int(sigma / WIDE_BLUR_CELLS))
    side = len(mass)
    small = cv2.resize(mass, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA) if shrink > 1 else mass
    kernel = 2 * int(np.ceil(4 * sigma / shrink)) + 1
    small = cv2.GaussianBlur(small, (kernel, kernel), sigma / shrink, borderType=cv2.BORDER_CONSTANT)
    return cv2.resize(small, (side, side), interpolation=cv2.INTER_LINEAR) if shrink > 1 else small
