"""One frame against the map: the whole correlation surface, then 2D-3D matches in the mode that the belief chose."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from terrafix.anchor.matching.descriptor_cache import CACHE_BYTES, Describer, MapFeatures
from terrafix.anchor.matching.descriptor_store import DescriptorStore
from terrafix.anchor.matching.ncc import Searchable, standardise
from terrafix.anchor.matching.orthorectify import Rectified, rectify
from terrafix.anchor.matching.patch_matcher import match_patches
from terrafix.anchor.matching.pnp import MIN_INLIERS, THRESHOLD, PnpResult, solve
from terrafix.anchor.matching.point_mass_filter import LLR_SLOPE, Surface
from terrafix.core.camera import CameraCalibration
from terrafix.core.geodesy import local_rotation_up
from terrafix.core.node import Image
from terrafix.map.package import LocalMap
from terrafix.messages import Verdict
from terrafix_engines.features.gradient import GradientDescriber

# Ground sampling distance as a share of the height: coarse enough to be fast and blind to small change, fine enough
# for houses and kerbs. Dense learned descriptors have cells of several pixels and want finer ones.
LOOK_GSD_PER_AGL = {"gradient": 1 / 100, "xfeat": 1 / 330}
FIX_GSD_PER_AGL = {"gradient": 1 / 200, "xfeat": 1 / 330}
GSD_STEPS_PER_OCTAVE = 2  # scales are rounded to these, so that the map's descriptors can be kept
# A wider search is made on coarser cells: 640 x 640 cells of 8 channels, fewer of more channels.
MAX_WINDOW_VALUES = 8 * 640**2
PATCH_PER_AGL = 0.25  # side of a patch: 25 m at 100 m, one house and its surroundings
MIN_PATCH_CELLS = 8
REACH = 0.08  # search of a patch around its expected place, share of the height
# A cell of a learned model sees a hundred pixels around it, so that neighbours err together. With 14 asked for five of
# 560 frames from elsewhere had a pose, with 20 none of 640; at right places 15 to 48 agree (docs/models.md).
LEARNED_INLIERS = 20
FIRST_REACH, FIRST_THRESHOLD = 0.2, 0.05  # of the first pass, while the tilt is not known
WELL_KNOWN_RAD = np.radians(3.0)
# Rotation and scale are searched when they are known less well than the descriptors tolerate.
YAW_TOLERANCE_RAD = np.radians(4.0)
YAW_STEP_RAD = np.radians(7.0)
SCALE_TOLERANCE = 0.05
SCALE_STEP = 0.08
WIDE_YAW_RAD, WIDE_SCALE = np.radians(13.0), 0.10  # at most, on the coarse cells of a search over the whole map
MAX_HYPOTHESES = 81
MIN_SIDE_CELLS = 24  # of the rectified frame


@dataclass(frozen=True)
class View:
    """The predicted camera: where, how turned, how high above the ground, and how well that is known."""

    e_m: float
    n_m: float
    r_w_c: np.ndarray
    agl_m: float
    ground_m: float  # AMSL
    yaw_sigma_rad: float
    scale_sigma: float  # of the height, relative
    tilt_sigma_rad: float


class Window(Protocol):
    """Camera positions to be looked at: a square. A belief is one."""

    @property
    def centre(self) -> tuple[float, float]: ...

    @property
    def half_m(self) -> float: ...


@dataclass(frozen=True)
class Hypothesis:
    yaw_rad: float
    scale: float


AS_PREDICTED = Hypothesis(0.0, 1.0)


@dataclass(frozen=True)
class CorrelationResult:
    verdict: Verdict
    surfaces: tuple[Surface, ...] = ()
    hypotheses: tuple[Hypothesis, ...] = ()
    footprint_m: float = 1.0
    cell_m: float = 1.0

    def best_at(self, e_m: float, n_m: float) -> tuple[Hypothesis, float]:
        """The hypothesis that fits best at a camera position, and its standardised correlation there."""
        scores = [s.at(e_m, n_m, 2.0 * self.cell_m) for s in self.surfaces]
        best = int(np.argmax(scores))
        return self.hypotheses[best], scores[best]

    def scale_at(self, e_m: float, n_m: float) -> tuple[float, float] | None:
        """Scale of the height that fits at a camera position and the variance of this measurement, by how likely those
        are that were tried. None: they tell nothing, or the best is the first or the last: it may lie beyond them."""
        z: dict[float, float] = {}
        for surface, hypothesis in zip(self.surfaces, self.hypotheses, strict=True):
            z[hypothesis.scale] = max(z.get(hypothesis.scale, -np.inf), surface.at(e_m, n_m, 2.0 * self.cell_m))
        scales = np.array(sorted(z))
        scores = np.array([z[s] for s in scales])
        if int(np.argmax(scores)) in (0, len(scales) - 1):
            return None
        likelihood = np.exp(LLR_SLOPE * (scores - scores.max()))
        likelihood /= likelihood.sum()
        mean = float(likelihood @ scales)
        # Less what "one of those that were tried" says already: the prediction chose them.
        told = 1.0 / float(likelihood @ (scales - mean) ** 2 + SCALE_STEP**2 / 12)
        told -= 1.0 / float(np.var(scales) + SCALE_STEP**2 / 12)
        return (mean, 1.0 / told) if told > 0.0 else None


@dataclass(frozen=True)
class Fix:
    """``xy`` (N, 2) normalised, ``points_w_m`` (N, 3), ``weights`` (N,), and what PnP made of them."""

    xy: np.ndarray
    points_w_m: np.ndarray
    weights: np.ndarray
    pnp: PnpResult
    cell_m: float


class FrameMatcher:
    """``cache_bytes``: of the map's descriptors, kept once they were computed; ``shelf``: for the next process, too."""

    def __init__(
        self,
        camera: CameraCalibration,
        source: LocalMap,
        describer: Describer,
        cache_bytes: int = CACHE_BYTES,
        shelf: DescriptorStore | None = None,
    ) -> None:
        self.camera = camera
        self._map = source
        self._describer = describer
        self._turn = 0
        self._features = MapFeatures(source, describer, cache_bytes, shelf=shelf)
        # Many channels over a wide window are slow; oriented gradients find the place as well, at a tenth of the cost.
        self.gradients = describer if describer.stride == 1 else GradientDescriber()
        self.gradient_features = (
            self._features if describer.stride == 1 else MapFeatures(source, self.gradients, cache_bytes, shelf=shelf)
        )

    def look_cell_m(self, agl_m: float) -> float:
        return self._gsd(agl_m, LOOK_GSD_PER_AGL, self._describer) * self._describer.stride

    def cell_m(self, agl_m: float, per_agl: float) -> float:
        """Size of a cell that is a share of the height, not finer than map and frame, in steps of half an octave."""
        wanted = max(self._map.gsd_m, agl_m / self.camera.fx, agl_m * per_agl)
        return float(2.0 ** (round(np.log2(wanted) * GSD_STEPS_PER_OCTAVE) / GSD_STEPS_PER_OCTAVE))

    def wide_hypotheses(self, view: View) -> tuple[Hypothesis, ...]:
        """Headings and scales for a search over the whole map: as many as its steps ask for, spread evenly."""
        yaws = _spread(min(1.5 * view.yaw_sigma_rad, np.pi), YAW_TOLERANCE_RAD, WIDE_YAW_RAD)
        scales = [1.0 + s for s in _spread(min(1.5 * view.scale_sigma, 0.5), SCALE_TOLERANCE, WIDE_SCALE)]
        return _pairs(yaws, scales)

    def rectified(
        self, image: Image, view: View, hypotheses: Sequence[Hypothesis], gsd_m: float, stride: int
    ) -> list[Rectified | None]:
        """One for each hypothesis; None: it sees no ground."""
        blurred: dict[float, Image] = {}
        return [
            rectify(
                image,
                self.camera,
                local_rotation_up(h.yaw_rad) @ view.r_w_c,
                view.agl_m * h.scale,
                gsd_m,
                stride,
                blurred,
            )
            for h in hypotheses
        ]

    def look(self, image: Image, view: View, belief: Window) -> CorrelationResult:
        """Correlation over the belief's window, for every rotation and scale that the prediction leaves open."""
        describer, features = self._describer, self._features
        hypotheses = self._in_turn(_hypotheses(view))
        gsd = self._gsd(view.agl_m, LOOK_GSD_PER_AGL, describer)
        most = float(np.sqrt(MAX_WINDOW_VALUES / describer.channels))
        if len(hypotheses) > 1 or 2 * belief.half_m / (gsd * describer.stride) > most:
            describer, features = self.gradients, self.gradient_features
            gsd = self._gsd(view.agl_m, LOOK_GSD_PER_AGL, describer)
            most = float(np.sqrt(MAX_WINDOW_VALUES / describer.channels))
        stride = describer.stride
        while 2 * belief.half_m / (gsd * stride) > most:
            gsd *= 2.0
        first = rectify(image, self.camera, view.r_w_c, view.agl_m, gsd, stride)
        if first is None or min(first.mask.shape) < MIN_SIDE_CELLS * stride / 2:
            return CorrelationResult(Verdict.TOO_LOW)
        cell = gsd * stride
        footprint_m = float(np.sqrt(first.mask.sum())) * gsd
        frames = [first] if hypotheses == (AS_PREDICTED,) else self.rectified(image, view, hypotheses, gsd, stride)
        usable = [(h, f) for h, f in zip(hypotheses, frames, strict=True) if f is not None]
        reach = [self._offsets(f) for _, f in usable]
        e_min = belief.centre[0] - belief.half_m + min(r[0] for r in reach)
        n_max = belief.centre[1] + belief.half_m + max(r[1] for r in reach)
        width = int((2 * belief.half_m + max(r[2] for r in reach) - min(r[0] for r in reach)) / cell) + 2
        height = int((2 * belief.half_m + max(r[1] for r in reach) - min(r[3] for r in reach)) / cell) + 2
        descriptors, valid, e_min, n_max = features.window(e_min, n_max, width, height, gsd)
        if not valid.any():
            return CorrelationResult(Verdict.OUTSIDE_MAP)
        searchable = Searchable(descriptors, valid)
        surfaces = []
        for _, frame in usable:
            template, mask = _describe(frame, describer)
            z = standardise(searchable.search(template, mask))
            surfaces.append(Surface(z, e_min - frame.e_min_m, n_max - frame.n_max_m, cell))
        if not any(np.isfinite(s.z).any() for s in surfaces):
            return CorrelationResult(Verdict.OUTSIDE_MAP)
        return CorrelationResult(Verdict.ACCEPTED, tuple(surfaces), tuple(h for h, _ in usable), footprint_m, cell)

    def fix(self, image: Image, view: View, hypothesis: Hypothesis, e_m: float, n_m: float) -> Fix | None:
        """2D-3D matches around a camera position, and the pose that they give. None: the ground cannot be seen.

        A pose that is not known well is found in two passes: a wide search with a generous threshold, then a narrow one
        on the frame rectified with what the first one found."""
        start = view_at(view, hypothesis, e_m, n_m)
        found = self._fix_by(self.gradients, image, start)
        if self._describer is self.gradients or (found is not None and found.pnp.verdict is Verdict.ACCEPTED):
            return found
        # Cells of a learned model are coarser, and it finds more patches where ground has changed or leans.
        return self._fix_by(self._describer, image, start)

    def _fix_by(self, describer: Describer, image: Image, view: View) -> Fix | None:
        if view.tilt_sigma_rad > WELL_KNOWN_RAD:
            first = self._patch_fix(describer, image, view, FIRST_REACH, FIRST_THRESHOLD)
            if first is None or first.pnp.fit is None:
                return first
            view = view_from(view, first)
        return self._patch_fix(describer, image, view, REACH, THRESHOLD)

    def refined(self, image: Image, view: View, fix: Fix) -> Fix:
        """The pose of a place that a search has found, on the cells of a flight, if one stands on these."""
        if fix.pnp.fit is None:
            return fix
        finer = self._patch_fix(self.gradients, image, view_from(view, fix), REACH, THRESHOLD)
        return finer if finer is not None and finer.pnp.verdict is Verdict.ACCEPTED else fix

    def _patch_fix(
        self, describer: Describer, image: Image, view: View, reach_share: float, threshold: float
    ) -> Fix | None:
        gsd = self._gsd(view.agl_m, FIX_GSD_PER_AGL, describer)
        cell = gsd * describer.stride
        frame = rectify(image, self.camera, view.r_w_c, view.agl_m, gsd, describer.stride)
        if frame is None:
            return None
        reach = max(int(np.ceil(reach_share * view.agl_m / cell)), 3)
        patch = max(round(PATCH_PER_AGL * view.agl_m / cell), MIN_PATCH_CELLS)
        template, mask = _describe(frame, describer)
        margin = (reach + 2) * cell
        e_min, n_max = view.e_m + frame.e_min_m - margin, view.n_m + frame.n_max_m + margin
        width, height = mask.shape[1] + 2 * reach + 4, mask.shape[0] + 2 * reach + 4
        features = self.gradient_features if describer is self.gradients else self._features
        window, valid, e_min, n_max = features.window(e_min, n_max, width, height, gsd)
        found = match_patches(
            template, frame, mask, cell, window, valid, (e_min, n_max), (view.e_m, view.n_m), patch, reach
        )
        rays = np.column_stack([found.frame_m, np.full(len(found.frame_m), -view.agl_m)]) @ view.r_w_c
        xy = rays[:, :2] / rays[:, 2:]
        up = self._map.elevation(found.map_m[:, 0], found.map_m[:, 1]) if len(xy) else None
        up = np.full(len(xy), view.ground_m) if up is None else np.where(np.isfinite(up), up, view.ground_m)
        points = np.column_stack([found.map_m, up])
        floor = 0.3 * cell / view.agl_m  # a third of a cell: what interpolation of the peak gives at best
        reach_share = reach * cell / view.agl_m
        least = MIN_INLIERS if describer.stride == 1 else LEARNED_INLIERS
        pnp = solve(points, xy, found.weight, view.r_w_c, view.agl_m, floor, threshold, reach_share, least)
        return Fix(xy, points, found.weight, pnp, cell)

    def _in_turn(self, hypotheses: tuple[Hypothesis, ...]) -> tuple[Hypothesis, ...]:
        """As many as one frame can pay for: some of the heights, that of the prediction among the first, and others in
        the next frame. A height that does not fit says nothing of any place: the belief waits for one that does."""
        turns = math.ceil(len(hypotheses) / MAX_HYPOTHESES)
        scales = sorted({h.scale for h in hypotheses})
        middle = scales.index(1.0)
        chosen = {scale for i, scale in enumerate(scales) if (i - middle - self._turn) % turns == 0}
        self._turn = (self._turn + 1) % turns
        return tuple(h for h in hypotheses if h.scale in chosen)

    def _gsd(self, agl_m: float, per_agl: dict[str, float], describer: Describer) -> float:
        return self.cell_m(agl_m, per_agl[describer.name])

    def _offsets(self, frame: Rectified) -> tuple[float, float, float, float]:
        """Box of a rectified frame around the nadir: e_min, n_max, e_max, n_min."""
        h, w = frame.mask.shape
        return (
            frame.e_min_m,
            frame.n_max_m,
            frame.e_min_m + w * frame.gsd_m,
            frame.n_max_m - h * frame.gsd_m,
        )


def view_at(view: View, hypothesis: Hypothesis, e_m: float, n_m: float) -> View:
    r_w_c = local_rotation_up(hypothesis.yaw_rad) @ view.r_w_c
    return replace(view, e_m=e_m, n_m=n_m, r_w_c=r_w_c, agl_m=view.agl_m * hypothesis.scale)


def view_from(view: View, fix: Fix) -> View:
    """The camera as a pose has it."""
    assert fix.pnp.fit is not None
    p = fix.pnp.fit.p_c_in_w_m
    agl_m = float(p[2]) - float(fix.points_w_m[:, 2].mean())
    return replace(view, e_m=float(p[0]), n_m=float(p[1]), r_w_c=fix.pnp.fit.r_w_c, agl_m=agl_m)


def _describe(frame: Rectified, describer: Describer) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors (C, h, w) and the cells (h, w) that lie wholly in the frame."""
    stride = describer.stride
    h, w = frame.mask.shape[0] // stride, frame.mask.shape[1] // stride
    mask = np.asarray(frame.mask.reshape(h, stride, w, stride).all(axis=(1, 3)))
    return describer.describe(frame.image), mask


def _hypotheses(view: View) -> tuple[Hypothesis, ...]:
    """Grid over one and a half sigmas of heading and scale, as far as they are not known well enough. Where both are
    open, all of both on coarser steps: no heading fits at a height that was not tried."""
    half_yaw, half_scale = min(1.5 * view.yaw_sigma_rad, np.pi), min(1.5 * view.scale_sigma, 0.5)
    yaws = _grid(half_yaw, YAW_TOLERANCE_RAD, YAW_STEP_RAD)
    scales = [1.0 + s for s in _grid(half_scale, SCALE_TOLERANCE, SCALE_STEP)]
    if len(yaws) * len(scales) > MAX_HYPOTHESES:
        yaws = _spread(half_yaw, YAW_TOLERANCE_RAD, WIDE_YAW_RAD)
        scales = [float(np.exp(s)) for s in _spread(half_scale, SCALE_TOLERANCE, WIDE_SCALE)]
    return tuple(Hypothesis(y, s) for y, s in itertools.product(yaws, scales))


def _pairs(yaws: list[float], scales: list[float]) -> tuple[Hypothesis, ...]:
    while len(yaws) * len(scales) > MAX_HYPOTHESES:
        scales = scales[1:-1] if len(scales) > 3 else [1.0]
    return tuple(Hypothesis(y, s) for y, s in itertools.product(yaws, scales))


def _grid(half: float, tolerance: float, step: float) -> list[float]:
    count = 0 if half <= tolerance else int(np.ceil((half - tolerance / 2) / step))
    return [i * step for i in range(-count, count + 1)]


def _spread(half: float, tolerance: float, step: float) -> list[float]:
    """As many as ``_grid``, from one end to the other."""
    count = len(_grid(half, tolerance, step)) // 2
    return [i * (half - tolerance / 2) / max(count, 1) for i in range(-count, count + 1)]
