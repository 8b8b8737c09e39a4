"""Relocalisations: gated, confirmed by a second one, and fused."""

from dataclasses import dataclass, replace

import numpy as np

from terrafix.estimator.filter_state import FilterState
from terrafix.estimator.integrity.fragments import CONFIRM_FRAMES
from terrafix.estimator.integrity.innovation import FusionVerdict
from terrafix.estimator.integrity.innovation_run import InnovationRun
from terrafix.estimator.measurements.contract import fuse
from terrafix.estimator.measurements.relocalization import RelocalizationMeasurement
from terrafix.messages import Relocalization, Verdict


@dataclass(frozen=True)
class RelocalizationResult:
    """``fusion``: the verdict. ``measurement``: of an accepted relocalisation."""

    fusion: FusionVerdict
    measurement: RelocalizationMeasurement | None = None


class RelocalizationUpdate:
    """``apply`` every Relocalization, after its frame."""

    def __init__(self, state: FilterState) -> None:
        self._state = state
        self._run = InnovationRun()  # of those that passed the gate, since the last rejection or the last fused one

    def apply(self, seen: Relocalization) -> RelocalizationResult:
        """An accepted one joins the fragment of its frame to the flight, if that of the keyframe is."""
        state = self._state
        node, keyframe = state.node_of.get(seen.frame_id), state.keyframe(seen.keyframe_id)
        if node is None or not state.graph.holds(node):
            return _refused(Verdict.STALE, "frame has left the window")
        if keyframe is None:
            return _refused(Verdict.STALE, "the pose of the keyframe is not known")
        if state.yaw_gauge is not None:
            return _refused(Verdict.NO_PREDICTION, "the heading is unknown")
        measurement = RelocalizationMeasurement.of(seen, keyframe.view, state, node)
        if isinstance(measurement, Verdict):
            return _refused(measurement, f"{seen.inliers} inliers")
        innovation, here_m = measurement.innovation(state, node), state.graph.state(node).pose.translation()[:2]
        offset_m = np.asarray(measurement.pose.translation())[:2] - here_m
        if innovation.is_accepted:
            self._run.add(offset_m, here_m, position_only=False)
        else:
            self._run.clear()
        if innovation.is_accepted and not self._run.is_confirmed(CONFIRM_FRAMES, 0.0):
            detail = _detail(seen, offset_m)
            return RelocalizationResult(FusionVerdict(measurement.name, Verdict.UNCONFIRMED, innovation, detail))
        fusion = replace(fuse(state, node, measurement), detail=_detail(seen, offset_m))
        if fusion.verdict is not Verdict.ACCEPTED:
            return RelocalizationResult(fusion)
        state.last_fused_s = max(state.last_fused_s, state.graph.time_of(node))
        state.refresh_newest()
        self._run.clear()  # it goes on at the corrected estimate: the next one near it needs no other
        self._run.add(np.zeros(2), here_m, position_only=False)
        if keyframe.fragment.joined:
            state.fragments.of(node).join()
            state.contradicted_images.end()
        return RelocalizationResult(fusion, measurement)


def _refused(verdict: Verdict, detail: str) -> RelocalizationResult:
    return RelocalizationResult(FusionVerdict("relocalization", verdict, None, detail))


def _detail(seen: Relocalization, offset_m: np.ndarray) -> str:
    away_m = float(np.hypot(*offset_m))
    return f"keyframe {seen.keyframe_id} of fragment {seen.keyframe_fragment_id}, {away_m:.0f} m from the estimate"
