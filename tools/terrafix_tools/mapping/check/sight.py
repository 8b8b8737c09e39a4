"""Matchability of a map: the matcher searches the map for disturbed pieces of itself.

A piece of the map is rotated by 3 degrees, scaled by 3 %, disturbed with noise, and searched around its position with
the descriptors and the correlation of the flight. On water and bare fields the noise dominates; rows and periodic
textures have peaks as high as the true one. The measure is the lead of the true peak over the best other one, in
standard deviations of the correlation surface.

The noise and the thresholds come from pairs of real images of two dates (604 frames in a suburb, two towns, a village
and farmland): of the places with a lead above 1, 92 % were found in the other image; from 0 to 1, 81 %; below -1, none.
Future changes of the ground (new houses, a harvest, snow) cannot be predicted from one image."""

from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np

from terrafix.anchor.matching.descriptor_cache import MapFeatures
from terrafix.anchor.matching.frame_matcher import MIN_SIDE_CELLS
from terrafix.anchor.matching.ncc import CorrelationWindow, standardise
from terrafix.map.package import LocalMap
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_tools.progress import Bar

REACH_CELLS = 60  # search range in each direction: half of the smallest window of the point-mass filter
MAX_SIDE_CELLS = 160  # of a piece; a larger frame is matched at least as well
TURN_RAD, SCALE = np.radians(3.0), 1.03  # residual errors of a predicted view
NOISE_GREY, NOISE_SIGMA_PX = 16.0, 1.0  # standard deviation and correlation length: equivalent to two years of change
PAD_PX = 8  # margin around a piece, so that its descriptors have no edge effect
AT_PLACE_CELLS, RIVAL_CELLS = 3, 8  # radius of the true peak; minimum distance of another peak
MIN_LEAD, GOOD_LEAD = 0.0, 1.0
MIN_PEAK = 2.0  # minimum peak in standard deviations


class Sight(IntEnum):
    NO_MAP = 0  # the frame is not completely on the map
    BLIND = 1
    WEAK = 2
    SEES = 3


@dataclass(frozen=True)
class SightGrid:
    """Sight in square cells; row 0 is the northern one. ``lead`` is NaN where there is no map."""

    e_min_m: float
    n_max_m: float
    step_m: float
    lead: np.ndarray  # (rows, columns) float32
    sight: np.ndarray  # (rows, columns) uint8 of Sight

    def share(self, what: Sight) -> float:
        """Fraction of the cells with map; 0 when there are none."""
        known = int((self.sight != Sight.NO_MAP).sum())
        return float((self.sight == what).sum()) / known if known else 0.0


class MatchabilityProbe:
    """Computes the matchability of single positions. ``cell_m``: cell of the matcher in metres; ``footprint_m``: side
    of the frame on the ground in metres."""

    def __init__(self, local: LocalMap, cell_m: float, footprint_m: float) -> None:
        self._local = local
        self._cell_m = cell_m
        self._describer = GradientDescriber()
        self._features = MapFeatures(local, self._describer)
        self.side = int(np.clip(round(footprint_m / cell_m), MIN_SIDE_CELLS, MAX_SIDE_CELLS))
        offset = np.hypot(*np.ogrid[-REACH_CELLS : REACH_CELLS + 1, -REACH_CELLS : REACH_CELLS + 1])
        self._here, self._elsewhere = offset <= AT_PLACE_CELLS, offset > RIVAL_CELLS

    def at(self, e_m: float, n_m: float) -> tuple[Sight, float]:
        """Sight and lead (standard deviations) of a frame with its centre at the position."""
        cell, side = self._cell_m, self.side
        # Rounded to the grid of cells, so that the true offset is a whole number of cells.
        column, row = round(e_m / cell - side / 2), round(-n_m / cell - side / 2)
        piece = self._piece(column, row)
        if piece is None:
            return Sight.NO_MAP, float("nan")
        window, valid, _, _ = self._features.window(
            (column - REACH_CELLS) * cell,
            -(row - REACH_CELLS) * cell,
            side + 2 * REACH_CELLS,
            side + 2 * REACH_CELLS,
            cell,
        )
        surface = standardise(CorrelationWindow(window, valid).correlate(piece, np.ones((side, side), bool)))
        known = np.isfinite(surface)
        if not (known & self._here).any() or not (known & self._elsewhere).any():
            return Sight.BLIND, float("nan")
        peak = float(surface[known & self._here].max())
        lead = peak - float(surface[known & self._elsewhere].max())
        if peak < MIN_PEAK or lead < MIN_LEAD:
            return Sight.BLIND, lead
        return (Sight.SEES if lead >= GOOD_LEAD else Sight.WEAK), lead

    def _piece(self, column: int, row: int) -> np.ndarray | None:
        """Descriptors (C, side, side) of the disturbed piece; None when it or its margin is not fully on the map."""
        side, pad, cell = self.side, 2 * PAD_PX, self._cell_m
        size = side + 2 * pad
        image, valid = self._local.window((column - pad) * cell, -(row - pad) * cell, size, size, cell)
        if not valid[PAD_PX:-PAD_PX, PAD_PX:-PAD_PX].all():  # the edge of the map would look like an edge of an object
            return None
        inner = slice(pad, pad + side)
        centre = (size - 1) / 2
        turn = cv2.getRotationMatrix2D((centre, centre), float(np.degrees(TURN_RAD)), SCALE)
        turned = cv2.warpAffine(image, turn, (size, size), borderMode=cv2.BORDER_REFLECT).astype(np.float32)
        rng = np.random.default_rng((column & 0xFFFFFFFF, row & 0xFFFFFFFF))
        noise = cv2.GaussianBlur(rng.normal(size=(size, size)).astype(np.float32), (0, 0), NOISE_SIGMA_PX)
        noise *= NOISE_GREY / noise.std()
        disturbed = np.clip(turned + noise[:, :, None], 0, 255).astype(np.uint8)
        return self._describer.describe(disturbed)[:, inner, inner]


def sight_grid(local: LocalMap, probe: MatchabilityProbe, step_m: float, bar: Bar) -> SightGrid:
    """Matchability of the whole map in cells of ``step_m``."""
    e_min, n_min, e_max, n_max = local.bounds_m
    rows, columns = max(1, int(np.ceil((n_max - n_min) / step_m))), max(1, int(np.ceil((e_max - e_min) / step_m)))
    lead, sight = np.full((rows, columns), np.nan, np.float32), np.zeros((rows, columns), np.uint8)
    step = bar("sight", rows)
    for row in range(rows):
        step()
        for column in range(columns):
            place = e_min + (column + 0.5) * step_m, n_max - (row + 0.5) * step_m
            sight[row, column], lead[row, column] = probe.at(*place)
    return SightGrid(e_min, n_max, step_m, lead, sight)
