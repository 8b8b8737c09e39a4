"""A pose from all patches of a frame together, where they say as clearly as they can that the ground is here.

A pose by RANSAC stands on the patches whose best value is at one spot. Where ground has changed or buildings lean these
may be too few; all patches together still say where most of the ground is."""

from terrafix.anchor.matching.frame_matcher import Fix, FrameMatcher, View
from terrafix.anchor.relocalization.hypothesis_tracker import LLR_MAX, evidence
from terrafix.anchor.verification.patch_null import PatchNull
from terrafix.anchor.verification.place_verifier import CELL_PER_AGL, PlaceCheck
from terrafix.core.node import Image
from terrafix.map.package import LocalMap


class ConsensusPose:
    def __init__(self, source: LocalMap, matcher: FrameMatcher) -> None:
        self._check = PlaceCheck(source, matcher)

    def at(self, image: Image, view: View) -> Fix | None:
        """``view``: place, heading and height above ground as believed. None: the patches say less than the most that
        one frame can say; nobody has searched, so chance is what it usually is."""
        first = self._check.at(image, view, CELL_PER_AGL)
        if first is None or first.fix.pnp.fit is None:
            return None
        if evidence(PatchNull().sigmas(first.agreement, fine=False)) < LLR_MAX:
            return None
        return self._check.settled(image, view, first.fix)
