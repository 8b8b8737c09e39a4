"""A pose from all patches of a frame together, where they say as clearly as they can that the ground is here.

A pose by RANSAC stands on the patches whose best value is at one spot. Where ground has changed or buildings lean these
may be too few; all patches together still say where most of the ground is."""

from terrafix.anchor.chance import Chance
from terrafix.anchor.map_package import LocalMap
from terrafix.anchor.matcher import Fix, FrameMatcher, View
from terrafix.anchor.place_check import CELL_PER_AGL, PlaceCheck
from terrafix.anchor.tracks import LLR_MAX, evidence
from terrafix.core.node import Image


class AgreedPose:
    def __init__(self, source: LocalMap, matcher: FrameMatcher) -> None:
        self._check = PlaceCheck(source, matcher)

    def at(self, image: Image, view: View) -> Fix | None:
        """``view``: place, heading and height above ground as believed. None: the patches say less than the most that
        one frame can say; nobody has searched, so chance is what it usually is."""
        first = self._check.at(image, view, CELL_PER_AGL)
        if first is None or first.fix.pnp.fit is None:
            return None
        if evidence(Chance().sigmas(first.agreement, fine=False)) < LLR_MAX:
            return None
        return self._check.settled(image, view, first.fix)
