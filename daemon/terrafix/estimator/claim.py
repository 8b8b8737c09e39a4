"""The claim: position, height and covariance that are published with an estimate. Every term is added here, once."""

from dataclasses import dataclass

import numpy as np

from terrafix.core.map_error import illumination_variance_m2
from terrafix.core.pose import positive_part, tangent_to_world
from terrafix.estimator.estimator import Estimator
from terrafix.estimator.filter_state import FrameState
from terrafix.estimator.state import HORIZONTAL, UP, WORLD_POSITION, WORLD_TILT


@dataclass(frozen=True)
class Claim:
    """``position_m`` (2,): published, east and north. ``cov`` (6, 6): position, then orientation, world axes.
    ``amsl_m``: published height. ``terms_m2``: mean horizontal variance that each term adds, by its name; their sum is
    that of ``cov``. What stands against the position beside the graph (integrity/doubts.py): ``own_m2`` (2, 2) of this
    frame alone, ``doubt_m2`` (2, 2) of the whole position."""

    position_m: np.ndarray
    cov: np.ndarray
    amsl_m: float
    terms_m2: dict[str, float]
    own_m2: np.ndarray
    doubt_m2: np.ndarray


def claim(
    estimator: Estimator,
    frame: FrameState,
    time_offset_sigma_s: float,
    calibration_sigma_m: float,
    path_error_m: float = 0.0,
) -> Claim:
    """Claim of ``frame``, the newest one. ``time_offset_sigma_s``: 1-sigma of the camera against telemetry;
    ``calibration_sigma_m``: 1-sigma of the position by a description that monitors have found wrong; ``path_error_m``:
    its error by one that none has named."""
    state = estimator.state
    budget = _Budget(state.covariances.widening**2 * tangent_to_world(frame.cov, frame.pose.rotation().matrix()))
    cov = budget.cov
    # The error of the map is the same everywhere: no number of matches averages it away.
    cov[WORLD_POSITION, WORLD_POSITION] += estimator.map_sigma_m**2 * np.eye(3)
    budget.close("map")
    cov[HORIZONTAL, HORIZONTAL] += illumination_variance_m2(estimator.map_sigma_m) * np.eye(2)
    budget.close("illumination")
    shift_m, shift_cov = state.principal_point.shift(state.principal_point_jacobian(frame.pose))
    cov[HORIZONTAL, HORIZONTAL] += shift_cov
    budget.close("principal_point")
    cov[WORLD_TILT, WORLD_TILT] += state.camera.body_sigma_rad**2 * np.eye(2)
    moved_m2 = time_offset_sigma_s**2 * np.outer(frame.velocity_mps, frame.velocity_mps)
    cov[WORLD_POSITION, WORLD_POSITION] += moved_m2
    budget.close("time_offset")
    graph_m2, alternative_m2 = cov[HORIZONTAL, HORIZONTAL].copy(), estimator.hypotheses.other.moments_m2()
    other_m, budget.cov = estimator.hypotheses.claim(cov, path_error_m)
    cov = budget.cov
    budget.close("hypotheses")
    cov[HORIZONTAL, HORIZONTAL] += calibration_sigma_m**2 * np.eye(2)
    budget.close("calibration")
    own_m2 = moved_m2[HORIZONTAL, HORIZONTAL] + alternative_m2
    doubt_m2 = positive_part(cov[HORIZONTAL, HORIZONTAL] - graph_m2 - alternative_m2 + np.outer(other_m, other_m))
    amsl_m, amsl_sigma_m = state.amsl(frame)
    cov[UP, UP] += amsl_sigma_m**2
    return Claim(
        frame.pose.translation()[HORIZONTAL] + shift_m + other_m, cov, amsl_m, budget.terms_m2, own_m2, doubt_m2
    )


class _Budget:
    """A covariance (6, 6), and the mean horizontal variance by which each term changes it."""

    def __init__(self, cov: np.ndarray) -> None:
        self.cov = cov
        self.terms_m2 = {"graph": self._horizontal_m2()}

    def close(self, term: str) -> None:
        """All that was added since the call before belongs to ``term``."""
        self.terms_m2[term] = self._horizontal_m2() - sum(self.terms_m2.values())

    def _horizontal_m2(self) -> float:
        return 0.5 * float(np.trace(self.cov[HORIZONTAL, HORIZONTAL]))
