"""Localization by a single frame while the belief is wide and no frame overlaps the one before: correlation and patches
together select one of its modes.

One correlation with a whole map rarely leaves one mode, and without overlap no later frame discriminates between them.
The patches of the frame do, but where buildings lean or are gone they confirm little. So the nats of both are added. A
place is accepted if it exceeds every other one, and their mean by more than the best of wrong places does: they are the
null model, ground of this map as this frame sees it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from terrafix.anchor.matching.frame_matcher import CorrelationResult, FrameMatcher, PatchFix, View, view_at
from terrafix.anchor.matching.point_mass_filter import Mode
from terrafix.anchor.verification.hypothesis_tracker import (
    DECISION_MARGIN,
    NEIGHBOUR_RADIUS,
    TRACK_LLR_MAX,
    evidence,
)
from terrafix.anchor.verification.patch_null import PatchNull
from terrafix.anchor.verification.place_verifier import FINE_PLACE_CELL_PER_AGL, PlaceVerifier, VerifiedPlace
from terrafix.core.agreement import NATS_PER_SCORE
from terrafix.core.node import Image
from terrafix.map.null_model import DEFAULT_NULL, Tail

# Modes that are compared, about 50 ms each. Of twelve, the last four hold the right place in 1 % of the frames.
# [measured: docs/decisions/072-single-frames-in-one-score.md]
MAX_MODES = 8
# Nats per standard deviation of the patches: decay of the tail of wrong places, as ``NATS_PER_SCORE`` of the
# correlation. [spec: DEFAULT_NULL.frame]
PATCH_LLR_SLOPE = DEFAULT_NULL.frame.count / DEFAULT_NULL.frame.excess
# Nats of the best place over the mean of the others where all are wrong.
# [measured: docs/decisions/072-single-frames-in-one-score.md]
EXCESS_NULL = Tail(above=5.6, share=0.1, count=68.0, excess=61.8)
LIKELIHOOD_RATIO = float(np.exp(TRACK_LLR_MAX))  # factor on the mass of the accepted mode [spec: exp(TRACK_LLR_MAX)]


@dataclass(frozen=True)
class ScoredMode:
    """``view``: camera at the mode, with the yaw and scale that fit best there; ``sigmas``: of its patches above the
    default null model; ``score``: nats of correlation and patches. ``fix``: refined pose by the patches of a selected
    mode; None: they do not give the evidence for one."""

    mode: Mode
    view: View
    place: VerifiedPlace
    sigmas: float
    score: float
    fix: PatchFix | None = None


def localize_single_frame(
    image: Image,
    view: View,
    correlation: CorrelationResult,
    modes: Sequence[Mode],
    matcher: FrameMatcher,
    log_probability: float,
) -> ScoredMode | None:
    """``modes``: of the belief after this frame's correlation; ``log_probability``: allowed false-alarm probability of
    this frame. -> the selected mode; None: no place, or more than one."""
    verifier, scored = PlaceVerifier(matcher), list[ScoredMode]()
    for mode in modes:
        hypothesis, z = correlation.best_at(mode.e_m, mode.n_m)
        there = view_at(view, hypothesis, mode.e_m, mode.n_m)
        if (place := verifier.verify(image, there, FINE_PLACE_CELL_PER_AGL)) is not None:
            sigmas = PatchNull().sigmas(place.consensus, fine=True)
            score = NATS_PER_SCORE * z + PATCH_LLR_SLOPE * sigmas
            scored.append(ScoredMode(mode, there, place, sigmas, score))
    best = max(scored, key=lambda one: one.score, default=None)
    if best is None:
        return None
    near_m = NEIGHBOUR_RADIUS * view.agl_m  # within this distance the patches match the same place
    rivals = [s.score for s in scored if np.hypot(s.view.e_m - best.view.e_m, s.view.n_m - best.view.n_m) > near_m]
    if not rivals or best.score < max(rivals) + DECISION_MARGIN:
        return None
    if best.score < np.mean(rivals) + EXCESS_NULL.exceedance_value(log_probability):
        return None
    if evidence(best.sigmas) < TRACK_LLR_MAX or best.place.fix.pnp.fit is None:
        return best
    fix = verifier.refine(image, best.view, best.place.fix)
    return best if fix is None or fix.pnp.fit is None else replace(best, fix=fix)
