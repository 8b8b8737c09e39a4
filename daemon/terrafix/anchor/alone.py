"""A frame that nothing joins to the one before, while the belief is wide: the best of its modes by their patches.

One look at a whole map seldom leaves one mode, and no frame that overlaps comes to decide between them. The patches
of the frame say more than the look does: a place is right that they speak for as clearly as one frame can, and for no
other."""

from collections.abc import Sequence

import numpy as np

from terrafix.anchor.belief import Mode
from terrafix.anchor.chance import Chance
from terrafix.anchor.map_package import LocalMap
from terrafix.anchor.matcher import Fix, FrameMatcher, Look, View, view_at
from terrafix.anchor.place_check import CELL_PER_AGL, PlaceCheck
from terrafix.anchor.tracks import AHEAD, CHANCE_MOST, LLR_MAX, LLR_SLOPE, NEAR
from terrafix.core.node import Image

PLACES = 12  # modes that are checked, some 50 ms each
LIKELIHOOD_RATIO = float(np.exp(LLR_MAX))  # less log(PLACES), 6 nats are left: one in four hundred may be wrong


def alone(
    image: Image, view: View, look: Look, modes: Sequence[Mode], source: LocalMap, matcher: FrameMatcher
) -> tuple[Mode, Fix] | None:
    """``modes`` of the belief after the look. None: no place, or more than one, for which the patches speak."""
    check, chance = PlaceCheck(source, matcher), Chance()
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
    evidence, *rivals = (LLR_SLOPE * (chance.sigmas(c.agreement, fine=False) - CHANCE_MOST) for c in (best, *others))
    if evidence < LLR_MAX or evidence < max(rivals, default=0.0) + AHEAD:
        return None
    fix = check.settled(image, view, best.fix)
    return None if fix is None else (mode, fix)
