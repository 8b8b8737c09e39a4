"""Estimator: odometry and map matches in; prediction, estimate and verdicts out."""

import math
from collections.abc import Iterable
from dataclasses import replace

import msgspec
import numpy as np

from terrafix.core.geodesy import LocalFrame, quat_from_rot
from terrafix.core.initial_position import begun
from terrafix.core.node import Edge, NodeContext
from terrafix.core.pose import tangent_to_world
from terrafix.estimator.estimator import Estimator
from terrafix.estimator.integrity.time_offset import TimeOffset
from terrafix.estimator.measurements.ahrs_correction import AhrsCorrectionMonitor
from terrafix.estimator.measurements.ekf_dead_reckoning import DeadReckoning
from terrafix.estimator.measurements.telemetry_buffer import Attitude, Telemetry
from terrafix.estimator.monitors.calibration_monitors import Monitors
from terrafix.estimator.prior import CheckpointWriter, EstimatorCheckpoint, NavPrior, load_checkpoint
from terrafix.estimator.propagation import FrameState, PropagationResult
from terrafix.messages import (
    Coasted,
    CovarianceMode,
    Health,
    Imu,
    MapMatch,
    MeasurementVerdict,
    Message,
    NavEstimate,
    Odometry,
    Origin,
    Prediction,
    RefinedPose,
    Refinement,
    SlowErrors,
    SourceEnded,
    SourceLabel,
    Start,
    ThermalBand,
    VehicleState,
    Verdict,
)

ANCHORED_FOR_S = 1.5  # after a map fix the odometry since then is too short to matter
SLOW_EVERY_NS = 1_000_000_000
WORDS_WAIT_NS = 1_000_000_000  # the autopilot's heartbeat comes once a second
BEFORE_WORDS = "older than the autopilot's first words after the restart"


class EstimatorNode:
    """``began_ns``: of the flight, when this process was started again in it: since then the vehicle has flown on.
    ``last``: what the process before it said last."""

    def __init__(self, began_ns: int | None = None, last: EstimatorCheckpoint | None = None) -> None:
        self._began_ns, self._resumed_from = began_ns, last
        self._origin: Origin | None = None  # as it was said
        self._start = None if last is None else last.start  # ... and what was said of the start since
        self._starts = False  # there, with the next frame ...
        self._started_with = 0  # ... which is this one
        self._estimator: Estimator | None = None
        self._frame: LocalFrame | None = None
        self._telemetry = Telemetry()
        self._righted = AhrsCorrectionMonitor(self._telemetry, None if last is None else last.estimate.t_ns)
        self._attitude: Attitude | None = None  # at the newest frame
        self._coasted: list[Coasted] = []  # before there was an Origin: the link may be there before vision is
        self._mode = CovarianceMode.MARGINALS
        self._tracked = True
        self._said_slow_ns = 0
        self._first_ns: int | None = None  # time of the first frame or telemetry
        self._waiting: list[Odometry] = []  # for the autopilot's words, to which belongs what was learnt
        self._time_offset = TimeOffset()
        self._stamp_ns: int | None = None  # of the newest frame, as the camera has it
        self._predicted: int | None = None  # frame of the newest Prediction ...
        self._from_m = np.zeros(2)  # ... and where it was, with its map match,
        self._from_m2 = np.zeros((2, 2))  # known to this covariance
        self._monitors: Monitors | None = None

    @property
    def origin(self) -> Origin | None:
        return None if self._estimator is None else self._estimator.origin

    @property
    def mode(self) -> CovarianceMode:
        """Of the next estimate."""
        return self._mode

    def on(self, message: Message) -> Iterable[Message]:
        match message:
            case Origin() if message != self._origin:  # said again after a restart
                self._origin, self._monitors = message, Monitors(message)
                self._frame = LocalFrame(message.lat_deg, message.lon_deg)
                self._time_offset, self._predicted = TimeOffset(), None  # of another camera, in other axes
                self._begin(begun(message, self._start), self._known(message, self._frame))
                waiting, self._coasted = self._coasted, []
                for said in waiting:
                    yield from self._on_coasted(said)
            case Start() if not self._on_map and (self._start is None or message.t_ns != self._start.t_ns):
                self._start, self._starts = message, True
            case VehicleState():
                self._first_ns = message.t_ns if self._first_ns is None else self._first_ns
                self._telemetry.add(message)
                yield from self._begun()
            case Imu():
                self._telemetry.add_imu(message)
            case Coasted() if self._resumed_from is not None:
                yield from self._on_coasted(message)
            case Health():
                cool = message.band is ThermalBand.NORMAL
                self._mode = CovarianceMode.MARGINALS if cool else CovarianceMode.JACOBIAN
            case Odometry():
                self._waiting.append(message)
                yield from self._begun()
            case MapMatch():
                yield from self._on_map_match(message)
            case SourceEnded():
                yield from self._refine(message)
            case _:
                pass

    def tick(self, now_ns: int) -> Iterable[Message]:
        return ()

    def _begin(self, origin: Origin, known: NavPrior | None) -> Estimator:
        """Anew."""
        self._estimator = Estimator(origin, known)
        return self._estimator

    @property
    def _on_map(self) -> bool:
        """The map has told the place: no start counts any more."""
        if self._estimator is not None and self._estimator.last_fix_s is not None:
            return True
        return self._resumed_from is not None and self._resumed_from.estimate.last_anchor_age_ms >= 0

    def _started(self, start: Start, frame_id: int, t_ns: int, *, stands: bool) -> Estimator:
        """With the first frame after a Start. A vehicle that still stands is where that says; another one was there."""
        assert self._origin is not None and self._frame is not None
        self._starts, self._predicted, self._started_with = False, None, frame_id
        known = NavPrior.told(start, self._frame, (t_ns if stands else start.t_ns) * 1e-9)
        return self._begin(begun(self._origin, start), known)

    def _known(self, origin: Origin, frame: LocalFrame) -> NavPrior | None:
        if self._began_ns is None:
            return None
        if self._resumed_from is not None:
            return NavPrior.of(self._resumed_from, frame, origin.camera)
        return NavPrior.start(origin, self._began_ns * 1e-9)

    def _begun(self) -> Iterable[Message]:
        """All frames that wait, when the first of them can be begun with. Vision may be there before the link is, after
        a restart; a graph that began without heading and height would have to begin anew, and the anchor look at all
        of both for seconds. So a picture that is older than the first words is left out where a newer one is not."""
        if not self._waiting:
            return
        begins = self._estimator is not None and self._estimator.last is None
        if begins and self._resumed_from is not None and self._resumed_from.slow is not None:
            said = [self._telemetry.at(odometry.t_ns) for odometry in self._waiting]
            known = [one.yaw_rad is not None and one.agl_m is not None for one in said]
            if any(known):
                older, self._waiting = self._waiting[: known.index(True)], self._waiting[known.index(True) :]
                yield from (_odometry_verdict(odometry, Verdict.STALE, BEFORE_WORDS) for odometry in older)
            elif self._waiting[-1].t_ns - self._waiting[0].t_ns < WORDS_WAIT_NS:
                return
        waiting, self._waiting = self._waiting, []
        for odometry in waiting:
            yield from self._on_odometry(odometry)

    def _on_odometry(self, odometry: Odometry) -> Iterable[Message]:
        estimator = self._estimator
        if estimator is None:
            return
        origin = estimator.origin
        stamp_ns = odometry.t_ns
        self._first_ns = stamp_ns if self._first_ns is None else self._first_ns
        before_ns, self._stamp_ns = stamp_ns if self._stamp_ns is None else self._stamp_ns, stamp_ns
        self._time_offset.step((stamp_ns - before_ns) * 1e-9)
        if self._time_offset.applied_s:
            t_ns = stamp_ns - round(self._time_offset.applied_s * 1e9)
            odometry = msgspec.structs.replace(odometry, t_ns=t_ns)
        sigmas_rad = math.radians(origin.attitude_sigma_deg), math.radians(origin.yaw_sigma_deg)
        attitude = self._attitude = self._righted.look(odometry.t_ns, *sigmas_rad)
        if self._starts and self._start is not None:
            estimator = self._started(self._start, odometry.frame_id, odometry.t_ns, stands=attitude.stands)
        estimator.mode = self._mode
        before = estimator.last
        seen = before is not None and before.frame_id == self._predicted
        if before is not None and seen:
            self._from_m = np.array(before.pose.translation()[:2])
            self._from_m2 = tangent_to_world(before.cov, before.pose.rotation().matrix())[:2, :2]
        advance = estimator.advance(odometry.frame_id, odometry.t_ns * 1e-9, odometry, attitude, self._righted.felt)
        self._tracked = advance.verdict is Verdict.ACCEPTED
        if advance.turn is not None:
            self._time_offset.add(replace(advance.turn, t0_ns=before_ns, t1_ns=stamp_ns), self._telemetry)
        yield _odometry_verdict(odometry, advance.verdict)
        if advance.reset:
            yield MeasurementVerdict(
                t_ns=odometry.t_ns,
                frame_id=odometry.frame_id,
                measurement="reset",
                verdict=Verdict.ACCEPTED,
                detail=advance.reset,
            )
        for name, verdict in (("attitude", advance.heading), ("height", advance.height)):
            if verdict is not Verdict.ACCEPTED:
                t_ns, frame_id = odometry.t_ns, odometry.frame_id
                yield MeasurementVerdict(t_ns=t_ns, frame_id=frame_id, measurement=name, verdict=verdict)
        no_new_view = Verdict.STALLED in (odometry.verdict, advance.verdict) or odometry.verdict is Verdict.BAD_IMAGE
        if not no_new_view and not self._awaits_telemetry(odometry.t_ns, attitude, estimator):
            yield self._prediction(odometry, advance, estimator, seen)
            self._predicted = odometry.frame_id
        yield from self._slow_errors(advance.placed, estimator)
        if self._monitors is not None:
            agl_m = float(advance.placed.pose.translation()[2]) - estimator.terrain.below(
                advance.placed.pose.translation()
            )
            self._monitors.odometry(odometry, self._telemetry, float(np.hypot(*advance.step_m)), agl_m)
            yield from self._monitors.changes(odometry.t_ns)
        estimate = self._estimate(advance.placed, odometry.t_ns)
        if estimator.last_fix_s is not None:  # before that the autopilot has, or had, another position
            self._righted.told(estimate.t_ns, estimate.velocity_sigma_mps)
        yield estimate

    def _awaits_telemetry(self, t_ns: int, attitude: Attitude, estimator: Estimator) -> bool:
        """Whether a frame at ``t_ns`` comes so early that heading and height may yet be reported: the anchor would look
        at all of both for seconds, while vision and the link have only begun."""
        if self._first_ns is None or self._resumed_from is not None or estimator.last_fix_s is not None:
            return False
        unknown = attitude.yaw_rad is None or attitude.agl_m is None
        return unknown and 0 <= t_ns - self._first_ns < WORDS_WAIT_NS

    def _slow_errors(self, placed: FrameState, estimator: Estimator) -> Iterable[SlowErrors]:
        """Not before a map fix: until then they are what was assumed. Not for a computer that is hot."""
        t_ns = round(placed.t_s * 1e9)
        hot = self._mode is CovarianceMode.JACOBIAN
        if hot or estimator.last_fix_s is None or t_ns - self._said_slow_ns < SLOW_EVERY_NS:
            return
        self._said_slow_ns = t_ns
        error = estimator.graph.state(placed.node).bias
        cov = estimator.graph.bias_covariance(placed.node)
        tilt_x, tilt_y, heading, height, lens, scale = (float(e) for e in error)
        yield SlowErrors(
            t_ns=t_ns,
            frame_id=placed.frame_id,
            error=(tilt_x, tilt_y, heading, height, lens, scale),
            cov=tuple(float(c) for c in cov.ravel()),
            lens=estimator.middle.learnt,
        )

    def _on_coasted(self, said: Coasted) -> Iterable[Message]:
        estimator, frame = self._estimator, self._frame
        if estimator is None or frame is None:
            self._coasted.append(said)
            return
        if estimator.last_fix_s is not None:
            return
        if (
            estimator.coasted(DeadReckoning.of(said, frame), self._attitude, self._righted.felt)
            and estimator.last is not None
        ):
            yield self._estimate(estimator.last, said.t_ns)

    def _on_map_match(self, match: MapMatch) -> Iterable[Message]:
        estimator = self._estimator
        if estimator is None:
            return
        if match.frame_id < self._started_with:  # of ground, and of doubt, elsewhere
            yield MeasurementVerdict(t_ns=match.t_ns, frame_id=match.frame_id, measurement="map", verdict=Verdict.STALE)
            return
        estimator.mode = self._mode
        were_several = estimator.hypotheses.are_several
        result = estimator.fix(match)
        yield MeasurementVerdict(
            t_ns=match.t_ns,
            frame_id=match.frame_id,
            measurement="map",
            verdict=result.verdict,
            detail=result.detail,
            mahalanobis2=result.mahalanobis2,
        )
        if result.start_off:
            yield MeasurementVerdict(
                t_ns=match.t_ns,
                frame_id=match.frame_id,
                measurement="start",
                verdict=Verdict.INNOVATION,
                detail=result.start_off,
            )
        if self._monitors is not None:
            self._monitors.matched(match, self._telemetry, accepted=result.verdict is Verdict.ACCEPTED)
            yield from self._monitors.changes(match.t_ns)
        several = were_several or estimator.hypotheses.are_several
        if (several or result.verdict in (Verdict.ACCEPTED, Verdict.LOST)) and estimator.last is not None:
            own = match.frame_id == estimator.last.frame_id  # an older frame's match does not see this one's motion
            self._tracked = self._tracked or (own and result.verdict is Verdict.ACCEPTED)
            yield self._estimate(estimator.last, match.t_ns)

    def _prediction(
        self, odometry: Odometry, advance: PropagationResult, estimator: Estimator, seen: bool
    ) -> Prediction:
        """``seen``: the frame before had a Prediction, too. After some that had none, what is known by now of the way
        since the last one counts: odometry that begins again tells of the velocity in between. So does what the
        covariance has grown by."""
        placed = advance.placed
        r_w_c = placed.pose.rotation().matrix()
        p = placed.pose.translation()
        cov = tangent_to_world(placed.cov, r_w_c)
        step, step_var = advance.step_m, advance.step_sigma_m**2
        if not seen and self._predicted is not None:
            step = np.asarray(p[:2]) - self._from_m
            step_var += max(float(np.linalg.eigvalsh(cov[:2, :2] - self._from_m2)[-1]), 0.0)
        return Prediction(
            t_ns=odometry.t_ns,
            frame_id=odometry.frame_id,
            p_c_in_w_m=(float(p[0]), float(p[1]), float(p[2])),
            q_w_c=quat_from_rot(r_w_c),
            cov=tuple(float(v) for v in cov.ravel()),
            agl_m=float(p[2]) - estimator.terrain.below(p),
            agl_sigma_m=float(np.sqrt(cov[2, 2])),
            step_m=(float(step[0]), float(step[1])),
            step_cov_m2=(step_var, 0.0, 0.0, step_var),
            lens=estimator.lens(placed.node),
            start_ns=max(0 if self._start is None else self._start.t_ns, round(estimator.led_s * 1e9)),
        )

    def _estimate(self, placed: FrameState, t_ns: int) -> NavEstimate:
        estimator, frame = self._estimator, self._frame
        assert estimator is not None and frame is not None
        p = placed.pose.translation()
        cov = tangent_to_world(placed.cov, placed.pose.rotation().matrix())
        # The map itself is off by a few metres, everywhere alike: no number of fixes averages that away.
        cov[:3, :3] += estimator.map_sigma_m**2 * np.eye(3)
        aside_m, aside_cov = estimator.middle.aside(estimator.lever(placed.pose))
        cov[:2, :2] += aside_cov
        cov[3:5, 3:5] += estimator.camera.body_sigma_rad**2 * np.eye(2)
        v = placed.velocity_mps
        cov[:3, :3] += self._time_offset.sigma_s**2 * np.outer(v, v)
        other_m, cov = estimator.hypotheses.claim(cov)
        if self._monitors is not None:
            cov[:2, :2] += self._monitors.sigma_m**2 * np.eye(2)
        alt_amsl_m, more_m = estimator.amsl(placed)
        stretch, _ = estimator.stretch(placed.node)
        cov[2, 2] += more_m**2
        lat_deg, lon_deg = frame.to_wgs84(*(p[:2] + aside_m + other_m).tolist())
        age_ms = -1
        if estimator.last_fix_s is not None:
            age_ms = max(0, round((placed.t_s - estimator.last_fix_s) * 1e3))
        label = SourceLabel.VISUAL_PROPAGATED if self._tracked else SourceLabel.DEAD_RECKONED
        if self._tracked and 0 <= age_ms <= ANCHORED_FOR_S * 1e3:
            label = SourceLabel.SATELLITE_ANCHORED
        return NavEstimate(
            t_ns=round(placed.t_s * 1e9),
            frame_id=placed.frame_id,
            lat_deg=lat_deg,
            lon_deg=lon_deg,
            alt_amsl_m=alt_amsl_m,
            agl_m=stretch * (float(p[2]) - estimator.terrain.below(p)),
            velocity_enu_mps=(float(v[0]), float(v[1]), stretch * float(v[2])),
            velocity_sigma_mps=float(np.sqrt(np.linalg.eigvalsh(placed.velocity_cov)[-1])),  # of the worst direction
            q_w_b=quat_from_rot(estimator.body(placed)),
            cov=tuple(float(c) for c in cov.ravel()),
            map_sigma_m=estimator.map_sigma_m,
            source_label=label,
            covariance_mode=self._mode,
            last_anchor_age_ms=age_ms,
            emitted_at_ns=max(t_ns, round(placed.t_s * 1e9)),  # the live shell puts the time of saying here
        )

    def _refine(self, ended: SourceEnded) -> Iterable[Message]:
        if self._estimator is None or self._frame is None:
            return
        poses = []
        map_var = self._estimator.map_sigma_m**2
        for frame_id, (p, cov) in sorted(self._estimator.refine().items()):
            lat_deg, lon_deg = self._frame.to_wgs84(float(p[0]), float(p[1]))
            poses.append(
                RefinedPose(
                    frame_id=frame_id,
                    lat_deg=lat_deg,
                    lon_deg=lon_deg,
                    alt_amsl_m=float(p[2]),
                    sigma_e_m=float(np.sqrt(cov[0, 0] + map_var)),
                    sigma_n_m=float(np.sqrt(cov[1, 1] + map_var)),
                )
            )
        yield Refinement(t_ns=ended.t_ns, poses=poses)


def _odometry_verdict(odometry: Odometry, verdict: Verdict, detail: str = "") -> MeasurementVerdict:
    t_ns, frame_id = odometry.t_ns, odometry.frame_id
    return MeasurementVerdict(t_ns=t_ns, frame_id=frame_id, measurement="odometry", verdict=verdict, detail=detail)


def make_node(ctx: NodeContext) -> EstimatorNode:
    return EstimatorNode(ctx.epoch_ns, load_checkpoint(ctx.checkpoint))


def make_edge(ctx: NodeContext) -> Edge | None:
    return None if ctx.checkpoint is None else CheckpointWriter(ctx.checkpoint)
