"""Matching of one frame with the map: the correlation surface over a search window, then 2D-3D matches around the mode
that the belief selects."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np

from terrafix.anchor.matching.descriptor_cache import DESCRIPTOR_CACHE_BYTES, Describer, MapFeatures
from terrafix.anchor.matching.descriptor_store import DescriptorStore
from terrafix.anchor.matching.ncc import CorrelationWindow, standardise
from terrafix.anchor.matching.orthorectify import Pyramid, Rectified, Relief, patch_centres, rays_to, rectify
from terrafix.anchor.matching.patch_matcher import SearchedMap, match_patches
from terrafix.anchor.matching.point_mass_filter import BELIEF_LLR_ZERO_Z, Surface
from terrafix.core.agreement import NATS_PER_SCORE
from terrafix.core.camera import CameraCalibration
from terrafix.core.geodesy import local_rotation_up, quat_from_rot
from terrafix.core.node import Image
from terrafix.core.pnp import (
    INDEPENDENT_MATCH_SHARE,
    INLIER_THRESHOLD,
    PNP_MIN_INLIERS,
    POSE_CUTOFF,
    SEARCH_RADIUS,
    PnpResult,
    solve,
)
from terrafix.core.pose import biweight, fit_pose
from terrafix.map.package import LocalMap
from terrafix.messages import PnpInput, Verdict
from terrafix_engines.correlation import GraphCorrelator
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_engines.retrieval.pooled import PooledDescriber

# Ground sampling distance of the correlation as a share of the height: coarse enough for speed and for tolerance to
# small changes, fine enough for houses and kerbs. [tuned]
CORRELATION_GSD_PER_AGL = 1 / 100
OWN = "own"  # name of the describer with weights of docs/training.md
# ground sampling distance of the patches as a share of the height [tuned]
FIX_GSD_PER_AGL = {"gradient": 1 / 200, "xfeat": 1 / 330, OWN: 1 / 170}
GSD_STEPS_PER_OCTAVE = 2  # Scales are rounded to this grid, so that the map's descriptors can be cached [tuned]
# Side of a correlation window; a wider one is correlated on coarser cells, which bounds the cost of a look with a wide
# belief. [measured: docs/decisions/047-cells-of-a-look.md]
MAX_WINDOW_CELLS = 640
# Largest side of a cell of means, pixels: twice as many divide a tile of the map and its rim
# [spec: Describer.context_px]
MAX_STRIDE = 16
# Hypotheses of yaw and scale of one look. Of more, cells twice as large select as many: between two of them the border
# of a frame is several cells from its place anyway. [measured: docs/decisions/047-cells-of-a-look.md]
MAX_FINE_HYPOTHESES = 9
# side of a patch as a share of the height: 25 m at 100 m, one house and its surroundings [measured: docs/search.md]
PATCH_PER_AGL = 0.25
PATCH_STEP = PATCH_PER_AGL / 2  # between patches, normalised [spec: they overlap by half]
MIN_PATCH_CELLS = 8  # smallest side of a patch, cells [tuned]
# Fewest inliers of a pose on learned descriptors. A cell of a learned model has a receptive field of a hundred pixels,
# so that errors of neighbours are correlated. With 14 inliers required, 5 of 560 frames from other places had a pose;
# with 20, none of 640. At right places 15 to 48 patches agree. [measured: this comment]
LEARNED_INLIERS = 20
# search radius and inlier threshold of the first pass while the tilt is not known, shares of the height [tuned]
FIRST_SEARCH_RADIUS, FIRST_THRESHOLD = 0.2, 0.05
KNOWN_TILT_RAD = np.radians(3.0)  # 1-sigma of the tilt above which the two-pass search is used [tuned]
# Rotation and scale hypotheses are used when the 1-sigma range exceeds what the descriptors tolerate. [tuned]
YAW_TOLERANCE_RAD = np.radians(4.0)
YAW_STEP_RAD = np.radians(7.0)  # between yaw hypotheses [tuned]
SCALE_TOLERANCE = 0.05  # as YAW_TOLERANCE_RAD, for the scale of the height, relative [tuned]
SCALE_STEP = 0.08  # between scale hypotheses, relative [tuned]
# largest steps of yaw and scale on the coarse cells of a search over the whole map [tuned]
MAX_YAW_STEP_RAD, MAX_SCALE_STEP = np.radians(13.0), 0.10
MAX_HYPOTHESES = 81  # number of hypotheses that one frame can afford [tuned]
# Share of the height: flatter ground is projected as a plane [spec: two cells of a patch, seen at 45 degrees]
LEVEL_RELIEF = 0.01
# Share of the height: 1-sigma of a position from which on a frame is not projected on the ground there
# [spec: that from which on the estimator does not know its place]
RELIEF_SIGMA = 0.5
RELIEF_SAMPLES = np.mgrid[-3:4, -3:4].reshape(2, -1).T / 3  # heights from the point below [spec: sevenths of a side]
MIN_SIDE_CELLS = 24  # smallest side of the orthorectified frame [tuned]


@dataclass(frozen=True)
class View:
    """Predicted camera: position, rotation and height above ground, with 1-sigma values."""

    e_m: float
    n_m: float
    r_w_c: np.ndarray
    agl_m: float
    ground_m: float  # AMSL
    yaw_sigma_rad: float
    scale_sigma: float  # of the height above ground, relative
    tilt_sigma_rad: float
    sigma_m: float = math.inf  # of the position, horizontal; 0 where the frame is to be tried


class SearchWindow(Protocol):
    """Square of candidate camera positions, local metres. ``Belief`` implements it."""

    @property
    def centre(self) -> tuple[float, float]: ...

    @property
    def half_m(self) -> float: ...


@dataclass(frozen=True)
class Hypothesis:
    """Relative to a ``View``. ``stretch``: focal lengths in x and y over the described ones."""

    yaw_rad: float
    scale: float
    stretch: tuple[float, float] = (1.0, 1.0)


AS_PREDICTED = Hypothesis(0.0, 1.0)  # the zero hypothesis [spec: identity]


@dataclass(frozen=True)
class CorrelationResult:
    """``evidence_nats``: that ``Belief.update`` returns for a full observation, where layers are compared by it."""

    verdict: Verdict
    surfaces: tuple[Surface, ...] = ()
    hypotheses: tuple[Hypothesis, ...] = ()
    footprint_m: float = 1.0
    cell_m: float = 1.0
    evidence_nats: float = -math.inf

    def best_at(self, e_m: float, n_m: float) -> tuple[Hypothesis, float]:
        """Hypothesis with the highest standardised correlation within two cells of a camera position, and that
        correlation."""
        best, (score, _, _) = self._peak_at(e_m, n_m)
        return self.hypotheses[best], score

    def is_mapped_at(self, e_m: float, n_m: float) -> bool:
        """Whether a feature is mapped where ``best_at`` finds the highest correlation."""
        best, (_, there_e_m, there_n_m) = self._peak_at(e_m, n_m)
        return self.surfaces[best].is_mapped(there_e_m, there_n_m)

    def _peak_at(self, e_m: float, n_m: float) -> tuple[int, tuple[float, float, float]]:
        """Index of the surface with the highest correlation within two cells, and this with its east and north."""
        peaks = [s.best(e_m, n_m, 2.0 * self.cell_m) for s in self.surfaces]
        best = int(np.argmax([score for score, _, _ in peaks]))
        return best, peaks[best]

    def best_hypotheses(self, count: int) -> tuple[Hypothesis, ...]:
        """The ``count`` hypotheses with the highest standardised correlation anywhere, in their order."""
        chosen = sorted(np.argsort(self.scores)[-count:].tolist())
        return tuple(self.hypotheses[i] for i in chosen)

    @property
    def scores(self) -> list[float]:
        """The highest standardised correlation of each hypothesis."""
        return [float(np.nan_to_num(surface.z, nan=-np.inf).max()) for surface in self.surfaces]

    def with_second(self, other: "CorrelationResult") -> "CorrelationResult":
        """Each surface, standardised anew after that of the same hypothesis in ``other`` was added; NaN where either is
        unknown. This result alone if ``other`` lacks a hypothesis."""
        others = dict(zip(other.hypotheses, other.surfaces, strict=True))
        if not others.keys() >= set(self.hypotheses):
            return self
        both = zip(self.surfaces, self.hypotheses, strict=True)
        return replace(self, surfaces=tuple(_sum(surface, others[hypothesis]) for surface, hypothesis in both))

    def scale_at(self, e_m: float, n_m: float) -> tuple[float, float] | None:
        """Scale of the height measured at a camera position, as (mean, variance), from the likelihoods of the scales
        that were correlated. None: the scales do not discriminate, or the best one is at the end of the grid, so that
        the true scale may lie beyond it."""
        z: dict[float, float] = {}
        for surface, hypothesis in zip(self.surfaces, self.hypotheses, strict=True):
            z[hypothesis.scale] = max(z.get(hypothesis.scale, -np.inf), surface.at(e_m, n_m, 2.0 * self.cell_m))
        scales = np.array(sorted(z))
        scores = np.array([z[s] for s in scales])
        if int(np.argmax(scores)) in (0, len(scales) - 1):
            return None
        likelihood = np.exp(NATS_PER_SCORE * (scores - scores.max()))
        likelihood /= likelihood.sum()
        mean = float(likelihood @ scales)
        # Remove the information of the grid itself ("one of these scales"): the prediction chose it.
        information = 1.0 / float(likelihood @ (scales - mean) ** 2 + SCALE_STEP**2 / 12)
        information -= 1.0 / float(np.var(scales) + SCALE_STEP**2 / 12)
        return (mean, 1.0 / information) if information > 0.0 else None


@dataclass(frozen=True)
class PatchFix:
    """2D-3D matches of one frame and the pose from them. ``xy`` (N, 2): normalised image coordinates; ``points_w_m``
    (N, 3): map points, local east, north and AMSL height; ``weights`` (N,); ``cell_m``: cell size of the patches;
    ``given``: with which PnP has computed ``pnp``; None: another method has. ``refined``: matched again from the pose
    of a first pass."""

    xy: np.ndarray
    points_w_m: np.ndarray
    weights: np.ndarray
    pnp: PnpResult
    cell_m: float
    given: PnpInput | None = None
    refined: bool = False


class FrameMatcher:
    """Matches frames with one map layer. ``cache_bytes``: memory for the map's descriptors; ``store``: file store that
    keeps them for the next process; ``drawn``: the layer is drawn from roads, water and buildings; ``correlator``: on
    a GPU."""

    def __init__(
        self,
        camera: CameraCalibration,
        source: LocalMap,
        describer: Describer,
        cache_bytes: int = DESCRIPTOR_CACHE_BYTES,
        store: DescriptorStore | None = None,
        drawn: bool = False,
        correlator: GraphCorrelator | None = None,
    ) -> None:
        self.camera = camera
        self._drawn = drawn
        self._correlator = correlator
        self._map = source
        self._describer = describer
        self._subset = 0
        self._features = MapFeatures(source, describer, cache_bytes, store=store)
        self._image: Image | None = None  # the newest one, and its pyramids, in colour and in grey
        self._pyramids: dict[bool, Pyramid] = {}
        self._by_pool: dict[tuple[str, int], MapFeatures] = {}
        self._cache_bytes, self._store = cache_bytes, store
        # Correlation is on gradients, and where the position is not known on weights of one's own as well. The model
        # describes patches where those of gradients give no pose.
        self.gradients = describer if describer.stride == 1 else GradientDescriber()
        self.gradient_features = (
            self._features if describer.stride == 1 else MapFeatures(source, self.gradients, cache_bytes, store=store)
        )

    def correlation_cell_m(self, agl_m: float) -> float:
        return self.cell_m(agl_m, CORRELATION_GSD_PER_AGL)

    def cell_m(self, agl_m: float, per_agl: float) -> float:
        """Cell size in metres for a share of the height, rounded to half octaves; not finer than the map or the
        frame."""
        wanted = max(self._map.gsd_m, agl_m / self.camera.fx, agl_m * per_agl)
        return float(2.0 ** (round(np.log2(wanted) * GSD_STEPS_PER_OCTAVE) / GSD_STEPS_PER_OCTAVE))

    def map_search_hypotheses(self, view: View) -> tuple[Hypothesis, ...]:
        """Yaw and scale hypotheses for a search over the whole map, spread evenly over 1.5 sigmas."""
        yaws = _spread(min(1.5 * view.yaw_sigma_rad, np.pi), YAW_TOLERANCE_RAD, MAX_YAW_STEP_RAD)
        scales = [1.0 + s for s in _spread(min(1.5 * view.scale_sigma, 0.5), SCALE_TOLERANCE, MAX_SCALE_STEP)]
        return _product(yaws, scales)

    def ground_at(self, points_m: np.ndarray, otherwise_m: float) -> np.ndarray:
        """(N,) heights AMSL of map points (N, 2), east and north; ``otherwise_m`` where the map knows none."""
        up_m = self._map.elevation(*points_m.T) if len(points_m) else None
        known = np.full(len(points_m), np.nan) if up_m is None else up_m
        return np.where(np.isfinite(known), known, otherwise_m)

    def relief(self, view: View) -> Relief | None:
        """Of the ground below ``view`` over a plane at ``view.ground_m``. None: it is level, or not known: elsewhere in
        a wide window the ground is another one."""
        if not view.sigma_m < RELIEF_SIGMA * view.agl_m:
            return None

        def above_m(points_m: np.ndarray) -> np.ndarray:
            return self.ground_at(np.add(points_m, (view.e_m, view.n_m)), view.ground_m) - view.ground_m

        is_level = np.abs(above_m(RELIEF_SAMPLES * view.agl_m)).max() < LEVEL_RELIEF * view.agl_m
        return None if is_level else above_m

    def rectify_all(
        self, image: Image | Pyramid, view: View, hypotheses: Sequence[Hypothesis], gsd_m: float, stride: int
    ) -> list[Rectified | None]:
        """Orthorectified frames, one per hypothesis; None where the camera sees no ground."""
        relief = self.relief(view)
        turned = [view_at(view, one, view.e_m, view.n_m) for one in hypotheses]
        return [
            rectify(image, self._stretched(one.stretch), at.r_w_c, at.agl_m, gsd_m, stride, relief)
            for one, at in zip(hypotheses, turned, strict=True)
        ]

    def pyramid(self, image: Image, describer: Describer) -> Pyramid:
        """Of ``image`` (H, W, 3), in grey if ``describer`` needs no colour; computed once for the newest image."""
        if image is not self._image:
            self._image, self._pyramids = image, {}
        grey = describer.grayscale
        if grey not in self._pyramids:
            self._pyramids[grey] = Pyramid(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if grey else image)
        return self._pyramids[grey]

    def _stretched(self, stretch: tuple[float, float]) -> CameraCalibration:
        return replace(self.camera, fx=stretch[0] * self.camera.fx, fy=stretch[1] * self.camera.fy)

    def correlate(self, image: Image, view: View, belief: SearchWindow) -> CorrelationResult:
        """Correlation surfaces over the search window, one per yaw and scale hypothesis within the uncertainty of
        ``view``.

        Verdict TOO_LOW: the frame covers too few cells or sees no ground; OUTSIDE_MAP: no map data in the window.
        """
        hypotheses = self._next_subset(hypotheses_of(view))
        # Of a drawn map, which says little, every hypothesis counts: the belief itself searches it.
        if len(hypotheses) > MAX_FINE_HYPOTHESES and not self._drawn:
            gsd, pool = bounded_cells(self.correlation_cell_m(view.agl_m), 1, belief)
            coarse = self.correlate_on(self.pyramid(image, self.gradients), view, belief, hypotheses, gsd, 2 * pool)
            if coarse.verdict is Verdict.ACCEPTED:
                hypotheses = coarse.best_hypotheses(MAX_FINE_HYPOTHESES)
        return self.correlate_as(image, view, belief, hypotheses)

    def correlate_as(
        self, image: Image, view: View, belief: SearchWindow, hypotheses: tuple[Hypothesis, ...]
    ) -> CorrelationResult:
        """``correlate`` with given hypotheses."""
        gsd, pool = bounded_cells(self.correlation_cell_m(view.agl_m), 1, belief)
        pyramid = self.pyramid(image, self.gradients)
        if self._drawn:  # its lines are as clear on larger pixels
            return self.correlate_on(pyramid, view, belief, hypotheses, gsd * pool)
        return self._with_learned(self.correlate_on(pyramid, view, belief, hypotheses, gsd, pool), image, view, belief)

    def _with_learned(
        self, found: CorrelationResult, image: Image, view: View, belief: SearchWindow
    ) -> CorrelationResult:
        """``found``, by gradients, with weights of one's own as second channel where the position is not known.
        [measured: docs/decisions/074-weights-that-ship.md]"""
        if self._describer.name != OWN or view.sigma_m < RELIEF_SIGMA * view.agl_m:
            return found
        return found.with_second(self.correlate_learned(image, view, belief, found.hypotheses))

    def correlate_learned(
        self, image: Image, view: View, belief: SearchWindow, hypotheses: tuple[Hypothesis, ...]
    ) -> CorrelationResult:
        """``correlate`` with the descriptors of the model."""
        gsd = self.cell_m(view.agl_m, FIX_GSD_PER_AGL[self._describer.name])
        cells = bounded_cells(gsd, self._describer.stride, belief)
        pyramid = self.pyramid(image, self._describer)
        return self.correlate_on(pyramid, view, belief, hypotheses, *cells, self._describer)

    def correlate_on(
        self,
        image: Pyramid,
        view: View,
        belief: SearchWindow,
        hypotheses: tuple[Hypothesis, ...],
        gsd: float,
        pool: int = 1,
        learned: Describer | None = None,
    ) -> CorrelationResult:
        """``correlate`` with given hypotheses. ``image``: grey where that is enough; ``gsd``: metres, of the pixels
        that are described; ``pool``: cells of the describer in a side of those that are correlated; ``learned``: the
        describer of this matcher, instead of the gradients."""
        features = self._pooled(learned or self.gradients, pool)
        describer = features.describer
        cell = gsd * describer.stride
        cells = gsd, describer.stride
        wanted = tuple(dict.fromkeys((AS_PREDICTED, *hypotheses)))
        frames = dict(zip(wanted, self.rectify_all(image, view, wanted, *cells), strict=True))
        first = frames[AS_PREDICTED]
        if first is None or min(first.mask.shape) < describer.stride * MIN_SIDE_CELLS / 2:
            return CorrelationResult(Verdict.TOO_LOW)
        footprint_m = float(np.sqrt(first.mask.sum())) * gsd
        usable = [(h, f) for h in hypotheses if (f := frames[h]) is not None]
        extents = [self._extent(f) for _, f in usable]
        e_min = belief.centre[0] - belief.half_m + min(r[0] for r in extents)
        n_max = belief.centre[1] + belief.half_m + max(r[1] for r in extents)
        width = int((2 * belief.half_m + max(r[2] for r in extents) - min(r[0] for r in extents)) / cell) + 2
        height = int((2 * belief.half_m + max(r[1] for r in extents) - min(r[3] for r in extents)) / cell) + 2
        descriptors, valid, e_min, n_max = features.window(e_min, n_max, width, height, gsd)
        if not valid.any():
            return CorrelationResult(Verdict.OUTSIDE_MAP)
        window = CorrelationWindow(descriptors, valid, self._drawn, self._correlator if learned is None else None)
        correlations = window.correlate_all([_describe(frame, describer) for _, frame in usable])
        surfaces = []
        for (_, frame), correlation in zip(usable, correlations, strict=True):
            z = standardise(correlation)
            # Places without a mapped feature are neither excluded nor preferred: they are as frequent among right
            # places as among all (docs/decisions/042-vectors-as-a-layer.md).
            unmapped = np.isneginf(correlation) if self._drawn else None
            if unmapped is not None:
                z[unmapped] = BELIEF_LLR_ZERO_Z
            surfaces.append(Surface(z, e_min - frame.e_min_m, n_max - frame.n_max_m, cell, unmapped))
        if not any(np.isfinite(s.z).any() for s in surfaces):
            return CorrelationResult(Verdict.OUTSIDE_MAP)
        return CorrelationResult(Verdict.ACCEPTED, tuple(surfaces), tuple(h for h, _ in usable), footprint_m, cell)

    def fix(self, image: Image, view: View, hypothesis: Hypothesis, e_m: float, n_m: float) -> PatchFix | None:
        """2D-3D matches around a camera position (local east and north) and the PnP pose. None: the camera sees no
        ground.

        If the tilt is not well known, two passes are made: a wide search with a large inlier threshold, then a narrow
        search on the frame rectified with the pose of the first pass.
        """
        start = view_at(view, hypothesis, e_m, n_m)
        found = self._fix_with(self.gradients, image, start)
        if self._describer is self.gradients or (found is not None and found.pnp.verdict is Verdict.ACCEPTED):
            return found
        # Cells of a learned model are coarser, but it matches more patches where the ground has changed or buildings
        # lean.
        return self._fix_with(self._describer, image, start)

    def _fix_with(self, describer: Describer, image: Image, view: View) -> PatchFix | None:
        if view.tilt_sigma_rad > KNOWN_TILT_RAD:
            first = self._patch_fix(describer, image, view, FIRST_SEARCH_RADIUS, FIRST_THRESHOLD)
            if first is None or first.pnp.fit is None:
                return first
            second = self._patch_fix(describer, image, levelled_view(view, first), SEARCH_RADIUS, INLIER_THRESHOLD)
            return None if second is None else replace(second, refined=True)
        return self._patch_fix(describer, image, view, SEARCH_RADIUS, INLIER_THRESHOLD)

    def refine_fix(self, image: Image, view: View, fix: PatchFix) -> PatchFix:
        """Pose of a place that a search has found, recomputed on the cells of normal tracking; ``fix`` itself if that
        is not accepted."""
        if fix.pnp.fit is None:
            return fix
        finer = self._patch_fix(self.gradients, image, view_of_fix(view, fix), SEARCH_RADIUS, INLIER_THRESHOLD)
        if finer is None or finer.pnp.verdict is not Verdict.ACCEPTED:
            return fix
        return replace(finer, refined=True)

    def _patch_fix(
        self, describer: Describer, image: Image, view: View, radius_share: float, threshold: float
    ) -> PatchFix | None:
        gsd = self.cell_m(view.agl_m, FIX_GSD_PER_AGL[describer.name])
        cell = gsd * describer.stride
        (frame,) = self.rectify_all(self.pyramid(image, describer), view, (AS_PREDICTED,), gsd, describer.stride)
        if frame is None:
            return None
        radius = max(int(np.ceil(radius_share * view.agl_m / cell)), 3)
        patch = max(round(PATCH_PER_AGL * view.agl_m / cell), MIN_PATCH_CELLS)
        template, mask = _describe(frame, describer)
        margin = (radius + 2) * cell
        e_min, n_max = view.e_m + frame.e_min_m - margin, view.n_m + frame.n_max_m + margin
        width, height = mask.shape[1] + 2 * radius + 4, mask.shape[0] + 2 * radius + 4
        features = self.gradient_features if describer is self.gradients else self._features
        cells, valid, e_min, n_max = features.window(e_min, n_max, width, height, gsd)
        searched = SearchedMap(cells, valid, (e_min, n_max))
        centres = patch_centres(self.camera, view.r_w_c, view.agl_m, frame, cell, PATCH_STEP)
        found = match_patches(template, frame, mask, cell, searched, (view.e_m, view.n_m), patch, radius, centres)
        rays = rays_to(found.frame_m, view.agl_m, view.r_w_c, self.relief(view))
        xy = rays[:, :2] / rays[:, 2:]
        points = np.column_stack([found.map_m, self.ground_at(found.map_m, view.ground_m)])
        given = PnpInput(
            q_w_c=quat_from_rot(view.r_w_c),
            agl_m=view.agl_m,
            sigma_floor=0.3 * cell / view.agl_m,  # a third of a cell: accuracy of sub-cell interpolation of the peak
            threshold=threshold,
            search_radius=radius * cell / view.agl_m,
            min_inliers=PNP_MIN_INLIERS if describer.stride == 1 else LEARNED_INLIERS,
        )
        return PatchFix(xy, points, found.weight, solve(points, xy, found.weight, given), cell, given)

    def _pooled(self, describer: Describer, pool: int) -> MapFeatures:
        """The map's descriptors, averaged over squares of ``pool`` cells."""
        if pool == 1:
            return self.gradient_features if describer is self.gradients else self._features
        key = describer.name, pool
        if key not in self._by_pool:
            mean = PooledDescriber(describer, pool)
            self._by_pool[key] = MapFeatures(self._map, mean, self._cache_bytes, store=self._store)
        return self._by_pool[key]

    def _next_subset(self, hypotheses: tuple[Hypothesis, ...]) -> tuple[Hypothesis, ...]:
        """Subset of the hypotheses that one frame can afford: some of the scales, beginning with the predicted one; the
        next frames take the others. A scale that does not fit gives no evidence on any position, so the belief keeps
        its mass until one fits."""
        subsets = math.ceil(len(hypotheses) / MAX_HYPOTHESES)
        scales = sorted({h.scale for h in hypotheses})
        centre = scales.index(1.0)
        chosen = {scale for i, scale in enumerate(scales) if (i - centre - self._subset) % subsets == 0}
        self._subset = (self._subset + 1) % subsets
        return tuple(h for h in hypotheses if h.scale in chosen)

    def _extent(self, frame: Rectified) -> tuple[float, float, float, float]:
        """Extent of a rectified frame relative to the nadir, metres: e_min, n_max, e_max, n_min."""
        h, w = frame.mask.shape
        return (frame.e_min_m, frame.n_max_m, frame.e_min_m + w * frame.gsd_m, frame.n_max_m - h * frame.gsd_m)


def _sum(first: Surface, second: Surface) -> Surface:
    """On the cells of ``first``."""
    height, width = first.z.shape
    x = (first.e0_m - second.e0_m + np.arange(width) * first.cell_m) / second.cell_m
    y = (second.n0_m - first.n0_m + np.arange(height) * first.cell_m) / second.cell_m
    map_x, map_y = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    there = cv2.remap(second.z, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan)
    return replace(first, z=standardise(first.z + there))


def bounded_cells(gsd: float, stride: int, belief: SearchWindow) -> tuple[float, int]:
    """Pixel size and pool of a window that has at most ``MAX_WINDOW_CELLS`` cells a side."""
    pool = 1
    while 2 * belief.half_m / (gsd * stride * pool) > MAX_WINDOW_CELLS:
        pool, gsd = (2 * pool, gsd) if stride * pool < MAX_STRIDE else (pool, 2.0 * gsd)
    return gsd, pool


def view_at(view: View, hypothesis: Hypothesis, e_m: float, n_m: float) -> View:
    r_w_c = local_rotation_up(hypothesis.yaw_rad) @ view.r_w_c
    return replace(view, e_m=e_m, n_m=n_m, r_w_c=r_w_c, agl_m=view.agl_m * hypothesis.scale, sigma_m=0.0)


def view_of_fix(view: View, fix: PatchFix) -> View:
    """``view`` with the position, rotation and mean height above ground of the pose of ``fix``, which must have one."""
    assert fix.pnp.fit is not None
    p = fix.pnp.fit.p_c_in_w_m
    ground_m = float(fix.points_w_m[:, 2].mean())
    there = replace(view, r_w_c=fix.pnp.fit.r_w_c, agl_m=float(p[2]) - ground_m, ground_m=ground_m)
    return view_at(there, AS_PREDICTED, float(p[0]), float(p[1]))


def levelled_view(view: View, fix: PatchFix) -> View:
    """``view_of_fix``, with the tilt that was predicted as a prior. A dozen patches leave the tilt to some degrees, and
    the position to as much of the height: a frame rectified by them alone would be another one for each patch more."""
    assert fix.pnp.fit is not None and fix.given is not None
    agrees = fix.weights * biweight(fix.pnp.fit.residuals, POSE_CUTOFF * fix.given.threshold)
    r_w_c, p_m = view.r_w_c, fix.pnp.fit.p_c_in_w_m
    fit = fit_pose(
        fix.points_w_m,
        fix.xy,
        r_w_c,
        p_m,
        fix.given.sigma_floor,
        agrees,
        INDEPENDENT_MATCH_SHARE,
        tilt_sigma_rad=view.tilt_sigma_rad,
    )
    return view_of_fix(view, fix if fit is None else replace(fix, pnp=replace(fix.pnp, fit=fit)))


def _describe(frame: Rectified, describer: Describer) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors (C, h, w) and mask (h, w) of the cells that lie completely inside the frame."""
    stride = describer.stride
    h, w = frame.mask.shape[0] // stride, frame.mask.shape[1] // stride
    mask = np.asarray(frame.mask.reshape(h, stride, w, stride).all(axis=(1, 3)))
    return describer.describe(frame.image), mask


def hypotheses_of(view: View) -> tuple[Hypothesis, ...]:
    """Grid over 1.5 sigmas of yaw and scale where these exceed the tolerance. If yaw and scale together exceed
    ``MAX_HYPOTHESES``, the full product on coarser steps: no yaw fits at a scale that was not tried."""
    half_yaw, half_scale = min(1.5 * view.yaw_sigma_rad, np.pi), min(1.5 * view.scale_sigma, 0.5)
    yaws = _grid(half_yaw, YAW_TOLERANCE_RAD, YAW_STEP_RAD)
    scales = [1.0 + s for s in _grid(half_scale, SCALE_TOLERANCE, SCALE_STEP)]
    if len(yaws) * len(scales) > MAX_HYPOTHESES:
        yaws = _spread(half_yaw, YAW_TOLERANCE_RAD, MAX_YAW_STEP_RAD)
        scales = [float(np.exp(s)) for s in _spread(half_scale, SCALE_TOLERANCE, MAX_SCALE_STEP)]
    return tuple(Hypothesis(y, s) for y, s in itertools.product(yaws, scales))


def _product(yaws: list[float], scales: list[float]) -> tuple[Hypothesis, ...]:
    while len(yaws) * len(scales) > MAX_HYPOTHESES:
        scales = scales[1:-1] if len(scales) > 3 else [1.0]
    return tuple(Hypothesis(y, s) for y, s in itertools.product(yaws, scales))


def _grid(half: float, tolerance: float, step: float) -> list[float]:
    count = 0 if half <= tolerance else int(np.ceil((half - tolerance / 2) / step))
    return [i * step for i in range(-count, count + 1)]


def _spread(half: float, tolerance: float, step: float) -> list[float]:
    """As many values as ``_grid``, spaced evenly over the whole range."""
    count = len(_grid(half, tolerance, step)) // 2
    return [i * (half - tolerance / 2) / max(count, 1) for i in range(-count, count + 1)]
