"""Whether a frame fits the map better at the position of the estimate or at its alternative position, which map matches
support that contradict the estimate (estimator/integrity/alternative_position.py)."""

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

# Largest log likelihood ratio of a full observation [nats]: one frame alone does not exclude a place
MAX_NATS = 2.0  # [tuned: the gain of a full observation in lock_monitor.py]


@dataclass(frozen=True)
class Square:
    """SearchWindow about a place."""

    centre: tuple[float, float]
    half_m: float


def alternative_nats(prediction: Prediction, mode: Mode, seen: Observation) -> float | None:
    """MapMatch.alternative_nats of the frame ``seen``, whose place is ``mode``; None: there is no alternative, or the
    map does not reach it.

    The image is shifted against the prediction by the error of position and tilt, at both places by as much. Within a
    mode of the belief the best cell counts, since two places are not known to a cell."""
    if prediction.alternative_m is None:
        return None
    off_e_m, off_n_m = mode.e_m - prediction.p_c_in_w_m[0], mode.n_m - prediction.p_c_in_w_m[1]
    there_m = prediction.alternative_m[0] + off_e_m, prediction.alternative_m[1] + off_n_m
    hypothesis, score = seen.correlation.best_at(mode.e_m, mode.n_m)
    cell_m = belief_cell_m(seen.view.agl_m, seen.correlation.cell_m)
    view, window = replace(seen.view, e_m=there_m[0], n_m=there_m[1]), Square(there_m, MIN_HALF_CELLS * cell_m)
    found = seen.layer.matcher.correlate_as(seen.image, view, window, (hypothesis,))
    if found.verdict is not Verdict.ACCEPTED:
        return None
    there = found.surfaces[0].at(*there_m, MODE_RADIUS_CELLS * cell_m)
    return weighed(there, score, seen.weight)


def weighed(there: float, here: float, weight: float) -> float:
    """Log likelihood ratio [nats] by the standardised correlations at two places, of an observation with ``weight``
    0..1."""
    ratio = log_likelihood_ratio(np.array([there, here]))
    return weight * float(np.clip(ratio[0] - ratio[1], -MAX_NATS, MAX_NATS))
