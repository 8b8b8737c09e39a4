"""Where on the map, when nobody knows: a histogram over its cells proposes places, tracks of camera poses decide.

Every look multiplies the histogram, odometry moves it, and its heaviest places are handed to the tracks. The region
grows by whole tiles around the last place that was believed, and ends with the whole map."""

import cv2
import numpy as np

from terrafix.anchor.belief import log_likelihood_ratio
from terrafix.anchor.map_package import LocalMap
from terrafix.anchor.matcher import FrameMatcher, Hypothesis, View
from terrafix.anchor.tracks import NEAR, Found, Tracks
from terrafix.anchor.wide_search import BLOCK_CELLS, Block, WideSearch, blocks_of
from terrafix.core.node import Image
from terrafix.messages import SearchStep
from terrafix_engines.features.gradient import GradientDescriber

CELL_PER_AGL = 1 / 50  # measured on five places: coarser, and the right place is no longer among the best twenty
MAX_WORK = 35e6  # cells times headings times scales of one look: about 2 s of one core. A larger map gets larger cells
LOOK_EVERY = 0.15  # of the height: motion between two looks at the whole region
VERIFY_EVERY = 0.03  # ... and between two attempts at a pose
NEW_GROUND = 0.6  # of the height: after this much motion a look counts as a new one
RINGS = (1, 4, 9, 16, 25)  # blocks of each step of the search, nearest first; then the whole map
LOOKS_PER_RING = 0.5  # full looks without a track before the next step
LOOKS_TO_ASK = 6.0  # full looks at the whole map before the operator is asked
LEAK = 0.02  # share of the mass that is spread over the map each full look
WAY_ERROR = 0.10  # of the way: odometry on a heading and a height that may be off
PROPOSED = 5  # places that a look may propose


class MapSearch:
    def __init__(
        self, source: LocalMap, matcher: FrameMatcher, agl_m: float, around_m: tuple[float, float] | None
    ) -> None:
        """``around_m``: the last place that was believed, where the search begins; None: nowhere."""
        self._map = source
        self._matcher = matcher
        self._wide = WideSearch(source, GradientDescriber())
        self.agl_m = agl_m
        self._around_m = around_m
        self._ring = 0 if around_m is not None else len(RINGS)
        self._ring_looks = 0.0
        self._blocks: list[Block] = []
        self._cell_m = 0.0
        self._mass = np.zeros((0, 0), np.float32)
        self.tracks = Tracks(source, matcher)
        self._step_m = np.zeros(2)  # since the histogram was moved
        self._step_var_m2 = 0.0
        self._way_m = 0.0  # flown since the search began
        self._looked_way_m = self._verified_way_m = -np.inf

    @property
    def step(self) -> SearchStep:
        if self._ring < len(RINGS) and (not self._blocks or self.tiles < len(self._blocks)):
            return SearchStep.WIDEN
        return SearchStep.ASK if self._ring_looks >= LOOKS_TO_ASK else SearchStep.WHOLE_MAP

    @property
    def tiles(self) -> int:
        """Blocks of the map that are searched."""
        return min(RINGS[self._ring], len(self._blocks)) if self._ring < len(RINGS) else len(self._blocks)

    def move(self, east_m: float, north_m: float, sigma_m: float) -> None:
        """Odometry. A step of which little is known counts as a way too: the ground is another. After one of which
        nothing is known, all evidence before it is of another place and counts no more."""
        step_m = float(np.hypot(east_m, north_m))
        error_m = float(np.hypot(sigma_m, WAY_ERROR * step_m))
        self._step_m += (east_m, north_m)
        self._step_var_m2 += error_m**2
        self._way_m += float(np.hypot(step_m, sigma_m))
        self.tracks.move(np.array([east_m, north_m]))
        if sigma_m > NEAR * self.agl_m:
            self.tracks.all = []
            self._mass[:] = 1.0 / max(self._mass.size, 1)

    def look(self, image: Image, view: View) -> Found | None:
        """``view``: height, attitude and how well they are known; its place counts for nothing."""
        if self._way_m - self._looked_way_m >= LOOK_EVERY * view.agl_m:
            self._look_wide(image, view)
        if self._way_m - self._verified_way_m < VERIFY_EVERY * view.agl_m:
            return None
        self._verified_way_m = self._way_m
        return self.tracks.look(image, view, self._way_m)

    def _look_wide(self, image: Image, view: View) -> None:
        hypotheses = self._matcher.wide_hypotheses(view)
        if not self._blocks:
            self._begin(view.agl_m, len(hypotheses))
        templates = []
        for hypothesis in hypotheses:
            frame = self._matcher.rectified(image, view, hypothesis, self._cell_m)
            if frame is None:
                return
            templates.append(self._wide.describe(frame))
        new = min((self._way_m - self._looked_way_m) / (NEW_GROUND * view.agl_m), 1.0)
        self._looked_way_m = self._way_m
        blocks = self._blocks[: self.tiles]
        llr = np.zeros_like(self._mass)
        index = np.zeros(self._mass.shape, np.uint8)
        for block, found in zip(blocks, self._wide.look(templates, blocks, self._cell_m), strict=True):
            at = self._cells(block)
            llr[at] = log_likelihood_ratio(found.z)
            index[at] = found.index
        self._move_mass()
        self._mass *= np.exp(new * llr)
        self._mass /= self._mass.sum()
        self._mass = ((1 - LEAK * new) * self._mass + LEAK * new / self._mass.size).astype(np.float32)
        self._propose(index, hypotheses, view.agl_m)
        self._ring_looks += new
        follows = any(track.poses for track in self.tracks.all)
        if self.tiles < len(self._blocks) and self._ring_looks >= LOOKS_PER_RING and not follows:
            self._ring, self._ring_looks = self._ring + 1, 0.0

    def _begin(self, agl_m: float, hypotheses: int) -> None:
        e_min, n_min, e_max, n_max = self._map.bounds_m
        cell_m = self._matcher.cell_m(agl_m, CELL_PER_AGL)
        while (e_max - e_min) * (n_max - n_min) / cell_m**2 * hypotheses > MAX_WORK:
            cell_m *= np.sqrt(2.0)
        self._cell_m = cell_m
        blocks = blocks_of(self._map.bounds_m, cell_m)
        self._row0, self._column0 = min(b.row for b in blocks), min(b.column for b in blocks)
        rows = max(b.row for b in blocks) - self._row0 + BLOCK_CELLS
        columns = max(b.column for b in blocks) - self._column0 + BLOCK_CELLS
        self._mass = np.full((rows, columns), 1.0 / (rows * columns), np.float32)
        e_m, n_m = self._around_m or (0.5 * (e_min + e_max), 0.5 * (n_min + n_max))
        half = BLOCK_CELLS / 2

        def away(block: Block) -> float:
            return float(np.hypot((block.column + half) * cell_m - e_m, -(block.row + half) * cell_m - n_m))

        self._blocks = sorted(blocks, key=away)

    def _cells(self, block: Block) -> tuple[slice, slice]:
        r, c = block.row - self._row0, block.column - self._column0
        return slice(r, r + BLOCK_CELLS), slice(c, c + BLOCK_CELLS)

    def _move_mass(self) -> None:
        """The step and its blur since the last look."""
        dx, dy = self._step_m[0] / self._cell_m, -self._step_m[1] / self._cell_m
        matrix = np.array([[1.0, 0.0, dx], [0.0, 1.0, dy]])
        rows, columns = self._mass.shape
        floor = float(self._mass.min())
        moved = cv2.warpAffine(self._mass, matrix, (columns, rows), borderMode=cv2.BORDER_CONSTANT, borderValue=floor)
        sigma = min(float(np.sqrt(self._step_var_m2)) / self._cell_m, BLOCK_CELLS / 8)
        if sigma > 0.2:
            moved = cv2.GaussianBlur(moved, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
        self._mass = np.maximum(moved, 1e-20)
        self._step_m = np.zeros(2)
        self._step_var_m2 = 0.0

    def _propose(self, index: np.ndarray, hypotheses: tuple[Hypothesis, ...], agl_m: float) -> None:
        """The heaviest places become tracks, unless one is followed there already."""
        gathered = cv2.boxFilter(self._mass, -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT)
        near = max(round(NEAR * agl_m / self._cell_m), 1)
        for _ in range(PROPOSED):
            r, c = (int(v) for v in np.unravel_index(int(np.argmax(gathered)), gathered.shape))
            gathered[max(r - near, 0) : r + near + 1, max(c - near, 0) : c + near + 1] = 0.0
            e_m, n_m = (c + self._column0 + 0.5) * self._cell_m, -(r + self._row0 + 0.5) * self._cell_m
            self.tracks.propose(e_m, n_m, hypotheses[int(index[r, c])], agl_m)
