"""Camera pose from all patches of a frame together, used where the patches give the maximum evidence that the ground is
here.

A RANSAC pose depends on patches whose own maximum is at the right place. Where ground has changed or buildings lean
these may be too few, while the sum of all patch surfaces still shows where most of the ground is.
"""

from terrafix.anchor.matching.frame_matcher import FrameMatcher, PatchFix, View
from terrafix.anchor.verification.hypothesis_tracker import TRACK_LLR_MAX, evidence
from terrafix.anchor.verification.patch_null import PatchNull
from terrafix.anchor.verification.place_verifier import PLACE_CELL_PER_AGL, PlaceVerifier
from terrafix.core.node import Image
from terrafix.map.package import LocalMap


class ConsensusPose:
    def __init__(self, source: LocalMap, matcher: FrameMatcher) -> None:
        self._verifier = PlaceVerifier(source, matcher)

    def estimate(self, image: Image, view: View) -> PatchFix | None:
        """``view``: believed position, yaw and height above ground. None: the evidence is below the largest that one
        frame can give. The default null model is used, because no search has estimated one."""
        first = self._verifier.verify(image, view, PLACE_CELL_PER_AGL)
        if first is None or first.fix.pnp.fit is None:
            return None
        if evidence(PatchNull().sigmas(first.consensus, fine=False)) < TRACK_LLR_MAX:
            return None
        return self._verifier.refine(image, view, first.fix)
