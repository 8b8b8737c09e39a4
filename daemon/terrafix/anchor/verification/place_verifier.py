"""A place that a search proposes, checked with one frame: the evidence of its patches, and the pose that they give."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from terrafix.anchor.matching.frame_matcher import (
    FIX_GSD_PER_AGL,
    PATCH_PER_AGL,
    REACH,
    Fix,
    FrameMatcher,
    View,
    view_from,
)
from terrafix.anchor.matching.orthorectify import rectify
from terrafix.anchor.matching.patch_matcher import correlated_patches
from terrafix.anchor.matching.pnp import MIN_INLIERS, PnpResult
from terrafix.anchor.verification.patch_consensus import PatchConsensus, agreement
from terrafix.core.camera import CameraCalibration
from terrafix.core.node import Image
from terrafix.core.pose import fit_pose
from terrafix.map.package import LocalMap
from terrafix.messages import Verdict

# Finer cells tell the right place from chance better (measured: by a fourth in standard deviations), at twice the cost.
CELL_PER_AGL, FINE_PER_AGL = 1 / 100, 1 / 140
PLACE_REACH = 0.2  # of the height: what heading, scale and tilt may do at the rim, and the place itself
SIGMA_FLOOR = 0.02  # of the height: leaning buildings and changes take patches aside together
PATCH_SIGMA = 0.005  # of the height: one that is aside by more than the others counts for less. Where the tilt is held
# to a prior, patches are weighed against it by what they share, and count alike.


@dataclass(frozen=True)
class Checked:
    agreement: PatchConsensus
    fix: Fix


class PlaceCheck:
    def __init__(self, source: LocalMap, matcher: FrameMatcher) -> None:
        self._map = source
        self._matcher = matcher
        self._image: Image | None = None
        self._small: tuple[Image, CameraCalibration] | None = None

    def at(
        self,
        image: Image,
        view: View,
        cell_per_agl: float,
        reach_per_agl: float = PLACE_REACH,
        *,
        tilt_prior: bool = True,
    ) -> Checked | None:
        """``view``: place, heading and height above ground as proposed. ``tilt_prior``: the pose holds the tilt of the
        view to what is known of it. None: too little lies on the map."""
        cell_m = self._matcher.cell_m(view.agl_m, cell_per_agl)
        small, camera = self._shrunk(image, view.agl_m)
        frame = rectify(small, camera, view.r_w_c, view.agl_m, cell_m)
        if frame is None:
            return None
        reach, patch = round(reach_per_agl * view.agl_m / cell_m), round(PATCH_PER_AGL * view.agl_m / cell_m)
        (h, w), margin = frame.mask.shape, reach + 2
        window, valid, e_min_m, n_max_m = self._matcher.gradient_features.window(
            view.e_m + frame.e_min_m - margin * cell_m,
            view.n_m + frame.n_max_m + margin * cell_m,
            w + 2 * margin,
            h + 2 * margin,
            cell_m,
        )
        row0 = round((n_max_m - (view.n_m + frame.n_max_m)) / cell_m)
        column0 = round((view.e_m + frame.e_min_m - e_min_m) / cell_m)
        template = self._matcher.gradients.describe(frame.image)
        corners, surfaces = correlated_patches(template, frame.mask, window, valid, patch, reach, row0, column0)
        if len(corners) < MIN_INLIERS:
            return None
        middle = np.array(corners) + 0.5 * patch
        ground_m = np.column_stack([frame.e_min_m + middle[:, 1] * cell_m, frame.n_max_m - middle[:, 0] * cell_m])
        found = agreement(surfaces, ground_m / view.agl_m, cell_m / view.agl_m, view.tilt_sigma_rad)
        # Where the window's grid of cells puts the middle of a patch, moved by what the patch says.
        on_map_m = np.column_stack(
            [e_min_m + (column0 + middle[:, 1]) * cell_m, n_max_m - (row0 + middle[:, 0]) * cell_m]
        )
        tilt_sigma_rad = view.tilt_sigma_rad if tilt_prior else None
        found_m = on_map_m + found.offsets * view.agl_m
        return Checked(found, self._pose(view, ground_m, found_m, found, cell_m, tilt_sigma_rad))

    def settled(self, image: Image, view: View, first: Fix) -> Fix | None:
        """The pose of a ``first`` look from ``view``, found again on the cells of a fix. It knows nothing of how the
        tilt was predicted, which whoever takes the pose knows already."""
        found = self.at(image, view_from(view, first), FIX_GSD_PER_AGL["gradient"], REACH, tilt_prior=False)
        return None if found is None else found.fix

    def _shrunk(self, image: Image, agl_m: float) -> tuple[Image, CameraCalibration]:
        """The frame with about two pixels to a fine cell, made once for all places."""
        if self._small is None or image is not self._image:
            fine_m = self._matcher.cell_m(agl_m, FINE_PER_AGL)
            camera = self._matcher.camera.scaled(min(2.0 * (agl_m / self._matcher.camera.fx) / fine_m, 1.0))
            size = (camera.width, camera.height)
            self._image, self._small = image, (cv2.resize(image, size, interpolation=cv2.INTER_AREA), camera)
        return self._small

    def _pose(
        self,
        view: View,
        ground_m: np.ndarray,
        map_m: np.ndarray,
        found: PatchConsensus,
        cell_m: float,
        tilt_sigma_rad: float | None,
    ) -> Fix:
        rays = np.column_stack([ground_m, np.full(len(ground_m), -view.agl_m)]) @ view.r_w_c
        xy = rays[:, :2] / rays[:, 2:]
        up = self._map.elevation(map_m[:, 0], map_m[:, 1])
        up = np.full(len(xy), view.ground_m) if up is None else np.where(np.isfinite(up), up, view.ground_m)
        points, weights = np.column_stack([map_m, up]), np.ones(len(xy))
        start = np.array([view.e_m, view.n_m, view.ground_m + view.agl_m])
        fit = None
        if found.agrees.sum() >= MIN_INLIERS:
            fit = fit_pose(
                points[found.agrees],
                xy[found.agrees],
                view.r_w_c,
                start,
                PATCH_SIGMA if tilt_sigma_rad is None else SIGMA_FLOOR,
                effective=0.25,
                tilt_sigma_rad=tilt_sigma_rad,
            )
        if fit is not None:  # what one patch scatters by weighs them; what they share is claimed
            fit = replace(fit, cov=fit.cov * max(SIGMA_FLOOR / fit.sigma, 1.0) ** 2)
        verdict = Verdict.FEW_INLIERS if fit is None else Verdict.ACCEPTED
        return Fix(xy, points, weights, PnpResult(verdict, fit, found.agrees), cell_m)
