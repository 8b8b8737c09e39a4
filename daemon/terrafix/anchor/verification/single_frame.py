"""A frame that nothing joins to the one before, while the belief is wide: the best of its modes by their patches.

One look at a whole map seldom leaves one mode, and no frame that overlaps comes to decide between them. The patches
of the frame say more than the look does: a place is right that they speak for as clearly as one frame can, and for no
other."""

from collections.abc import Sequence

import numpy as np

from terrafix.anchor.matching.frame_matcher import CorrelationResult, Fix, FrameMatcher, View, view_at
from terrafix.anchor.matching.point_mass_filter import Mode
from terrafix.anchor.relocalization.hypothesis_tracker import AHEAD, CHANCE_MOST, LLR_MAX, LLR_SLOPE, NEAR
from terrafix.anchor.verification.patch_null import PatchNull
from terrafix.anchor.verification.place_verifier import CELL_PER_AGL, PlaceCheck
from terrafix.core.node import Image
from terrafix.map.null_model import NullRow
from terrafix.map.package import LocalMap

PLACES = 12  # modes that are checked, some 50 ms each
LIKELIHOOD_RATIO = float(np.exp(LLR_MAX))  # of a place that is found so, for the belief


def localize_single_frame(
    image: Image,
    view: View,
    look: CorrelationResult,
    modes: Sequence[Mode],
    source: LocalMap,
    matcher: FrameMatcher,
    null: NullRow,
    log_probability: float,
) -> tuple[Mode, Fix] | None:
    """``modes`` of the belief after the look. None: no place, or more than one, for which the patches speak. ``null``:
    of the map at this height; ``log_probability`` that this frame may find a place when all of them are wrong."""
    check, chance = PlaceCheck(source, matcher), PatchNull(null.patches)
    views = [view_at(view, look.best_at(m.e_m, m.n_m)[0], m.e_m, m.n_m) for m in modes]
    checked = [(check.at(image, there, CELL_PER_AGL), mode) for there, mode in zip(views, modes, strict=True)]
    places = sorted(((c, m) for c, m in checked if c is not None), key=lambda place: -place[0].agreement.llr)
    if not places or places[0][0].fix.pnp.fit is None:
        return None
    best, mode = places[0]
    near_m = NEAR * view.agl_m  # from there the patches reach the same place
    others = [c for c, m in places[1:] if np.hypot(m.e_m - mode.e_m, m.n_m - mode.n_m) > near_m]
    for other in others:
        chance.learn(other.agreement, fine=False)
    sigmas, *rivals = (chance.sigmas(c.agreement, fine=False) for c in (best, *others))
    enough = null.frame.exceeded_with(log_probability - np.log(len(places)))
    if sigmas < enough or LLR_SLOPE * (sigmas - max((CHANCE_MOST, *rivals))) < AHEAD:
        return None
    fix = check.settled(image, view, best.fix)
    return None if fix is None else (mode, fix)
