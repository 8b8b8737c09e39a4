"""The estimator: frames, map matches and dead reckoning go in, the state of the newest frame comes out.

Composed of `FilterState` (graph and window), `Propagation` (frames) and `MapUpdate` (map matches), as OpenVINS is of
`State`, `Propagator` and its updaters."""

from dataclasses import dataclass

import numpy as np

from terrafix.estimator.filter_state import FilterState, FrameInput, FrameState, ImuQuery
from terrafix.estimator.graph.pose_graph import PoseGraph
from terrafix.estimator.integrity.doubts import Doubts
from terrafix.estimator.integrity.position_hypotheses import PositionHypotheses
from terrafix.estimator.map_update import MapResult, MapUpdate
from terrafix.estimator.measurements.ekf_dead_reckoning import DeadReckoning
from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.models.terrain import Terrain
from terrafix.estimator.prior import NavPrior
from terrafix.estimator.propagation import Propagation, PropagationResult
from terrafix.estimator.relocalization_update import RelocalizationResult, RelocalizationUpdate
from terrafix.messages import MapMatch, Origin, Relocalization


@dataclass(frozen=True)
class PastPose:
    """A refined camera: position ``p_m`` (3,), ``r_w_c`` (3, 3), covariance ``cov`` (6, 6) of position, then rotation,
    world axes, without the error of the map, and the fragment of the frame."""

    p_m: np.ndarray
    r_w_c: np.ndarray
    cov: np.ndarray
    fragment_id: int


class Estimator:
    """``feed_frame`` with every frame in order of time; ``feed_map_match`` and ``feed_relocalization`` with those of a
    frame that was fed, whenever they come; ``feed_dead_reckoning`` with what the autopilot did while none ran."""

    def __init__(self, origin: Origin, prior: NavPrior | None = None, graph: PoseGraph | None = None) -> None:
        """``prior``: where an estimator that ran before in this flight left off. ``graph``: None: a new one."""
        self.state = FilterState(origin, graph, None if prior is None else prior.lens)
        self._propagation = Propagation(self.state, prior)
        self._map_update = MapUpdate(self.state)
        self._relocalization_update = RelocalizationUpdate(self.state)
        self.doubts = Doubts()

    def feed_frame(self, frame: FrameInput) -> PropagationResult:
        """A new node. -> the predicted camera and the verdicts on what was measured."""
        return self._propagation.advance(frame)

    def feed_map_match(self, match: MapMatch) -> MapResult:
        """Gated, and fused at the node of its frame."""
        return self._map_update.apply(match)

    def feed_relocalization(self, seen: Relocalization) -> RelocalizationResult:
        """Gated, and fused at the node of its frame."""
        return self._relocalization_update.apply(seen)

    def feed_dead_reckoning(self, sample: DeadReckoning, attitude: Attitude | None, imu: ImuQuery) -> bool:
        """-> whether the newest frame, whose ``attitude`` is given, is placed by ``sample``."""
        return self._propagation.add_dead_reckoning(sample, attitude, imu)

    @property
    def origin(self) -> Origin:
        return self.state.origin

    @property
    def graph(self) -> PoseGraph:
        return self.state.graph

    @property
    def terrain(self) -> Terrain:
        return self.state.terrain

    @property
    def last(self) -> FrameState | None:
        """Newest frame, with its newest estimate; None: there was no frame."""
        return self.state.last

    @property
    def last_fix_s(self) -> float | None:
        """Time of the newest frame with an accepted map match; None: there is none."""
        return self.state.last_fix_s

    @property
    def dead_reckoned_s(self) -> float:
        """Time of the frame that the autopilot's dead reckoning has placed; 0: there is none."""
        return self._propagation.dead_reckoned_s

    @property
    def hypotheses(self) -> PositionHypotheses:
        return self._map_update.hypotheses

    @property
    def map_sigma_m(self) -> float:
        """1-sigma error of the map of the newest accepted match; 0: there was none."""
        return self._map_update.map_sigma_m

    def forget_rejected(self) -> None:
        """What has contradicted the position is explained: the frames were of another time."""
        self._map_update.forget_rejected()

    def refine(self) -> dict[int, PastPose]:
        """After landing: frame -> camera by all that was measured in the flight; only of frames that a place stands
        behind."""
        result, state, doubts_m2 = dict[int, PastPose](), self.state, self.doubts.of_frames()
        jacobians = np.array(state.principal_point_jacobians).reshape(-1, 2, 2)
        frames = zip(state.frames, jacobians, *state.graph.refine(), strict=True)
        for node, (frame, jacobian, p_m, r_w_c, cov) in enumerate(frames):
            if state.first_placed_node is None or node < state.first_placed_node:
                continue
            if np.isfinite(p_m).all() and np.isfinite(cov).all():
                if frame in doubts_m2:
                    cov[:2, :2] += doubts_m2[frame]
                shift_m, shift_cov = state.principal_point.shift(jacobian)
                p_m[:2] += shift_m
                cov[:2, :2] += shift_cov
                result[frame] = PastPose(p_m, r_w_c, cov, state.fragment_ids[node])
        return result
