"""Localization by a single frame while the belief is wide and no frame overlaps the one before: patches select one of
its modes.

One correlation with a whole map rarely leaves one mode, and without overlap no later frame discriminates between them.
The patches of the frame discriminate better than the correlation. A place is accepted if they give it the maximum
evidence of one frame and no other place.
"""

from collections.abc import Sequence

import numpy as np

from terrafix.anchor.matching.frame_matcher import CorrelationResult, FrameMatcher, PatchFix, View, view_at
from terrafix.anchor.matching.point_mass_filter import Mode
from terrafix.anchor.verification.hypothesis_tracker import (
    DECISION_MARGIN,
    NEIGHBOUR_RADIUS,
    NULL_SIGMAS,
    TRACK_LLR_MAX,
    TRACK_LLR_SLOPE,
)
from terrafix.anchor.verification.patch_null import PatchNull
from terrafix.anchor.verification.place_verifier import PLACE_CELL_PER_AGL, PlaceVerifier
from terrafix.core.node import Image
from terrafix.map.null_model import NullRow

MAX_MODES = 12  # modes that are verified, about 50 ms each [tuned]
LIKELIHOOD_RATIO = float(np.exp(TRACK_LLR_MAX))  # factor on the mass of the accepted mode [spec: exp(TRACK_LLR_MAX)]


def localize_single_frame(
    image: Image,
    view: View,
    correlation: CorrelationResult,
    modes: Sequence[Mode],
    matcher: FrameMatcher,
    null: NullRow,
    log_probability: float,
) -> tuple[Mode, PatchFix] | None:
    """``modes``: of the belief after this frame's correlation. ``null``: null model of the map at this height;
    ``log_probability``: allowed false-alarm probability of this frame. -> the accepted mode with its pose; None: no
    place, or more than one."""
    verifier, patch_null = PlaceVerifier(matcher), PatchNull(null.patches)
    views = [view_at(view, correlation.best_at(m.e_m, m.n_m)[0], m.e_m, m.n_m) for m in modes]
    verified = [
        (verifier.verify(image, place_view, PLACE_CELL_PER_AGL), mode)
        for place_view, mode in zip(views, modes, strict=True)
    ]
    places = sorted(((c, m) for c, m in verified if c is not None), key=lambda place: -place[0].consensus.llr)
    if not places or places[0][0].fix.pnp.fit is None:
        return None
    best, mode = places[0]
    near_m = NEIGHBOUR_RADIUS * view.agl_m  # within this distance the patches match the same place
    others = [c for c, m in places[1:] if np.hypot(m.e_m - mode.e_m, m.n_m - mode.n_m) > near_m]
    for other in others:
        patch_null.add(other.consensus, fine=False)
    sigmas, *rivals = (patch_null.sigmas(c.consensus, fine=False) for c in (best, *others))
    threshold = null.frame.exceedance_value(log_probability - np.log(len(places)))
    if sigmas < threshold or TRACK_LLR_SLOPE * (sigmas - max((NULL_SIGMAS, *rivals))) < DECISION_MARGIN:
        return None
    fix = verifier.refine(image, view, best.fix)
    return None if fix is None else (mode, fix)
