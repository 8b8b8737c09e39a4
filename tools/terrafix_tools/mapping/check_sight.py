"""Where the matcher will see on a map and where it will be blind: the map is searched for pieces of itself.

A piece of the map is turned by 3 degrees, scaled by 3 %, disturbed with noise, and searched in the map around its place
with the descriptors and the correlation that fly. Water and bare fields drown in the noise; rows and
rasters have rivals as good as the right place. What counts is the lead of the right place over the best other one, in
standard deviations of the correlation surface.

The noise and the limits come from pairs of real images of two dates (604 frames in a suburb, two towns, a village and
farmland): of places with a lead above 1, 92 % were found in the other image; from 0 to 1, 81 %; below -1, none.
What one image cannot tell is what will have changed: new houses, a harvest, snow."""

from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np

from terrafix.anchor.matching.descriptor_cache import MapFeatures
from terrafix.anchor.matching.frame_matcher import MIN_SIDE_CELLS
from terrafix.anchor.matching.ncc import Searchable, standardise
from terrafix.map.package import LocalMap
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_tools.mapping.progress import Bar

REACH_CELLS = 60  # of the search, each way: half of the least window of the belief
MAX_SIDE_CELLS = 160  # of a piece; a larger frame only sees better
TURN_RAD, SCALE = np.radians(3.0), 1.03  # what a prediction leaves open
NOISE_GREY, NOISE_SIGMA_PX = 16.0, 1.0  # standard deviation and correlation length: what stands for two years
PAD_PX = 8  # context around a piece, so that its rim is described as if there were no rim
AT_PLACE_CELLS, RIVAL_CELLS = 3, 8  # what belongs to the right place; from where a peak is another place
LEAST_LEAD, GOOD_LEAD = 0.0, 1.0
LEAST_PEAK = 2.0  # standard deviations: below it there is no peak to lead


class Sight(IntEnum):
    NO_MAP = 0  # the frame does not lie wholly on the map
    BLIND = 1
    WEAK = 2
    SEES = 3


@dataclass(frozen=True)
class SightGrid:
    """Sight in square cells; row 0 is the northern one. ``lead`` is NaN where the map has nothing."""

    e_min_m: float
    n_max_m: float
    step_m: float
    lead: np.ndarray  # (rows, columns) float32
    sight: np.ndarray  # (rows, columns) uint8 of Sight

    def share(self, what: Sight) -> float:
        """Of the cells with map; 0 when there is none."""
        known = int((self.sight != Sight.NO_MAP).sum())
        return float((self.sight == what).sum()) / known if known else 0.0


class Looker:
    """Asks for single places of one map. ``cell_m`` and ``footprint_m``: cell of the matcher and side of the frame on
    the ground, metres."""

    def __init__(self, local: LocalMap, cell_m: float, footprint_m: float) -> None:
        self._local = local
        self._cell_m = cell_m
        self._describer = GradientDescriber()
        self._features = MapFeatures(local, self._describer)
        self.side = int(np.clip(round(footprint_m / cell_m), MIN_SIDE_CELLS, MAX_SIDE_CELLS))
        offset = np.hypot(*np.ogrid[-REACH_CELLS : REACH_CELLS + 1, -REACH_CELLS : REACH_CELLS + 1])
        self._here, self._elsewhere = offset <= AT_PLACE_CELLS, offset > RIVAL_CELLS

    def at(self, e_m: float, n_m: float) -> tuple[Sight, float]:
        """Sight and lead (standard deviations) of a frame with its centre at a place."""
        cell, side = self._cell_m, self.side
        # On the grid of cells, so that the right place is a whole cell.
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
        surface = standardise(Searchable(window, valid).search(piece, np.ones((side, side), bool)))
        known = np.isfinite(surface)
        if not (known & self._here).any() or not (known & self._elsewhere).any():
            return Sight.BLIND, float("nan")
        peak = float(surface[known & self._here].max())
        lead = peak - float(surface[known & self._elsewhere].max())
        if peak < LEAST_PEAK or lead < LEAST_LEAD:
            return Sight.BLIND, lead
        return (Sight.SEES if lead >= GOOD_LEAD else Sight.WEAK), lead

    def _piece(self, column: int, row: int) -> np.ndarray | None:
        """Descriptors (C, side, side) of the disturbed piece; None: not all of it, or of its rim, is on the map."""
        side, pad, cell = self.side, 2 * PAD_PX, self._cell_m
        size = side + 2 * pad
        image, valid = self._local.window((column - pad) * cell, -(row - pad) * cell, size, size, cell)
        if not valid[PAD_PX:-PAD_PX, PAD_PX:-PAD_PX].all():  # the edge of the map looks like the edge of something
            return None
        inner = slice(pad, pad + side)
        middle = (size - 1) / 2
        turn = cv2.getRotationMatrix2D((middle, middle), float(np.degrees(TURN_RAD)), SCALE)
        turned = cv2.warpAffine(image, turn, (size, size), borderMode=cv2.BORDER_REFLECT).astype(np.float32)
        rng = np.random.default_rng((column & 0xFFFFFFFF, row & 0xFFFFFFFF))
        noise = cv2.GaussianBlur(rng.normal(size=(size, size)).astype(np.float32), (0, 0), NOISE_SIGMA_PX)
        noise *= NOISE_GREY / noise.std()
        disturbed = np.clip(turned + noise[:, :, None], 0, 255).astype(np.uint8)
        return self._describer.describe(disturbed)[:, inner, inner]


def sight_grid(local: LocalMap, looker: Looker, step_m: float, bar: Bar) -> SightGrid:
    """The whole map in cells of ``step_m``."""
    e_min, n_min, e_max, n_max = local.bounds_m
    rows, columns = max(1, int(np.ceil((n_max - n_min) / step_m))), max(1, int(np.ceil((e_max - e_min) / step_m)))
    lead, sight = np.full((rows, columns), np.nan, np.float32), np.zeros((rows, columns), np.uint8)
    step = bar("sight", rows)
    for row in range(rows):
        step()
        for column in range(columns):
            place = e_min + (column + 0.5) * step_m, n_max - (row + 0.5) * step_m
            sight[row, column], lead[row, column] = looker.at(*place)
    return SightGrid(e_min, n_max, step_m, lead, sight)
