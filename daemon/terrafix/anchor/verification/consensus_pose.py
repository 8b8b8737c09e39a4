"""Camera pose from all patches of a frame together, used where the patches give the maximum evidence that the ground is
here.

A RANSAC pose depends on patches whose own maximum is at the right place. Where ground has changed or buildings lean
these may be too few, while the sum of all patch surfaces still shows where most of the ground is.
"""

from dataclasses import replace

import numpy as np

from terrafix.anchor.matching.frame_matcher import FrameMatcher, PatchFix, View
from terrafix.anchor.verification.hypothesis_tracker import TRACK_LLR_MAX, evidence
from terrafix.anchor.verification.patch_null import PatchNull
from terrafix.anchor.verification.place_verifier import PLACE_CELL_PER_AGL, PlaceVerifier
from terrafix.core.node import Image


class ConsensusPose:
    def __init__(self, matcher: FrameMatcher) -> None:
        self._verifier = PlaceVerifier(matcher)

    def estimate(self, image: Image, view: View) -> PatchFix | None:
        """``view``: believed position, yaw and height above ground. None: the evidence is below the largest that one
        frame can give. The default null model is used, because no search has estimated one."""
        first = self._verifier.verify(image, view, PLACE_CELL_PER_AGL)
        if first is None or first.fix.pnp.fit is None:
            return None
        if evidence(PatchNull().sigmas(first.consensus, fine=False)) < TRACK_LLR_MAX:
            return None
        refined = self._verifier.refine(image, view, first.fix)
        if refined is None or refined.pnp.fit is None:
            return refined
        fit, open_m2 = refined.pnp.fit, np.zeros((3, 3))
        open_m2[:2, :2] = first.consensus.open_cov * view.agl_m**2
        cov = fit.cov.copy()
        cov[3:, 3:] += fit.r_w_c.T @ open_m2 @ fit.r_w_c
        return replace(refined, pnp=replace(refined.pnp, fit=replace(fit, cov=cov)))
