"""Global localization: joint correlations of the last frames propose places, tracks of camera poses decide between
them.

A joint correlation compares the mosaic of the last frames with every cell of a region. Its best places become tracks,
and the lead of a track over all other places is evidence. The region grows in steps of whole blocks around the last
believed position, up to the whole map.
"""

from dataclasses import dataclass

import numpy as np

from terrafix.anchor.matching.frame_matcher import FrameMatcher, Hypothesis, View
from terrafix.anchor.matching.ncc import standardise
from terrafix.anchor.place_index.recognizer import PlaceRecognizer
from terrafix.anchor.relocalization.block_search import BLOCK_CELLS, Block, BlockCorrelator, blocks_of, select_blocks
from terrafix.anchor.relocalization.mosaic import Mosaic
from terrafix.anchor.relocalization.peaks import UNKNOWN, Peak, find_peaks
from terrafix.anchor.verification.hypothesis_tracker import (
    MERGE_RADIUS,
    NEIGHBOUR_RADIUS,
    NEW_EVIDENCE,
    AcceptedPlace,
    HypothesisTracker,
)
from terrafix.core.node import Image
from terrafix.map.null_model import FalseAlarmBudget, NullRow
from terrafix.map.package import LocalMap
from terrafix.messages import SearchStep
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_engines.retrieval.pooled import PooledGradientDescriber
from terrafix_engines.runtime import ModelRunError

# Cells and number of hypotheses up to which dense gradients on small cells are used; they discriminate best. With more
# hypotheses or a larger map, gradients pooled over larger cells are used: they tolerate yaw errors of some degrees.
# [measured: docs/search.md]
SEARCH_CELL_PER_AGL, FINE_HYPOTHESES = 1 / 50, 25
POOLED_CELL_PER_AGL = 1 / 20  # pooled cell as a share of the height [measured: docs/search.md]
# Largest cells x yaws x scales of one joint correlation, about 2 s of one core; a larger map is correlated on larger
# cells [measured: docs/search.md]
MAX_WORK = 35e6
CORRELATION_INTERVAL = 0.15  # share of the height: motion between two joint correlations [tuned]
VERIFICATION_INTERVAL = 0.03  # share of the height: motion between two comparisons of the tracks with a frame [tuned]
# Share of the height: motion after which a joint correlation counts as new; one whose mosaic is that long is a wide one
# [tuned]
NEW_GROUND = 0.6
REGION_BLOCKS = (1, 4, 9, 16, 25)  # blocks of each step of the search, nearest first; then the whole map [tuned]
# joint correlations (full new ground) without a confirmed track before the next step [tuned]
CORRELATIONS_PER_REGION = 0.5
CORRELATIONS_TO_ASK = 6.0  # joint correlations of the whole map before the operator is asked for a position [tuned]
# share of the height: frames whose relative position by odometry has a larger 1-sigma are not joined [tuned]
MAX_JOIN_SIGMA = 0.06
# share of the height: a step with a larger 1-sigma counts as path, because the ground may have changed; below it, noise
# of hovering does not count [tuned]
UNCERTAIN_STEP = 0.1
# heights: frames farther apart are not joined; the cost grows with the size of the mosaic [tuned]
MAX_JOIN_DISTANCE = 2.0
MAX_PROPOSALS = 12  # places that one joint correlation may propose [tuned]
# number of these, from the best, that also propose the best place beside them [measured: docs/search.md]
NEIGHBOUR_PROPOSALS = 4
LEAD_SEARCH_RADIUS = 0.2  # share of the height: search radius for a track's own value in the joint correlation [tuned]


@dataclass(frozen=True)
class ProposedPlace:
    """Camera position (local east, north) that a joint correlation proposes, with its yaw and scale."""

    e_m: float
    n_m: float
    hypothesis: Hypothesis


class MapSearch:
    def __init__(
        self,
        source: LocalMap,
        matcher: FrameMatcher,
        agl_m: float,
        around_m: tuple[float, float] | None,
        null: NullRow,
        budget: FalseAlarmBudget,
        recognizer: PlaceRecognizer | None = None,
    ) -> None:
        """``around_m``: last believed position (local east, north) around which the search begins; None: the whole map.
        ``null``: null model of the map at this height; ``budget``: false-alarm budget of the flight, of which every
        stretch of new ground spends a share. ``recognizer``: selects the blocks of a map that is too large for small
        cells; None: such a map is correlated on larger cells."""
        self._map = source
        self._matcher = matcher
        self.agl_m = agl_m
        self._around_m = around_m
        self._region = 0 if around_m is not None else len(REGION_BLOCKS)
        self._region_weight = 0.0
        self._blocks: list[Block] = []
        self._cell_m = 0.0
        self._hypotheses: tuple[Hypothesis, ...] = ()
        self._mosaic = Mosaic((), 1.0)
        self._recognizer = recognizer
        self._max_blocks = 0  # number of blocks that one joint correlation can afford
        self._null = null
        self._budget = budget
        self.tracker = HypothesisTracker(matcher, null.patches)
        self.proposed: list[ProposedPlace] = []  # best places of the last joint correlation, best first
        self._p_m = np.zeros(2)  # position by odometry since the search began
        self._var_m2 = 0.0
        self._path_m = 0.0  # length flown since the search began
        self._correlated_path_m = self._verified_path_m = self._decided_path_m = -np.inf

    @property
    def step(self) -> SearchStep:
        if self._region < len(REGION_BLOCKS) and (not self._blocks or self.block_count < len(self._blocks)):
            return SearchStep.WIDEN
        return SearchStep.ASK if self._region_weight >= CORRELATIONS_TO_ASK else SearchStep.WHOLE_MAP

    @property
    def block_count(self) -> int:
        """Number of blocks that are searched."""
        return (
            min(REGION_BLOCKS[self._region], len(self._blocks))
            if self._region < len(REGION_BLOCKS)
            else len(self._blocks)
        )

    @property
    def tiles(self) -> int | None:
        """Number of blocks that are searched around the last position; None: the whole map, or nothing yet."""
        return self.block_count if self.step is SearchStep.WIDEN and self._blocks else None

    @property
    def cell_m(self) -> float:
        """Side of a cell of the joint correlation; 0: there was none yet."""
        return self._cell_m

    def predict(self, east_m: float, north_m: float, sigma_m: float) -> None:
        """Prediction by odometry. A step with a large 1-sigma adds to the path, because the ground may differ. After a
        step with a 1-sigma above the neighbour radius all tracks are dropped: their evidence belongs to other
        ground."""
        self._p_m += (east_m, north_m)
        self._var_m2 += sigma_m**2
        self._path_m += float(
            np.hypot(np.hypot(east_m, north_m), sigma_m if sigma_m > UNCERTAIN_STEP * self.agl_m else 0.0)
        )
        self.tracker.predict(np.array([east_m, north_m]))
        if sigma_m > NEIGHBOUR_RADIUS * self.agl_m:
            self.tracker.tracks = []

    def process_frame(self, image: Image, view: View) -> AcceptedPlace | None:
        """Processes one frame. ``view``: height, attitude and their uncertainty; its position is not used."""
        if self._path_m - self._correlated_path_m >= CORRELATION_INTERVAL * view.agl_m:
            self.correlate_region(image, view)
        if self._path_m - self._verified_path_m < VERIFICATION_INTERVAL * view.agl_m:
            return None
        self._verified_path_m = self._path_m
        if self._path_m - self._decided_path_m >= NEW_EVIDENCE * view.agl_m:
            self._decided_path_m = self._path_m
            self._budget.spend()
        return self.tracker.update(image, view, self._path_m, self.required_evidence)

    @property
    def required_evidence(self) -> float:
        """Evidence in nats that a track must have to be accepted, at this point of the flight."""
        return self._null.detection_threshold(self.candidate_count, self._budget.log_probability)

    @property
    def candidate_count(self) -> float:
        """Number of places among which the best wrong one is selected: cells of neighbour radius over the map, times
        yaws and scales."""
        e_min, n_min, e_max, n_max = self._map.bounds_m
        area = (e_max - e_min) * (n_max - n_min) / (NEIGHBOUR_RADIUS * self.agl_m) ** 2
        return max(area, 1.0) * max(len(self._hypotheses), 1)

    def correlate_region(self, image: Image, view: View) -> None:
        """Joint correlation of the frame and those before with the region: new tracks, and the leads of all."""
        if not self._blocks:
            self._initialize(view)
        stride = self._correlator.stride
        grey = self._matcher.pyramid(image, self._matcher.gradients)
        frames = self._matcher.rectify_all(grey, view, self._hypotheses, self._cell_m / stride, stride)
        templates = [self._correlator.describe(frame) for frame in frames if frame is not None]
        if len(templates) < len(frames):
            return
        blocks = self._blocks_to_correlate(image, view)
        if not blocks:
            return
        new = min((self._path_m - self._correlated_path_m) / (NEW_GROUND * view.agl_m), 1.0)
        self._correlated_path_m = self._path_m
        self._mosaic.add(
            self._p_m, self._var_m2, templates, MAX_JOIN_SIGMA * view.agl_m, MAX_JOIN_DISTANCE * view.agl_m
        )
        correlation = np.full(self._shape, np.nan, np.float32)
        index = np.zeros(self._shape, np.uint8)
        results = self._correlator.correlate(self._mosaic.templates(), blocks, self._cell_m)
        for block, found in zip(blocks, results, strict=True):
            at = self._cells(block)
            correlation[at], index[at] = found.correlation, found.index
        self._update_tracks(np.nan_to_num(standardise(correlation), nan=UNKNOWN), index, view.agl_m)
        self._region_weight += new
        has_confirmed = any(track.frames for track in self.tracker.tracks)
        if (
            self.block_count < len(self._blocks)
            and self._region_weight >= CORRELATIONS_PER_REGION
            and not has_confirmed
        ):
            self._region, self._region_weight = self._region + 1, 0.0

    def _blocks_to_correlate(self, image: Image, view: View) -> list[Block]:
        """Blocks of the region; of a region that one joint correlation cannot afford those of the tracks, then those
        that the place index proposes. Raises ModelRunError: its model has failed; then the next frames are searched
        without the index, on larger cells."""
        region = self._blocks[: self.block_count]
        if self._recognizer is None or len(region) <= self._max_blocks:
            return region
        try:
            candidates = self._recognizer.candidates(image, view, self._hypotheses, self._matcher)
        except ModelRunError:
            self._recognizer, self._blocks, self.tracker.tracks = None, [], []
            raise
        places = [(track.e_m, track.n_m) for track in self.tracker.tracks]
        places += [(candidate.e_m, candidate.n_m) for candidate in candidates]
        return select_blocks(places, region, self._cell_m, self._max_blocks)

    def _index_fits(self, view: View) -> bool:
        return self._recognizer is not None and self._recognizer.fits(view, self._hypotheses, self._matcher)

    def _initialize(self, view: View) -> None:
        self._hypotheses = self._matcher.map_search_hypotheses(view)
        e_min, n_min, e_max, n_max = self._map.bounds_m
        places_m2 = (e_max - e_min) * (n_max - n_min) * len(self._hypotheses)
        cell_m = self._matcher.cell_m(view.agl_m, SEARCH_CELL_PER_AGL)
        if len(self._hypotheses) <= FINE_HYPOTHESES and places_m2 / cell_m**2 <= MAX_WORK:
            self._correlator = BlockCorrelator(self._map, GradientDescriber())
        else:
            self._correlator = BlockCorrelator(self._map, PooledGradientDescriber())
            stride = self._correlator.stride
            cell_m = self._correlator.cell_m(stride * self._matcher.cell_m(view.agl_m, POOLED_CELL_PER_AGL / stride))
            if places_m2 / cell_m**2 <= MAX_WORK or not self._index_fits(view):
                self._recognizer = None
            while places_m2 / cell_m**2 > MAX_WORK and self._recognizer is None:
                cell_m *= 2.0  # the next octave of the map
        self._cell_m = cell_m
        self._max_blocks = max(int(MAX_WORK / (len(self._hypotheses) * BLOCK_CELLS**2)), 1)
        blocks = blocks_of(self._map.bounds_m, cell_m)
        self._row0, self._column0 = min(b.row for b in blocks), min(b.column for b in blocks)
        rows = max(b.row for b in blocks) - self._row0 + BLOCK_CELLS
        columns = max(b.column for b in blocks) - self._column0 + BLOCK_CELLS
        self._shape = (rows, columns)
        self._mosaic = Mosaic(self._hypotheses, cell_m)
        e_m, n_m = self._around_m or (0.5 * (e_min + e_max), 0.5 * (n_min + n_max))
        half = BLOCK_CELLS / 2

        def distance_m(block: Block) -> float:
            return float(np.hypot((block.column + half) * cell_m - e_m, -(block.row + half) * cell_m - n_m))

        self._blocks = sorted(blocks, key=distance_m)

    def _cells(self, block: Block) -> tuple[slice, slice]:
        r, c = block.row - self._row0, block.column - self._column0
        return slice(r, r + BLOCK_CELLS), slice(c, c + BLOCK_CELLS)

    def _update_tracks(self, z: np.ndarray, index: np.ndarray, agl_m: float) -> None:
        """Proposes the best places of the joint correlation as tracks and updates the lead of every track."""
        near, same, radius = (
            max(round(share * agl_m / self._cell_m), 1)
            for share in (NEIGHBOUR_RADIUS, MERGE_RADIUS, LEAD_SEARCH_RADIUS)
        )
        peaks, beside = find_peaks(z, MAX_PROPOSALS, near, NEIGHBOUR_PROPOSALS, same)
        self.proposed = [self._place_of(peak, index) for peak in peaks if peak.z > UNKNOWN]
        for peak in (*peaks, *beside):
            if peak.z > UNKNOWN:
                place = self._place_of(peak, index)
                self.tracker.propose(place.e_m, place.n_m, place.hypothesis, agl_m)
        wide = self._mosaic.length_m >= NEW_GROUND * agl_m
        for track in self.tracker.tracks:
            r = round(-track.n_m / self._cell_m - 0.5) - self._row0
            c = round(track.e_m / self._cell_m - 0.5) - self._column0
            here, beside_it = (
                float(z[max(r - k, 0) : max(r + k + 1, 0), max(c - k, 0) : max(c + k + 1, 0)].max(initial=UNKNOWN))
                for k in (radius, near)
            )
            rivals = [p.z for p in peaks if np.hypot(p.row - r, p.column - c) > near]
            # A better value beside the track counts against it.
            track.add_lead(here - max(rivals, default=UNKNOWN) - (beside_it - here), wide=wide)

    def _place_of(self, peak: Peak, index: np.ndarray) -> ProposedPlace:
        e_m = (peak.column + self._column0 + 0.5) * self._cell_m
        n_m = -(peak.row + self._row0 + 0.5) * self._cell_m
        return ProposedPlace(e_m, n_m, self._hypotheses[int(index[peak.row, peak.column])])
