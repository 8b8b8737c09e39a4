"""Where on the map, when nobody knows: a joint look of the last frames proposes places, tracks of camera poses decide.

A joint look correlates the mosaic of the last frames with every cell of a region. Its best places are handed to the
tracks, and how far a track leads all other places is evidence. The region grows by whole tiles around the last place
that was believed, and ends with the whole map."""

from dataclasses import dataclass

import numpy as np

from terrafix.anchor.matching.frame_matcher import FrameMatcher, Hypothesis, View
from terrafix.anchor.matching.ncc import standardise
from terrafix.anchor.relocalization.block_search import BLOCK_CELLS, Block, WideSearch, blocks_of
from terrafix.anchor.relocalization.hypothesis_tracker import NEAR, NEW_EVIDENCE, SAME, Found, HypothesisTracker
from terrafix.anchor.relocalization.mosaic import Mosaic
from terrafix.core.node import Image
from terrafix.map.null_model import FlightBudget, NullRow
from terrafix.map.package import LocalMap
from terrafix.messages import SearchStep
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_engines.retrieval.pooled import PooledGradientDescriber

# Dense gradients on small cells tell places apart best; where heading or map leave too much open, gradients that are
# pooled over larger cells do: a heading that is off by degrees does not matter to them. Measured: docs/search.md.
FINE_CELL_PER_AGL, FINE_HYPOTHESES = 1 / 50, 25
CELL_PER_AGL = 1 / 13  # of pooled cells
MAX_WORK = 35e6  # cells times headings times scales of one look: about 2 s of one core. A larger map gets larger cells
LOOK_EVERY = 0.15  # of the height: motion between two looks at the whole region
VERIFY_EVERY = 0.03  # ... and between two attempts at a pose
NEW_GROUND = 0.6  # of the height: after this much motion a look counts as a new one; one that joins it is a wide one
RINGS = (1, 4, 9, 16, 25)  # blocks of each step of the search, nearest first; then the whole map
LOOKS_PER_RING = 0.5  # full looks without a track before the next step
LOOKS_TO_ASK = 6.0  # full looks at the whole map before the operator is asked
DRIFT = 0.06  # of the height: frames that odometry places less well than this are not joined
UNSEEN = 0.1  # of the height: where odometry knows less, the ground may be another; hovering is no way
JOINED = 2.0  # heights: frames farther away than this are not joined; the cost of a look grows with what is
PROPOSED = 12  # places that a look may propose
NEIGHBOURS = 4  # of the best of them that also propose the best place beside them
LEAD_REACH = 0.2  # of the height: a track's place in the joint look is the best within this
UNKNOWN = -9.0  # standard deviations, where the map does not cover the frames


@dataclass(frozen=True)
class Peak:
    """A place of the joint look: cell, standard deviations above what chance gives, heading and scale."""

    row: int
    column: int
    z: float
    hypothesis: Hypothesis


class MapSearch:
    def __init__(
        self,
        source: LocalMap,
        matcher: FrameMatcher,
        agl_m: float,
        around_m: tuple[float, float] | None,
        null: NullRow,
        budget: FlightBudget,
    ) -> None:
        """``around_m``: the last place that was believed, where the search begins; None: nowhere. ``null``: of the map
        at this height; ``budget``: of the flight, from which every stretch of new ground takes a share."""
        self._map = source
        self._matcher = matcher
        self.agl_m = agl_m
        self._around_m = around_m
        self._ring = 0 if around_m is not None else len(RINGS)
        self._ring_looks = 0.0
        self._blocks: list[Block] = []
        self._cell_m = 0.0
        self._hypotheses: tuple[Hypothesis, ...] = ()
        self._mosaic = Mosaic((), 1.0)
        self._null = null
        self._budget = budget
        self.tracks = HypothesisTracker(source, matcher, null.patches)
        self._p_m = np.zeros(2)  # by odometry, since the search began
        self._var_m2 = 0.0
        self._way_m = 0.0  # flown since the search began
        self._looked_way_m = self._verified_way_m = self._decided_way_m = -np.inf

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
        self._p_m += (east_m, north_m)
        self._var_m2 += sigma_m**2
        self._way_m += float(np.hypot(np.hypot(east_m, north_m), sigma_m if sigma_m > UNSEEN * self.agl_m else 0.0))
        self.tracks.move(np.array([east_m, north_m]))
        if sigma_m > NEAR * self.agl_m:
            self.tracks.all = []

    def look(self, image: Image, view: View) -> Found | None:
        """``view``: height, attitude and how well they are known; its place counts for nothing."""
        if self._way_m - self._looked_way_m >= LOOK_EVERY * view.agl_m:
            self._look_wide(image, view)
        if self._way_m - self._verified_way_m < VERIFY_EVERY * view.agl_m:
            return None
        self._verified_way_m = self._way_m
        if self._way_m - self._decided_way_m >= NEW_EVIDENCE * view.agl_m:
            self._decided_way_m = self._way_m
            self._budget.spend()
        return self.tracks.look(image, view, self._way_m, self.enough)

    @property
    def enough(self) -> float:
        """Evidence that a place needs by now."""
        return self._null.enough(self.places, self._budget.log_probability)

    @property
    def places(self) -> float:
        """That could be the best one by chance: neighbours of the whole map, times headings and scales."""
        e_min, n_min, e_max, n_max = self._map.bounds_m
        area = (e_max - e_min) * (n_max - n_min) / (NEAR * self.agl_m) ** 2
        return max(area, 1.0) * max(len(self._hypotheses), 1)

    def _look_wide(self, image: Image, view: View) -> None:
        if not self._blocks:
            self._begin(view)
        stride = self._wide.stride
        frames = self._matcher.rectified(image, view, self._hypotheses, self._cell_m / stride, stride)
        templates = [self._wide.describe(frame) for frame in frames if frame is not None]
        if len(templates) < len(frames):
            return
        new = min((self._way_m - self._looked_way_m) / (NEW_GROUND * view.agl_m), 1.0)
        self._looked_way_m = self._way_m
        self._mosaic.add(self._p_m, self._var_m2, templates, DRIFT * view.agl_m, JOINED * view.agl_m)
        correlation = np.full(self._shape, np.nan, np.float32)
        index = np.zeros(self._shape, np.uint8)
        blocks = self._blocks[: self.tiles]
        looks = self._wide.look(self._mosaic.templates(), blocks, self._cell_m)
        for block, found in zip(blocks, looks, strict=True):
            at = self._cells(block)
            correlation[at], index[at] = found.correlation, found.index
        self._judge(np.nan_to_num(standardise(correlation), nan=UNKNOWN), index, view.agl_m)
        self._ring_looks += new
        follows = any(track.frames for track in self.tracks.all)
        if self.tiles < len(self._blocks) and self._ring_looks >= LOOKS_PER_RING and not follows:
            self._ring, self._ring_looks = self._ring + 1, 0.0

    def _begin(self, view: View) -> None:
        self._hypotheses = self._matcher.wide_hypotheses(view)
        e_min, n_min, e_max, n_max = self._map.bounds_m
        places_m2 = (e_max - e_min) * (n_max - n_min) * len(self._hypotheses)
        cell_m = self._matcher.cell_m(view.agl_m, FINE_CELL_PER_AGL)
        if len(self._hypotheses) <= FINE_HYPOTHESES and places_m2 / cell_m**2 <= MAX_WORK:
            self._wide = WideSearch(self._map, GradientDescriber())
        else:
            self._wide = WideSearch(self._map, PooledGradientDescriber())
            stride = self._wide.stride
            cell_m = self._wide.cell_m(stride * self._matcher.cell_m(view.agl_m, CELL_PER_AGL / stride))
            while places_m2 / cell_m**2 > MAX_WORK:
                cell_m *= 2.0  # the next level of the map
        self._cell_m = cell_m
        blocks = blocks_of(self._map.bounds_m, cell_m)
        self._row0, self._column0 = min(b.row for b in blocks), min(b.column for b in blocks)
        rows = max(b.row for b in blocks) - self._row0 + BLOCK_CELLS
        columns = max(b.column for b in blocks) - self._column0 + BLOCK_CELLS
        self._shape = (rows, columns)
        self._mosaic = Mosaic(self._hypotheses, cell_m)
        e_m, n_m = self._around_m or (0.5 * (e_min + e_max), 0.5 * (n_min + n_max))
        half = BLOCK_CELLS / 2

        def away(block: Block) -> float:
            return float(np.hypot((block.column + half) * cell_m - e_m, -(block.row + half) * cell_m - n_m))

        self._blocks = sorted(blocks, key=away)

    def _cells(self, block: Block) -> tuple[slice, slice]:
        r, c = block.row - self._row0, block.column - self._column0
        return slice(r, r + BLOCK_CELLS), slice(c, c + BLOCK_CELLS)

    def _judge(self, z: np.ndarray, index: np.ndarray, agl_m: float) -> None:
        """How far each track leads all other places, and the best places as tracks, unless one is followed there."""
        near, same, reach = (max(round(share * agl_m / self._cell_m), 1) for share in (NEAR, SAME, LEAD_REACH))
        left, peaks, beside = z.copy(), list[Peak](), list[Peak]()

        def best_of(region: np.ndarray, r0: int = 0, c0: int = 0) -> Peak:
            r, c = (int(v) for v in np.unravel_index(int(np.argmax(region)), region.shape))
            return Peak(r0 + r, c0 + c, float(region[r, c]), self._hypotheses[int(index[r0 + r, c0 + c])])

        for k in range(PROPOSED):
            peaks.append(best_of(left))
            r, c = peaks[-1].row, peaks[-1].column
            if k < NEIGHBOURS:
                left[max(r - same, 0) : r + same + 1, max(c - same, 0) : c + same + 1] = UNKNOWN
                r0, c0 = max(r - near, 0), max(c - near, 0)
                beside.append(best_of(left[r0 : r + near + 1, c0 : c + near + 1], r0, c0))
            left[max(r - near, 0) : r + near + 1, max(c - near, 0) : c + near + 1] = UNKNOWN
        for peak in (*peaks, *beside):
            e_m = (peak.column + self._column0 + 0.5) * self._cell_m
            n_m = -(peak.row + self._row0 + 0.5) * self._cell_m
            if peak.z > UNKNOWN:
                self.tracks.propose(e_m, n_m, peak.hypothesis, agl_m)
        wide = self._mosaic.length_m >= NEW_GROUND * agl_m
        for track in self.tracks.all:
            r = round(-track.n_m / self._cell_m - 0.5) - self._row0
            c = round(track.e_m / self._cell_m - 0.5) - self._column0
            here, beside_it = (
                float(z[max(r - k, 0) : max(r + k + 1, 0), max(c - k, 0) : max(c + k + 1, 0)].max(initial=UNKNOWN))
                for k in (reach, near)
            )
            rivals = [p.z for p in peaks if np.hypot(p.row - r, p.column - c) > near]
            # What is better beside it counts against it, and not for it.
            track.looked_at(here - max(rivals, default=UNKNOWN) - (beside_it - here), wide=wide)
