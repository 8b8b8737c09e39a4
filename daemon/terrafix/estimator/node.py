"""Messages of the estimator: odometry, telemetry and map matches in; prediction, estimate and verdicts out."""

import math
from collections.abc import Callable, Iterable

import msgspec
import numpy as np
from msgspec import UNSET

from terrafix.core.agreement import Cause
from terrafix.core.camera import Mount
from terrafix.core.geodesy import LocalFrame
from terrafix.core.initial_position import with_initial_position
from terrafix.core.limits import MIN_MATCHING_AGL_M
from terrafix.core.node import Edge, NodeBase, NodeContext
from terrafix.core.pose import tangent_to_world
from terrafix.estimator.claim import Claim
from terrafix.estimator.edge import EstimatorEdge
from terrafix.estimator.estimator import Estimator
from terrafix.estimator.filter_state import FilterState, FrameInput, FrameState
from terrafix.estimator.initialization import ResetReason
from terrafix.estimator.integrity.camera_vehicle import CameraVehicleTest
from terrafix.estimator.integrity.innovation import FusionVerdict, Innovation
from terrafix.estimator.integrity.offset_drift import STEP_S
from terrafix.estimator.integrity.time_offset import Contradiction, TimeOffset
from terrafix.estimator.map_update import NOTHING_FOUND
from terrafix.estimator.measurements.ahrs_correction import AhrsCorrectionMonitor
from terrafix.estimator.measurements.ekf_dead_reckoning import DeadReckoning
from terrafix.estimator.measurements.odometry import NO_NEW_VIEW, without_ground
from terrafix.estimator.measurements.telemetry_buffer import Attitude, Telemetry
from terrafix.estimator.measurements.user_fix import UserFixMeasurement, apply_user_fix
from terrafix.estimator.monitors.calibration_monitors import Monitors
from terrafix.estimator.monitors.refused_pictures import INPUT_KINDS, OTHER, UNSEEN, RefusedInput, UnseenGround
from terrafix.estimator.output import (
    calibration_of,
    estimate_of,
    odometry_verdict,
    prediction_of,
    refinement_of,
    verdict_of,
)
from terrafix.estimator.pose_estimator import EstimatedFlight, OpenCVGtsamPoseEstimator, PoseEstimator, covariance_mode
from terrafix.estimator.prior import EstimatorCheckpoint, NavPrior, load_checkpoint
from terrafix.estimator.propagation import PropagationResult
from terrafix.estimator.rolling_shutter import RollingShutter
from terrafix.estimator.smoother_inputs import map_anchor, odometry_link, relocalization_link
from terrafix.messages import (
    CalibrationFault,
    CandidateAttitude,
    ClaimBudget,
    CovarianceMode,
    EkfDeadReckoning,
    Frame,
    GimbalAttitude,
    Health,
    Imu,
    InitialPosition,
    MapMatch,
    Message,
    NavEstimate,
    Odometry,
    Origin,
    PositionHint,
    Prediction,
    Relocalization,
    ServedVehicle,
    SourceEnded,
    ThermalBand,
    VehicleState,
    Verdict,
)

CALIBRATION_EVERY_NS = 1_000_000_000  # between two CalibrationEstimate [spec: 1 Hz]
TELEMETRY_WAIT_NS = 1_000_000_000  # the autopilot's heartbeat comes once a second [spec: MAVLink heartbeat]
# Until the first Health
COOL = Health(
    t_ns=0, band=ThermalBand.NORMAL, temperature_c=None, throttled=False, disk_free_mb=None, cause="no reading yet"
)
START_QUANTITY = "start"
NO_VIEW = (Verdict.BAD_IMAGE, Verdict.OVERTAKEN, Verdict.NO_GROUND)  # frames that repeat nothing, and show nothing new
BEFORE_TELEMETRY = "older than the autopilot's first messages after the restart"

MakeEstimator = Callable[[Origin, NavPrior | None], Estimator]


class EstimatorNode(NodeBase):
    """Node of the estimator: odometry, telemetry and map matches in; estimates, predictions and verdicts out."""

    def __init__(
        self,
        began_ns: int | None = None,
        checkpoint: EstimatorCheckpoint | None = None,
        make_estimator: MakeEstimator = Estimator,
    ) -> None:
        """``began_ns``: time at which the flight began, if this process was restarted in flight; else None.
        ``checkpoint``: last messages of the process before, if it left any."""
        self._began_ns, self._checkpoint, self._make_estimator = began_ns, checkpoint, make_estimator
        self._origin: Origin | None = None  # as vision published it
        # Newest InitialPosition, which the Origin lacks
        self._initial = None if checkpoint is None else checkpoint.initial_position
        self._initial_pending = False  # it is applied with the next frame
        self._first_frame_id = 0  # of the flight from the newest InitialPosition
        self._estimator: Estimator | None = None
        self._axes: LocalFrame | None = None
        self._flight: EstimatedFlight | None = None  # of the newest estimator
        self._telemetry = Telemetry()
        self._camera_vehicle = CameraVehicleTest(None if checkpoint is None else checkpoint.camera_vehicle)
        sent_ns = None if checkpoint is None else checkpoint.estimate.t_ns
        self._ahrs = AhrsCorrectionMonitor(self._telemetry, sent_ns)
        self._attitude: Attitude | None = None  # at the newest frame
        self._shutter: RollingShutter | None = None  # of the camera of the Origin
        self._early_dead_reckoning: list[
            EkfDeadReckoning
        ] = []  # before the Origin: the link may run before vision does
        self._thermal = COOL
        self._tracked = True  # the newest frame has odometry or a map match
        self._calibration_ns = 0  # of the newest CalibrationEstimate
        self._first_ns: int | None = None  # time of the first frame or telemetry
        self._waiting: list[Odometry] = []  # for telemetry, to which the calibration of the checkpoint refers
        self._stamp_ns: int | None = None  # of the newest frame, by the camera
        self._predicted_id: int | None = None  # frame of the newest Prediction ...
        self._predicted_m = np.zeros(2)  # ... its position, after its map match,
        self._predicted_m2 = np.zeros((2, 2))  # ... with this covariance
        self._relocated = False  # a relocalisation has moved the estimate since
        self._monitors: Monitors | None = None
        self._rebuilds = 0  # of the graph
        self._refused, self._gimbal_refused, self._unseen = RefusedInput(), RefusedInput(), UnseenGround()
        self._start_moved = False  # as reported
        self._handlers: dict[type[Message], Callable[..., Iterable[Message]]] = {
            Origin: self._on_origin,
            InitialPosition: self._on_initial_position,
            VehicleState: self._on_vehicle_state,
            Imu: self._on_imu,
            GimbalAttitude: self._on_gimbal,
            ServedVehicle: self._on_served_vehicle,
            CandidateAttitude: self._on_candidate_attitude,
            EkfDeadReckoning: self._on_dead_reckoning,
            PositionHint: self._on_position_hint,
            Health: self._on_health,
            Frame: self._on_frame,
            Odometry: self._on_odometry,
            Relocalization: self._on_relocalization,
            MapMatch: self._on_map_match,
            SourceEnded: self._on_source_ended,
        }

    @property
    def origin(self) -> Origin | None:
        """Origin of the estimator, with the InitialPosition applied; None before the Origin."""
        return None if self._estimator is None else self._estimator.origin

    @property
    def estimator(self) -> Estimator | None:
        """The estimator of the flight; None before the Origin."""
        return self._estimator

    @property
    def pose_estimator(self) -> PoseEstimator | None:
        """What adds map matches to the graph of the flight, for callers without messages; None before the Origin."""
        return None if self._flight is None else OpenCVGtsamPoseEstimator(self._flight)

    @property
    def mode(self) -> CovarianceMode:
        """Covariance mode of the next estimate, by the thermal band."""
        return covariance_mode(self._thermal)

    def on(self, message: Message) -> Iterable[Message]:
        handler = self._handlers.get(type(message))
        return () if handler is None else handler(message)

    # --- flight and start ----------------------------------------------------------------------------------------

    def _on_origin(self, origin: Origin) -> Iterable[Message]:
        if origin == self._origin:  # published again after a restart
            return
        self._origin, self._monitors = origin, Monitors(origin)
        self._axes = LocalFrame(origin.lat_deg, origin.lon_deg)
        self._telemetry.gimbal.describe(origin.camera)
        self._predicted_id = None  # in other axes
        prior = self._prior(origin, self._axes)
        offset, self._shutter = TimeOffset(Mount.of(origin.camera).r_b_c()), RollingShutter(origin.camera)
        self._begin(self._make_estimator(with_initial_position(origin, self._initial), prior), offset)
        waiting, self._early_dead_reckoning = self._early_dead_reckoning, []
        for sample in waiting:
            yield from self._on_dead_reckoning(sample)

    def _on_initial_position(self, initial: InitialPosition) -> Iterable[Message]:
        if not self._is_placed_by_map and (self._initial is None or initial.t_ns != self._initial.t_ns):
            self._initial, self._initial_pending = initial, True
        return ()

    @property
    def _is_placed_by_map(self) -> bool:
        """A map match was accepted, so that no InitialPosition counts any more."""
        if self._estimator is not None and self._estimator.last_fix_s is not None:
            return True
        return self._checkpoint is not None and self._checkpoint.estimate.last_anchor_age_ms >= 0

    def _apply_initial_position(self, frame_id: int, t_ns: int, *, stands: bool) -> Estimator:
        """With the first frame after an InitialPosition. A vehicle that still stands is at that position;
        another one was there."""
        assert self._origin is not None and self._axes is not None and self._initial is not None
        self._initial_pending, self._predicted_id, self._first_frame_id = False, None, frame_id
        prior = NavPrior.at_initial_position(self._initial, self._axes, (t_ns if stands else self._initial.t_ns) * 1e-9)
        assert self._flight is not None
        estimator = self._make_estimator(with_initial_position(self._origin, self._initial), prior)
        return self._begin(estimator, self._flight.time_offset)

    def _begin(self, estimator: Estimator, time_offset: TimeOffset) -> Estimator:
        """``time_offset``: of the camera, so far."""
        assert self._axes is not None and self._monitors is not None
        self._estimator = estimator
        estimator.hypotheses.use(self._monitors.agreement)
        if self._is_placed_by_map:
            self._monitors.agreement.begin(Cause.START, -math.inf)
        self._flight = EstimatedFlight(estimator, self._axes, time_offset, self._monitors, self._telemetry)
        return estimator

    def _prior(self, origin: Origin, axes: LocalFrame) -> NavPrior | None:
        if self._began_ns is None:
            return None
        if self._checkpoint is not None:
            return NavPrior.of(self._checkpoint, axes, origin.camera)
        return NavPrior.start(origin, self._began_ns * 1e-9)

    # --- telemetry -----------------------------------------------------------------------------------------------

    def _on_vehicle_state(self, state: VehicleState) -> Iterable[Message]:
        self._first_ns = state.t_ns if self._first_ns is None else self._first_ns
        self._telemetry.add(state)
        self._camera_vehicle.on_vehicle_state(state)
        return self._waiting_frames()

    def _on_served_vehicle(self, served: ServedVehicle) -> Iterable[Message]:
        answer = self._camera_vehicle.on_served(served)
        return () if answer is None else (answer,)

    def _on_candidate_attitude(self, attitude: CandidateAttitude) -> Iterable[Message]:
        self._camera_vehicle.on_candidate(attitude)
        return ()

    def _on_imu(self, imu: Imu) -> Iterable[Message]:
        self._telemetry.add_imu(imu)
        return ()

    def _on_gimbal(self, attitude: GimbalAttitude) -> Iterable[Message]:
        self._telemetry.add_gimbal(attitude)
        return ()

    def _on_health(self, health: Health) -> Iterable[Message]:
        self._thermal = health
        return ()

    def _on_dead_reckoning(self, sample: EkfDeadReckoning) -> Iterable[Message]:
        if self._checkpoint is None:
            return
        estimator, axes = self._estimator, self._axes
        if estimator is None or axes is None:
            self._early_dead_reckoning.append(sample)
            return
        if estimator.last_fix_s is not None:
            return
        placed = estimator.feed_dead_reckoning(
            DeadReckoning.of(sample, axes), self._attitude, self._ahrs.world_acceleration
        )
        if placed and estimator.last is not None:
            yield self._estimate(estimator, estimator.last, self._claim(estimator.last), sample.t_ns)

    def _on_position_hint(self, hint: PositionHint) -> Iterable[Message]:
        """A user fix is a measurement of the position; a coarse hint is one of the search alone."""
        estimator, axes = self._estimator, self._axes
        if hint.sigma_m is None or estimator is None or axes is None:
            return
        if not self._relocated:
            self._note_predicted_frame(estimator)  # before it moves: the anchor's belief has to move as far
        fix = UserFixMeasurement(np.array(axes.to_local(hint.lat_deg, hint.lon_deg)), hint.sigma_m)
        fusion = apply_user_fix(estimator.state, hint.frame_id, fix)
        yield from self._verdicts(estimator, hint, fusion)
        if fusion.verdict is Verdict.ACCEPTED and estimator.last is not None:
            self._relocated = True
            yield self._estimate(estimator, estimator.last, self._claim(estimator.last), hint.t_ns)

    # --- frames --------------------------------------------------------------------------------------------------

    def _on_frame(self, frame: Frame) -> Iterable[Message]:
        if self._flight is not None:
            self._flight.time_offset.stamped(frame)
        return ()

    def _on_odometry(self, odometry: Odometry) -> Iterable[Message]:
        self._waiting.append(odometry)
        return self._waiting_frames()

    def _waiting_frames(self) -> Iterable[Message]:
        """All frames that wait, once the graph can begin with the first of them. After a restart vision may run before
        the link does; a graph without heading and height would have to begin anew, and the anchor would match at all
        headings and heights for seconds. A frame that is older than the first telemetry is left out when a newer one
        is not."""
        if not self._waiting:
            return
        begins = self._estimator is not None and self._estimator.last is None
        if begins and self._checkpoint is not None and self._checkpoint.calibration is not None:
            attitudes = [self._telemetry.at(odometry.t_ns) for odometry in self._waiting]
            known = [attitude.yaw_rad is not None and attitude.agl_m is not None for attitude in attitudes]
            if any(known):
                older, self._waiting = self._waiting[: known.index(True)], self._waiting[known.index(True) :]
                yield from (odometry_verdict(odometry, Verdict.STALE, BEFORE_TELEMETRY) for odometry in older)
            elif self._waiting[-1].t_ns - self._waiting[0].t_ns < TELEMETRY_WAIT_NS:
                return
        waiting, self._waiting = self._waiting, []
        for odometry in waiting:
            yield from self._frame(odometry)

    def _frame(self, odometry: Odometry) -> Iterable[Message]:
        if self._estimator is None or self._flight is None:
            return
        stamped_ns, time_offset = odometry.t_ns, self._flight.time_offset
        if (camera_vehicle := self._camera_vehicle.on_odometry(odometry, self._estimator.origin.camera)) is not None:
            yield camera_vehicle
        odometry = self._in_telemetry_time(odometry, time_offset)
        newest = self._estimator.last
        offset = odometry.t_ns != stamped_ns
        if offset and newest is not None and odometry.t_ns * 1e-9 < newest.t_s + STEP_S:  # it has jumped
            yield odometry_verdict(odometry, Verdict.STALE, "taken before the newest frame")
            return
        estimator, frame = self._frame_input(self._estimator, odometry)
        odometry = frame.odometry
        follows = not self._relocated and self._note_predicted_frame(estimator)
        self._relocated = False
        result = estimator.feed_frame(frame)
        self._tracked = result.verdict is Verdict.ACCEPTED
        yield from self._verdicts(estimator, odometry, *result.verdicts)
        no_new_view = odometry.verdict in NO_NEW_VIEW or result.verdict is Verdict.STALLED
        no_new_view = no_new_view or estimator.state.orientation.refuses  # the anchor would search for it elsewhere
        if not no_new_view and not self._awaits_telemetry(odometry.t_ns, frame.attitude, estimator):
            yield self._prediction(odometry.t_ns, result, estimator, follows=follows)
            self._predicted_id = odometry.frame_id
        slow_due = self._is_slow_due(result.placed, estimator)
        if slow_due:
            yield calibration_of(estimator, result.placed)
        if self._monitors is not None:
            p = result.placed.pose.translation()
            agl_m = estimator.terrain.height_above_m(p)
            orientation = estimator.state.orientation.fault
            self._monitors.on_odometry(odometry, self._telemetry, float(np.hypot(*result.step_m)), agl_m, orientation)
            yield from self._monitors.take_changes(odometry.t_ns)
            # Turned or mirrored images move otherwise at any time, repeated ones not at all, those of no ground anyhow.
            # Near the ground images move by more than their error, and on it the attitude wanders alone.
            low = frame.attitude.stands or agl_m < MIN_MATCHING_AGL_M
            if result.verdict not in NO_VIEW:
                time_offset.view(stamped_ns, repeated=result.verdict is Verdict.STALLED)
            untimed = result.verdict is Verdict.STALLED or not frame.attitude.sees_ground or low
            untimed = untimed or bool(frame.attitude.gimbal_refused)  # what moves the image is not the vehicle alone
            jump = estimator.state.image_jump
            if estimator.state.orientation.suspects or untimed:
                time_offset.forget_images()
            else:
                if jump is not None and jump[0] == frame.t_s:
                    self._time_contradicted(stamped_ns, jump[1], result.placed, odometry.keyframe_id)
                elif time_offset.is_held and result.off is not None:
                    self._time_contradicted(stamped_ns, result.off, result.placed, odometry.keyframe_id)
                time_offset.add(msgspec.structs.replace(odometry, t_ns=stamped_ns), self._telemetry, agl_m)
            yield from time_offset.take_changes(odometry.t_ns)
        yield from self._refused_pictures(odometry.t_ns, result.verdict, estimator.state, frame.attitude)
        yield from self._gimbal_refused.add(odometry.t_ns, frame.attitude.gimbal_refused)
        yield from self._start_fault(estimator, odometry.t_ns)
        budget = self._claim(result.placed)
        if slow_due:
            yield ClaimBudget(t_ns=odometry.t_ns, frame_id=odometry.frame_id, terms_m2=budget.terms_m2)
        estimate = self._estimate(estimator, result.placed, budget, odometry.t_ns)
        if estimator.last_fix_s is not None:  # before that the autopilot has, or had, another position
            self._ahrs.position_published(estimate.t_ns, estimate.velocity_sigma_mps)
        yield estimate
        yield from odometry_link(estimator, result, odometry.t_ns)  # last: it delays nothing

    def _time_contradicted(self, t_ns: int, off: Innovation, frame: FrameState, keyframe_id: int = -1) -> None:
        """``off``: the frame at the uncorrected ``t_ns`` from the estimate, by images since ``keyframe_id``; -1: by the
        map. ``frame``: the newest one."""
        assert self._flight is not None
        agl_m = max(self._flight.estimator.terrain.height_above_m(frame.pose.translation()), 1.0)
        seen = Contradiction(t_ns, off, frame.velocity_mps[:2], agl_m, keyframe_id)
        self._flight.time_offset.contradict(seen, self._telemetry, by_map=keyframe_id < 0)

    def _refused_pictures(
        self, t_ns: int, verdict: Verdict, state: FilterState, attitude: Attitude
    ) -> Iterable[Message]:
        """Faults of pictures that are refused for no reason that has a name already."""
        assert self._flight is not None
        if attitude.stands:  # a camera on the ground is out of focus
            return ()
        if verdict is Verdict.UNCONFIRMED and not state.continuity.last_increment_inertial:
            return ()  # nothing says how the vehicle moves
        flight = self._flight
        if state.orientation.fault is not None or flight.time_offset.is_wrong or flight.monitors.focal_changed:
            return self._refused.add(t_ns, "")
        since_ns = self._unseen.since_ns
        known = None if since_ns is None else (UNSEEN, since_ns)
        return self._refused.add(
            t_ns, INPUT_KINDS.get(verdict), (OTHER, t_ns) if state.contradicted_images.active else known
        )

    def _start_fault(self, estimator: Estimator, t_ns: int) -> Iterable[Message]:
        moved = estimator.state.start_moved
        if moved == self._start_moved:
            return
        self._start_moved = moved
        detail = "the vehicle moves as if it had stood on what moves" if moved else "the map has placed it"
        yield CalibrationFault(t_ns=t_ns, quantity=START_QUANTITY, factor=None, detail=detail, active=moved)

    def _in_telemetry_time(self, odometry: Odometry, time_offset: TimeOffset) -> Odometry:
        """``odometry``, with the estimated time offset of the camera taken from its time."""
        stamp_ns = odometry.t_ns
        self._first_ns = stamp_ns if self._first_ns is None else self._first_ns
        before_ns, self._stamp_ns = stamp_ns if self._stamp_ns is None else self._stamp_ns, stamp_ns
        if time_offset.step((stamp_ns - before_ns) * 1e-9) and self._estimator is not None:
            self._estimator.forget_rejected()
        if not time_offset.applied_s:
            return odometry
        return msgspec.structs.replace(odometry, t_ns=stamp_ns - round(time_offset.applied_s * 1e9))

    def _frame_input(self, estimator: Estimator, odometry: Odometry) -> tuple[Estimator, FrameInput]:
        """-> the estimator, a new one if an InitialPosition is pending, and what it takes of the frame."""
        origin = estimator.origin
        sigmas_rad = math.radians(origin.attitude_sigma_deg), math.radians(origin.yaw_sigma_deg)
        attitude = self._attitude = self._ahrs.attitude_at(odometry.t_ns, *sigmas_rad)
        if self._initial_pending:
            estimator = self._apply_initial_position(odometry.frame_id, odometry.t_ns, stands=attitude.stands)
        estimator.state.covariances.set_mode(self.mode)
        imu = self._ahrs.world_acceleration
        if not attitude.sees_ground:
            odometry = without_ground(odometry)
        elif self._shutter is not None:
            odometry = self._shutter.corrected(odometry, estimator.state, attitude, self._telemetry)
        estimator.state.on_gimbal = self._telemetry.gimbal.used
        return estimator, FrameInput(odometry.frame_id, odometry.t_ns * 1e-9, odometry, attitude, imu)

    def _note_predicted_frame(self, estimator: Estimator) -> bool:
        """Position of the frame of the newest Prediction, after its map match. -> whether that is the newest frame."""
        last = estimator.last
        if last is None or last.frame_id != self._predicted_id:
            return False
        self._predicted_m = np.array(last.pose.translation()[:2])
        self._predicted_m2 = tangent_to_world(last.cov, last.pose.rotation().matrix())[:2, :2]
        return True

    def _verdicts(
        self, estimator: Estimator, of: Odometry | PositionHint | Relocalization | MapMatch, *verdicts: FusionVerdict
    ) -> list[Message]:
        """``verdicts``, and one more where the graph was rebuilt from its last good estimate since the call before."""
        before, self._rebuilds = self._rebuilds, estimator.graph.rebuilds
        if estimator.graph.rebuilds > before:
            verdicts += (FusionVerdict("reset", Verdict.ACCEPTED, None, ResetReason.INDETERMINATE.value),)
        fragment = estimator.state.fragment_of(of.frame_id)
        return [verdict_of(of.t_ns, of.frame_id, verdict, fragment) for verdict in verdicts]

    def _awaits_telemetry(self, t_ns: int, attitude: Attitude, estimator: Estimator) -> bool:
        """Whether a frame at ``t_ns`` comes so early that heading and height may yet be reported: the anchor would
        match at all headings and heights for seconds, while vision and the link have only begun."""
        if self._first_ns is None or self._checkpoint is not None or estimator.last_fix_s is not None:
            return False
        unknown = attitude.yaw_rad is None or attitude.agl_m is None
        return unknown and 0 <= t_ns - self._first_ns < TELEMETRY_WAIT_NS

    def _prediction(self, t_ns: int, result: PropagationResult, estimator: Estimator, *, follows: bool) -> Prediction:
        """The Prediction of a frame. ``follows``: the frame before had one, too. Else the step is the displacement of
        the present estimate since the last Prediction: odometry that begins again determines the velocity in
        between."""
        frame = result.placed
        step_m, step_var_m2 = result.step_m, result.step_sigma_m**2
        if not follows and self._predicted_id is not None:
            cov = tangent_to_world(frame.cov, frame.pose.rotation().matrix())
            step_m = np.asarray(frame.pose.translation()[:2]) - self._predicted_m
            step_var_m2 += max(float(np.linalg.eigvalsh(cov[:2, :2] - self._predicted_m2)[-1]), 0.0)
        prior_t_ns = 0 if self._initial is None else self._initial.t_ns
        motion = UNSET if self._shutter is None else self._shutter.motion
        return prediction_of(estimator, frame, t_ns, step_m, step_var_m2, prior_t_ns, motion)

    def _is_slow_due(self, frame: FrameState, estimator: Estimator) -> bool:
        """Whether CalibrationEstimate and ClaimBudget are published with this frame: once a second, not before a map
        match (they are the prior until then), and only in the normal thermal band."""
        t_ns, hot = round(frame.t_s * 1e9), self.mode is CovarianceMode.JACOBIAN
        if hot or estimator.last_fix_s is None or t_ns - self._calibration_ns < CALIBRATION_EVERY_NS:
            return False
        self._calibration_ns = t_ns
        return True

    def _claim(self, frame: FrameState) -> Claim:
        """Of ``frame``, the newest one."""
        assert self._flight is not None
        claim, estimator = self._flight.claim(frame), self._flight.estimator
        first_node, fix_s = estimator.state.first_node, estimator.last_fix_s
        estimator.doubts.record(frame, first_node, fix_s, claim.own_m2, claim.doubt_m2)
        return claim

    def _estimate(self, estimator: Estimator, frame: FrameState, budget: Claim, t_ns: int) -> NavEstimate:
        assert self._axes is not None
        return estimate_of(estimator, frame, self._axes, budget, t_ns, tracked=self._tracked)

    def _on_relocalization(self, seen: Relocalization) -> Iterable[Message]:
        estimator = self._estimator
        if estimator is None:
            return
        if not self._relocated:
            self._note_predicted_frame(estimator)  # before it moves: the anchor's belief has to move as far
        result = estimator.feed_relocalization(seen if self._shutter is None else self._shutter.relocalized(seen))
        fusion = result.fusion
        yield from self._verdicts(estimator, seen, fusion)
        if fusion.verdict is not Verdict.ACCEPTED or estimator.last is None:
            return
        self._relocated = True
        self._tracked = self._tracked or seen.frame_id == estimator.last.frame_id
        yield self._estimate(estimator, estimator.last, self._claim(estimator.last), seen.t_ns)
        if result.measurement is not None:
            yield relocalization_link(estimator, seen, result.measurement)

    # --- map matches ---------------------------------------------------------------------------------------------

    def _on_map_match(self, match: MapMatch) -> Iterable[Message]:
        estimator, flight = self._estimator, self._flight
        if estimator is None or flight is None:
            return
        if match.frame_id < self._first_frame_id:  # of ground and belief before the InitialPosition
            yield verdict_of(match.t_ns, match.frame_id, FusionVerdict("map", Verdict.STALE))
            return
        was_multimodal = estimator.hypotheses.is_multimodal
        outcome = flight.fuse(match, self.mode)
        result = outcome.result
        yield from self._verdicts(estimator, match, *result.verdicts)
        fragment = estimator.state.fragment_of(match.frame_id)
        yield outcome.solution
        accepted = result.verdict is Verdict.ACCEPTED
        if (accepted or result.verdict in NOTHING_FOUND) and fragment is not None and estimator.last is not None:
            p = estimator.last.pose.translation()
            at = p[:2] / max(estimator.terrain.height_above_m(p), 1.0)
            self._unseen.add(match.t_ns, fragment.fragment_id, at, shown=accepted)
        if result.off is not None and estimator.last is not None and (flight.time_offset.is_held or not accepted):
            stamp_ns = match.t_ns + round(flight.time_offset.applied_s * 1e9)
            self._time_contradicted(stamp_ns, result.off, estimator.last)
            yield from flight.time_offset.take_changes(match.t_ns)
        if accepted:
            flight.time_offset.agree()
        if self._monitors is not None:
            if result.images_agree:
                self._monitors.on_images_agree()
            yield from self._monitors.take_changes(match.t_ns)
        changed = accepted or was_multimodal or estimator.hypotheses.is_multimodal or result.verdict is Verdict.LOST
        if changed and estimator.last is not None:
            own = match.frame_id == estimator.last.frame_id  # a match of an older frame does not see this one's motion
            self._tracked = self._tracked or (own and accepted)
            yield self._estimate(estimator, estimator.last, self._claim(estimator.last), match.t_ns)
        if result.fixed is not None:
            yield map_anchor(estimator, match, result.fixed)

    def _on_source_ended(self, ended: SourceEnded) -> Iterable[Message]:
        if self._estimator is None or self._axes is None:
            return ()
        return refinement_of(self._estimator, self._axes, ended)


def make_node(ctx: NodeContext) -> EstimatorNode:
    return EstimatorNode(ctx.epoch_ns, load_checkpoint(ctx.checkpoint))


def make_edge(ctx: NodeContext) -> Edge:
    return EstimatorEdge(OpenCVGtsamPoseEstimator.__name__, ctx.checkpoint)
