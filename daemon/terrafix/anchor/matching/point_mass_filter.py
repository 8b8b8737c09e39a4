"""A belief over the map: a point-mass filter on a grid of camera positions.

Every frame's whole correlation surface multiplies it, odometry moves it, so that every hypothesis lives until the
frames decide (Bergman, "Recursive Bayesian estimation: navigation and tracking applications", 1999, ch. 5)."""

from dataclasses import dataclass

import cv2
import numpy as np

# Log-likelihood ratio "here against elsewhere" of a standardised correlation z. Fitted to what right and wrong places
# scored on seven pairs of real images of the same ground at two dates: the right place has z = 3 to 8 (median 3.6 to
# 6.9 by pair), the best of tens of thousands of wrong ones 3.0 (98 % below 4.1).
LLR_SLOPE = 3.0
LLR_ZERO_Z = 1.9
LLR_MIN, LLR_MAX = -3.0, 9.0
LEAK = 0.004  # share of the mass that is spread over the window each full look: nothing is ever quite excluded
CELL_PER_AGL = 1 / 50  # a cell is 2 m at 100 m: two pixels of the look
MIN_CELL_M = 1.0
MIN_HALF_CELLS = 60  # the window never shrinks below this: the next error must still lie inside
MAX_HALF_CELLS = 750
MARGIN_CELLS = 30  # of the window beyond three or four sigmas of the belief
WIDE_BLUR_CELLS = 6.0  # a blur wider than this is made at lower resolution
MODE_RADIUS_CELLS = 7  # mass within this radius counts as one mode


def cell_for(agl_m: float, look_cell_m: float) -> float:
    """Size of a belief cell, in steps of an octave: a share of the height, and not finer than what is looked at."""
    wanted = max(agl_m * CELL_PER_AGL, look_cell_m, MIN_CELL_M)
    return float(2.0 ** round(np.log2(wanted)))


@dataclass(frozen=True)
class Mode:
    e_m: float
    n_m: float
    mass: float
    rival: float  # largest mass of another mode
    var_m2: float  # of a position within the mode, per axis


@dataclass(frozen=True)
class Surface:
    """``z`` (H, W): standardised correlation with the camera at east e0_m + c cell_m, north n0_m - r cell_m; NaN = not
    known."""

    z: np.ndarray
    e0_m: float
    n0_m: float
    cell_m: float

    def best(self, e_m: float, n_m: float, reach_m: float) -> tuple[float, float, float]:
        """Best value within ``reach_m`` of a position, and where (east, north); -9 outside."""
        r, c = (self.n0_m - n_m) / self.cell_m, (e_m - self.e0_m) / self.cell_m
        k = max(reach_m / self.cell_m, 1.0)
        rows = slice(max(round(r - k), 0), max(round(r + k) + 1, 0))
        columns = slice(max(round(c - k), 0), max(round(c + k) + 1, 0))
        near = np.nan_to_num(self.z[rows, columns], nan=-9.0)
        if not near.size:
            return -9.0, e_m, n_m
        dr, dc = np.unravel_index(int(np.argmax(near)), near.shape)
        there_e_m = self.e0_m + (columns.start + int(dc)) * self.cell_m
        return float(near[dr, dc]), there_e_m, self.n0_m - (rows.start + int(dr)) * self.cell_m

    def at(self, e_m: float, n_m: float, reach_m: float) -> float:
        """Best value within ``reach_m`` of a position; -9 outside."""
        return self.best(e_m, n_m, reach_m)[0]


class Belief:
    """Mass over camera positions (east, north). The grid travels with the camera, so motion costs no resampling."""

    def __init__(
        self, e_m: float, n_m: float, sigma_m: float, cell_m: float, stray: float = 0.0, reach_m: float = 0.0
    ) -> None:
        """A normal density of ``sigma_m`` per axis; the share ``stray`` of the mass is uniform over the window, which
        reaches ``reach_m`` at least until ``confirm``."""
        self._reach_m = reach_m
        self.cell_m = cell_m
        half = min(max(4.0 * sigma_m / cell_m + MARGIN_CELLS, MIN_HALF_CELLS, reach_m / cell_m), MAX_HALF_CELLS)
        cells = 2 * int(np.ceil(half)) + 1
        self._e0 = e_m - (cells // 2) * self.cell_m  # position of column 0
        self._n0 = n_m + (cells // 2) * self.cell_m  # position of row 0
        axis = (np.arange(cells) - cells // 2) * self.cell_m
        log = -0.5 * (axis**2) / sigma_m**2
        normal = np.exp(log[:, None] + log[None, :])
        self._mass = (1.0 - stray) * normal / normal.sum() + stray / normal.size

    def move(self, east_m: float, north_m: float, sigma_m: float) -> None:
        """Odometry: shift by the step, spread by its error."""
        self._e0 += east_m
        self._n0 += north_m
        cells = min(sigma_m / self.cell_m, MAX_HALF_CELLS / 3)
        if cells * 6 > len(self._mass) // 2:
            self._resize(4.0 * cells + len(self._mass) // 2)
        if cells > 0.05:
            self._mass = np.maximum(_blurred(self._mass, cells), 0.0)
            self._mass /= self._mass.sum()

    def update(self, surfaces: tuple[Surface, ...], weight: float) -> float:
        """One frame's surfaces, one for each rotation and scale that was tried; ``weight`` 0..1: share of the look that
        is new ground (the same ground seen again proves little).

        -> log likelihood ratio of the belief as a whole, "the camera is where it says against elsewhere"."""
        llr = self._log_likelihood(surfaces[0])
        for surface in surfaces[1:]:  # one at a time: of a wide window and many headings all together are a gigabyte
            np.maximum(llr, self._log_likelihood(surface), out=llr)
        self._mass = self._mass * np.exp(weight * llr)
        total = float(self._mass.sum())
        self._mass /= total
        leak = LEAK * weight
        self._mass = (1 - leak) * self._mass + leak / self._mass.size
        return float(np.log(total))

    def _log_likelihood(self, surface: Surface) -> np.ndarray:
        """On the belief's grid; what is not known counts as a little worse than chance."""
        z = np.nan_to_num(surface.z, nan=-9.0).astype(np.float32)
        if surface.cell_m < self.cell_m:  # the best of the finer cells stands for the coarse one
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
        """The heaviest mode: centroid and mass within MODE_RADIUS_CELLS, and the mass of its best rival."""
        return self.modes(1)[0]

    def modes(self, count: int) -> list[Mode]:
        """The heaviest ones, apart by twice that radius."""
        radius = MODE_RADIUS_CELLS
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)).astype(np.float64)
        gathered = cv2.filter2D(self._mass, -1, disc, borderType=cv2.BORDER_CONSTANT)
        found = []
        left = gathered.copy()
        for _ in range(count):
            r, c = (int(v) for v in np.unravel_index(int(np.argmax(left)), left.shape))
            found.append(self._mode_at(r, c, gathered))
            left[max(r - 2 * radius, 0) : r + 2 * radius + 1, max(c - 2 * radius, 0) : c + 2 * radius + 1] = 0.0
        return found

    def _mode_at(self, r: int, c: int, gathered: np.ndarray) -> Mode:
        radius = MODE_RADIUS_CELLS
        rows, columns = np.ogrid[: len(self._mass), : len(self._mass)]
        distance2 = (rows - r) ** 2 + (columns - c) ** 2
        near = np.where(distance2 <= radius**2, self._mass, 0.0)
        mass = float(near.sum())
        e_m = self._e0 + float((near.sum(0) * np.arange(len(self._mass))).sum()) / mass * self.cell_m
        n_m = self._n0 - float((near.sum(1) * np.arange(len(self._mass))).sum()) / mass * self.cell_m
        rival = float(np.where(distance2 > (2 * radius) ** 2, gathered, 0.0).max())
        var = float((near * distance2).sum()) / mass / 2 * self.cell_m**2
        return Mode(e_m, n_m, min(mass, 1.0), rival, var)

    def confirm(self, mode: Mode, likelihood_ratio: float) -> None:
        """Evidence from another source that the camera is in this mode."""
        self._reach_m = 0.0
        axis = np.arange(len(self._mass)) * self.cell_m
        distance2 = (self._n0 - axis - mode.n_m)[:, None] ** 2 + (self._e0 + axis - mode.e_m)[None, :] ** 2
        self._mass = np.where(
            distance2 <= (MODE_RADIUS_CELLS * self.cell_m) ** 2, self._mass * likelihood_ratio, self._mass
        )
        self._mass /= self._mass.sum()

    def covariance(self) -> tuple[float, float, float]:
        """(ee, en, nn) in m^2 of the whole belief, all modes."""
        axis = np.arange(len(self._mass)) * self.cell_m
        p_e, p_n = self._mass.sum(0), self._mass.sum(1)
        mean_e, mean_n = float(p_e @ axis), float(p_n @ axis)
        en = -float((axis - mean_n) @ self._mass @ (axis - mean_e))
        return float(p_e @ (axis - mean_e) ** 2), en, float(p_n @ (axis - mean_n) ** 2)

    @property
    def mean(self) -> tuple[float, float]:
        """East and north of the whole belief, all modes."""
        axis = np.arange(len(self._mass)) * self.cell_m
        return self._e0 + float(self._mass.sum(0) @ axis), self._n0 - float(self._mass.sum(1) @ axis)

    def fit_window(self, at_least_half_m: float) -> None:
        """Window around the mean, as wide as the belief needs."""
        ee, _, nn = self.covariance()
        spread = 3.0 * float(np.sqrt(max(ee, nn))) / self.cell_m + MARGIN_CELLS
        self._resize(max(MIN_HALF_CELLS, max(at_least_half_m, self._reach_m) / self.cell_m, spread))

    def set_cell(self, cell_m: float) -> None:
        """Another resolution, when the height has changed much; as fine as so wide a window can have."""
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
        r0, c0 = cells // 2 - mean_r, cells // 2 - mean_c  # where the old row 0 and column 0 land
        rs = slice(max(r0, 0), min(r0 + len(self._mass), cells))
        cs = slice(max(c0, 0), min(c0 + len(self._mass), cells))
        new[rs, cs] += self._mass[rs.start - r0 : rs.stop - r0, cs.start - c0 : cs.stop - c0]
        self._mass = new / new.sum()
        self._e0 -= c0 * self.cell_m
        self._n0 += r0 * self.cell_m


def log_likelihood_ratio(z: np.ndarray) -> np.ndarray:
    """Of a standardised correlation, "here against elsewhere"; what is not known (NaN or below -5) counts as a little
    worse than chance."""
    known = np.nan_to_num(z, nan=-9.0)
    return np.where(known < -5.0, -1.0, np.clip(LLR_SLOPE * (known - LLR_ZERO_Z), LLR_MIN, LLR_MAX))


def _blurred(mass: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian blur; a wide one is made on a smaller picture, where it costs no more than a narrow one."""
    shrink = max(1, int(sigma / WIDE_BLUR_CELLS))
    side = len(mass)
    small = cv2.resize(mass, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA) if shrink > 1 else mass
    kernel = 2 * int(np.ceil(4 * sigma / shrink)) + 1
    small = cv2.GaussianBlur(small, (kernel, kernel), sigma / shrink, borderType=cv2.BORDER_CONSTANT)
    return cv2.resize(small, (side, side), interpolation=cv2.INTER_LINEAR) if shrink > 1 else small
