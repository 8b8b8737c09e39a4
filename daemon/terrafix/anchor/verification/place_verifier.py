"""Verification of a proposed place with one frame: evidence of its patches, and the pose under which they agree."""

from dataclasses import dataclass, replace

import numpy as np

from terrafix.anchor.matching.frame_matcher import (
    AS_PREDICTED,
    FIX_GSD_PER_AGL,
    PATCH_PER_AGL,
    PATCH_STEP,
    FrameMatcher,
    PatchFix,
    View,
    view_of_fix,
)
from terrafix.anchor.matching.orthorectify import patch_centres, rays_to
from terrafix.anchor.matching.patch_matcher import correlate_patches
from terrafix.anchor.verification.patch_consensus import MAX_LLR, PatchConsensus, estimate_consensus
from terrafix.core.node import Image
from terrafix.core.pnp import PNP_MIN_INLIERS, SEARCH_RADIUS, PnpResult
from terrafix.core.pose import fit_pose
from terrafix.messages import Verdict

# Cell size as a share of the height, coarse and fine. Fine cells separate right places from the null model better (by a
# fourth in standard deviations) at twice the cost. [measured: docs/search.md]
PLACE_CELL_PER_AGL, FINE_PLACE_CELL_PER_AGL = 1 / 100, 1 / 140
# share of the height: search radius of a patch, for the error of yaw, scale and tilt at the border and of the place
# itself [tuned]
PLACE_SEARCH_RADIUS = 0.2
# share of the height: common displacement of patches by leaning buildings and changes, 1-sigma
# [measured: docs/search.md]
SIGMA_FLOOR = 0.02
# Share of the height: noise of one patch, which weighs outliers down. With a tilt prior, SIGMA_FLOOR is used instead,
# because the common displacement is what is weighed against the prior; the patches then have equal weights. [tuned]
PATCH_SIGMA = 0.005


@dataclass(frozen=True)
class VerifiedPlace:
    consensus: PatchConsensus
    fix: PatchFix


class PlaceVerifier:
    def __init__(self, matcher: FrameMatcher) -> None:
        self._matcher = matcher

    def verify(
        self,
        image: Image,
        view: View,
        cell_per_agl: float,
        radius_per_agl: float = PLACE_SEARCH_RADIUS,
        *,
        tilt_prior: bool = True,
    ) -> VerifiedPlace | None:
        """``view``: proposed position, yaw and height above ground. ``tilt_prior``: the pose is regularised towards the
        tilt of the view. None: too few patches lie on the map."""
        cell_m = self._matcher.cell_m(view.agl_m, cell_per_agl)
        pyramid = self._matcher.pyramid(image, self._matcher.gradients)
        (frame,) = self._matcher.rectify_all(pyramid, view, (AS_PREDICTED,), cell_m, 1)
        if frame is None:
            return None
        radius, patch = round(radius_per_agl * view.agl_m / cell_m), round(PATCH_PER_AGL * view.agl_m / cell_m)
        (h, w), margin = frame.mask.shape, radius + 2
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
        centres = patch_centres(self._matcher.camera, view.r_w_c, view.agl_m, frame, cell_m, PATCH_STEP)
        corners, _, surfaces = correlate_patches(
            template, frame.mask, window, valid, patch, radius, row0, column0, centres
        )
        if len(corners) < PNP_MIN_INLIERS:
            return None
        centres = np.array(corners) + 0.5 * patch
        ground_m = np.column_stack([frame.e_min_m + centres[:, 1] * cell_m, frame.n_max_m - centres[:, 0] * cell_m])
        found = estimate_consensus(surfaces, ground_m / view.agl_m, cell_m / view.agl_m, view.tilt_sigma_rad)
        # Patch centres on the window's grid of cells; the consensus adds the offset of each patch.
        on_map_m = np.column_stack(
            [e_min_m + (column0 + centres[:, 1]) * cell_m, n_max_m - (row0 + centres[:, 0]) * cell_m]
        )
        tilt_sigma_rad = view.tilt_sigma_rad if tilt_prior else None
        found_m = on_map_m + found.offsets * view.agl_m
        rays = rays_to(ground_m, view.agl_m, view.r_w_c, self._matcher.relief(view))
        return VerifiedPlace(found, self._pose(view, rays, found_m, found, cell_m, tilt_sigma_rad))

    def refine(self, image: Image, view: View, first: PatchFix) -> PatchFix | None:
        """The pose ``first``, computed from ``view``, refined on the cells of a fix and without a tilt prior: the
        consumer of the pose already uses the predicted tilt."""
        found = self.verify(
            image, view_of_fix(view, first), FIX_GSD_PER_AGL["gradient"], SEARCH_RADIUS, tilt_prior=False
        )
        return None if found is None else replace(found.fix, refined=True)

    def _pose(
        self,
        view: View,
        rays: np.ndarray,
        map_m: np.ndarray,
        found: PatchConsensus,
        cell_m: float,
        tilt_sigma_rad: float | None,
    ) -> PatchFix:
        xy = rays[:, :2] / rays[:, 2:]
        points = np.column_stack([map_m, self._matcher.ground_at(map_m, view.ground_m)])
        # By its evidence, so that none comes or goes by a step.
        weights = np.clip(found.values / MAX_LLR, 0.0, 1.0)
        start = np.array([view.e_m, view.n_m, view.ground_m + view.agl_m])
        fit = None
        if found.inliers.sum() >= PNP_MIN_INLIERS:
            fit = fit_pose(
                points[found.inliers],
                xy[found.inliers],
                view.r_w_c,
                start,
                PATCH_SIGMA if tilt_sigma_rad is None else SIGMA_FLOOR,
                weights[found.inliers],
                independent_share=0.25,
                tilt_sigma_rad=tilt_sigma_rad,
            )
        if fit is not None:  # weighted with the noise of one patch, reported with the common displacement
            fit = replace(fit, cov=fit.cov * max(SIGMA_FLOOR / fit.sigma, 1.0) ** 2)
        verdict = Verdict.FEW_INLIERS if fit is None else Verdict.ACCEPTED
        return PatchFix(xy, points, weights, PnpResult(verdict, fit, found.inliers), cell_m)
