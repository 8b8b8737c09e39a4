"""Whether a frame fits the map better at the position of the estimate or at its alternative position, which map matches
support that contradict the estimate (estimator/integrity/alternative_position.py)."""

import math
from dataclasses import dataclass, replace

import numpy as np

from terrafix.anchor.frame_pose import Observation
from terrafix.anchor.matching.point_mass_filter import (
    MIN_HALF_CELLS,
    MODE_RADIUS_CELLS,
    Mode,
    belief_cell_m,
    log_likelihood_ratio,
)
from terrafix.messages import Prediction, Verdict

# Largest log likelihood ratio of a full observation [nats]: one frame alone does not exclude a place. [tuned]
MAX_PLACE_NATS = 2.0


@dataclass(frozen=True)
class PlaceWindow:
    """SearchWindow about a place."""

    centre: tuple[float, float]
    half_m: float


def alternative_nats(prediction: Prediction, mode: Mode, seen: Observation) -> float | None:
    """MapMatch.alternative_nats of the frame ``seen``, whose place is ``mode``; None: there is no alternative, or the
    map does not reach it.

    The image is shifted against the prediction by the error of position and tilt, at both places by as much. Within a
    mode of the belief the best cell counts, as long as it is nearer to the alternative."""
    if prediction.alternative_m is None:
        return None
    away_e_m, away_n_m = np.subtract(prediction.alternative_m, prediction.p_c_in_w_m[:2]).tolist()
    there_m = mode.e_m + away_e_m, mode.n_m + away_n_m
    hypothesis, score = seen.correlation.best_at(mode.e_m, mode.n_m)
    cell_m = belief_cell_m(seen.view.agl_m, seen.correlation.cell_m)
    view, window = replace(seen.view, e_m=there_m[0], n_m=there_m[1]), PlaceWindow(there_m, MIN_HALF_CELLS * cell_m)
    found = seen.layer.matcher.correlate_as(seen.image, view, window, (hypothesis,))
    if found.verdict is not Verdict.ACCEPTED:
        return None
    radius_m = min(MODE_RADIUS_CELLS * cell_m, 0.5 * math.hypot(away_e_m, away_n_m))
    there = found.surfaces[0].at(*there_m, radius_m)
    return weighed(there, score, seen.weight)


def weighed(there: float, here: float, weight: float) -> float:
    """Log likelihood ratio [nats] by the standardised correlations at two places, of an observation with ``weight``
    0..1."""
    ratio = log_likelihood_ratio(np.array([there, here]))
    return weight * float(np.clip(ratio[0] - ratio[1], -MAX_PLACE_NATS, MAX_PLACE_NATS))
