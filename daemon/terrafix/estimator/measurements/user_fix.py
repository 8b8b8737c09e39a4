"""The position of a frame by a user fix: an operator has named the place that one of its pixels shows."""

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C

from terrafix.core.gate import GATE
from terrafix.core.pose import tangent_to_world
from terrafix.estimator.filter_state import FilterState
from terrafix.estimator.integrity.innovation import FusionVerdict, Innovation
from terrafix.estimator.measurements.contract import fuse
from terrafix.estimator.measurements.relocalization import NO_INFORMATION_M2
from terrafix.messages import Verdict

USER_FIX_VERDICT = "user_fix"


@dataclass(frozen=True)
class UserFixMeasurement:
    """``at_m`` (2,): east and north of the camera, with the 1-sigma ``sigma_m`` per axis."""

    at_m: np.ndarray
    sigma_m: float
    name: str = USER_FIX_VERDICT

    def innovation(self, state: FilterState, node: int) -> Innovation:
        pose = state.graph.state(node).pose
        cov = tangent_to_world(state.covariance(node), pose.rotation().matrix())[:2, :2]
        return Innovation(self.at_m - pose.translation()[:2], self.sigma_m**2 * np.eye(2) + cov, GATE[2])

    def add_to(self, state: FilterState, node: int) -> None:
        noise = gtsam.noiseModel.Diagonal.Variances(np.array([self.sigma_m**2, self.sigma_m**2, NO_INFORMATION_M2]))
        state.add_factors(node, gtsam.GPSFactor(C(node), np.array([*self.at_m, 0.0]), noise))


def apply_user_fix(state: FilterState, frame_id: int, fix: UserFixMeasurement) -> FusionVerdict:
    """Gates a fix of a frame in the window, and adds it. An accepted one joins the fragment of its frame."""
    node = state.node_of.get(frame_id)
    if node is None or not state.graph.holds(node):
        return FusionVerdict(USER_FIX_VERDICT, Verdict.STALE, None, "frame has left the window")
    if state.yaw_gauge is not None:
        return FusionVerdict(USER_FIX_VERDICT, Verdict.NO_PREDICTION, None, "the heading is unknown")
    away_m = float(np.hypot(*(fix.at_m - state.graph.state(node).pose.translation()[:2])))
    fusion = fuse(state, node, fix)
    if fusion.verdict is Verdict.ACCEPTED:
        state.refresh_newest()
        state.fragments.of(node).join()
        state.on_placed()
    return FusionVerdict(USER_FIX_VERDICT, fusion.verdict, fusion.innovation, f"{away_m:.0f} m from the estimate")
