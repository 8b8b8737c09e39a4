"""From frame to frame: odometry, inertial readings, attitude and height become nodes and factors of the graph."""

import math
from array import array
from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from terrafix.core.geodesy import yaw_of
from terrafix.core.limits import LEAST_LOOK_AGL_M
from terrafix.core.pose import tangent_to_world, world_to_tangent
from terrafix.estimator.factors.custom_factors import BAROMETER_SCALE, BIAS_SIZE, HEIGHT, LENS, SCALE
from terrafix.estimator.factors.three_view import ThreeViewConstraint, ThreeViewPose, three_view_constraint
from terrafix.estimator.graph.pose_graph import WALK_SIGMAS, NodeState, PoseGraph, walk_sigmas
from terrafix.estimator.initialization import Initializer, Slow, TakeOff
from terrafix.estimator.integrity.fragments import Fragment, Fragments, MotionEvidence
from terrafix.estimator.integrity.innovation_gate import InnovationGate
from terrafix.estimator.integrity.motion_gate import MotionInnovation
from terrafix.estimator.integrity.static_picture import StaticPicture
from terrafix.estimator.integrity.time_offset import Turn
from terrafix.estimator.integrity.yaw_gauge import YawGauge
from terrafix.estimator.keyframe_substitution import KeyframeSubstitution
from terrafix.estimator.measurements.airspeed import AirspeedObservation, WindEstimator
from terrafix.estimator.measurements.attitude_height import (
    DEFAULT_AGL_M,
    DEFAULT_AGL_SIGMA_M,
    UNKNOWN_ATTITUDE_RAD,
    UNKNOWN_RAD,
    MountedCamera,
)
from terrafix.estimator.measurements.ekf_dead_reckoning import DeadReckoning, DeadReckoningBuffer
from terrafix.estimator.measurements.principal_point import PrincipalPointFilter
from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.models.lens_prior import lens_sigma
from terrafix.estimator.models.motion_model import (
    STANDING_M,
    V_SIZE,
    MotionIncrement,
    WorldAcceleration,
    believed,
    integrate_motion,
    spread_after,
    standing_cov,
    unknown_cov,
    with_velocity,
)
from terrafix.estimator.models.plane_motion import Ground, RelativePose, relative_pose
from terrafix.estimator.models.speed_prior import SpeedPrior
from terrafix.estimator.models.terrain import RELIEF_REPEATS, Terrain
from terrafix.estimator.prior import NavPrior
from terrafix.messages import Camera, CovarianceMode, Odometry, Origin, Verdict

# What an autopilot's own sigma leaves out: a compass beside motors and wires, a barometer over ground that is higher or
# lower than at take-off. On real flights the heading was 12 degrees and the height 8 % away from the log, and a compass
# that is 15 degrees off must still be inside the search (1.5 sigma).
COMPASS_BIAS_RAD = np.radians(10.0)
COMPASS_SWING_RAD = np.radians(5.0)  # 1-sigma, by which that changes with the heading
HEIGHT_BIAS = 0.05  # of the height
TAKE_OFF_AWAY = 5.0  # heights: from where it took off to where it is first seen in the air, a climb at 20 %
MAX_SPEED_MPS = 80.0  # faster than any drone that this is made for
# Of the ground below, a share of the height above it: one that is lost over hills cannot tell a way from none. A graph
# whose noise is a share of the way that it believes in would come to believe in none.
MAX_LEVEL_SIGMA = 0.5
STEP_SHARE = 0.04  # of a step: what odometry over real ground gets wrong, for the anchor's belief
STEP_FLOOR_M = 0.5

LOW_RATIO = 1.5  # of LEAST_LOOK_AGL_M: a reported height above this would be looked from
HEADING_GATE = 3.0  # sigmas, by which pictures of a new fragment may have turned otherwise than the heading
MOTION_TIMEOUT_S = 5.0  # as EKF2_NOAID_TOUT of PX4, for one who would be led by inertial sensors alone
LENS_SURE = 3.0  # sigmas, from which what the lens bends is taken out of the pictures: none is straight to a last digit

ImuQuery = Callable[[int, int], WorldAcceleration | None]


def no_imu(_t0_ns: int, _t1_ns: int) -> None:
    """There are no inertial readings."""


@dataclass(frozen=True)
class FrameState:
    """The camera at a frame: pose, covariance (6x6, tangent order), velocity with covariance (3x3), and its node."""

    frame_id: int
    t_s: float
    pose: gtsam.Pose3
    cov: np.ndarray
    velocity_mps: np.ndarray
    velocity_cov: np.ndarray
    node: int


@dataclass(frozen=True)
class Sighting:
    """What odometry says of a frame. ``motion``: node of the keyframe and the motion since, None without one.
    ``fused``: the same, if it enters the graph. ``fragment``: to which the frame belongs."""

    verdict: Verdict
    motion: tuple[int, RelativePose] | None
    fragment: Fragment
    local_step_m: np.ndarray | None = None  # (2,) since the frame before, of a fragment that was not joined by then

    @property
    def fused(self) -> tuple[int, RelativePose] | None:
        return self.motion if self.verdict is Verdict.ACCEPTED else None


@dataclass(frozen=True)
class PropagationResult:
    verdict: Verdict
    placed: FrameState
    step_m: np.ndarray  # (2,) east, north since the frame before, by odometry alone
    step_sigma_m: float
    heading: Verdict = Verdict.ACCEPTED  # what became of what was told, if it was
    height: Verdict = Verdict.ACCEPTED
    turn: Turn | None = None  # since the frame before, by pictures
    reset: str = ""  # why the graph began anew with this frame; empty: it did not


class Propagation:
    """``last_fix_s``: time of the newest frame that was fixed on the map; None: none was. ``led_s``: of the frame that
    was led to its place by how the autopilot moved while nobody saw the flight; 0: none was.

    ``known``: where the flight was known last, if that is not its start now: this process was started in flight."""

    def __init__(self, origin: Origin, known: NavPrior | None = None) -> None:
        self.origin = origin
        self.graph = PoseGraph()
        self.camera = MountedCamera(origin)
        self.terrain = Terrain(origin.ground_amsl_m or 0.0)
        self.mode = CovarianceMode.MARGINALS
        self.last_fix_s: float | None = None
        self.led_s = 0.0
        self._node_of: dict[int, int] = {}  # frame -> node, of those in the graph's window
        self._frames = array("q")  # of each node
        self._levers = array("f")  # ... (2, 2), of the middle of its picture
        self._cov_of: dict[int, np.ndarray] = {}  # node -> newest covariance of C, for the cheap mode
        self._velocity_cov = np.zeros((V_SIZE, V_SIZE))  # of V of the newest node
        self.middle = PrincipalPointFilter(origin.camera, None if known is None else known.lens)
        self._lens_sigma = lens_sigma(origin.camera)  # of what is learnt of the lens
        self._pace = SpeedPrior()
        self._wind = WindEstimator()
        self._seen_s = 0.0  # time of the newest frame whose motion, or place, was seen
        # Node of the keyframe that odometry saw the newest frame from, and where that was in its camera (3,).
        self._seen_from: tuple[int, np.ndarray] | None = None
        self._felt: bool | None = None  # whether the last leg was measured; None: there was none
        self._stood_at: int | None = None  # node at which a vehicle stands, motors off
        self._take_off = TakeOff()
        self._last: FrameState | None = None  # newest frame
        self._beginning = Initializer(origin, known)
        self._open: YawGauge | None = None  # None: the heading is known
        self._coasts = DeadReckoningBuffer()
        self._newest_odometry: Odometry | None = None  # as vision has it
        self._substitution: KeyframeSubstitution | None = None  # for the keyframe that the graph began without
        self._heights, self._headings = InnovationGate(), InnovationGate()
        self._fragments = Fragments()
        self._fragment = Fragment(0.0, joined=True)  # of the newest frame
        self._static_picture = StaticPicture()
        self._heading_seen: tuple[int, int, float] | None = None  # time, keyframe, heading since it: the newest frame
        self._motion_refused_s: float | None = None  # time of the first of the motions in a row that were impossible

    @property
    def last(self) -> FrameState | None:
        """The newest frame, with all that is known of it by now."""
        return self._last

    def body(self, placed: FrameState) -> np.ndarray:
        """R_w_b (3x3) of a placed frame, with the mount as it was learnt."""
        return self.camera.body(placed.pose.rotation().matrix(), self.graph.state(placed.node).bias)

    @property
    def measures_height(self) -> bool:
        """The autopilot says how high it flies."""
        return self._beginning.has_height

    def lens(self, node: int) -> float:
        """What the lens is known to bend beyond its description; 0 while that may be nothing."""
        bend = float(self.graph.state(node).bias[LENS])
        return bend if abs(bend) > LENS_SURE * self._lens_sigma else 0.0

    @property
    def lens_learnt(self) -> tuple[float, float]:
        """What the lens bends beyond its description, and the 1-sigma of that, by now."""
        return float(self.graph.state(self.graph.newest).bias[LENS]), self._lens_sigma

    def stretch(self, node: int) -> tuple[float, float]:
        """Heights over heights as they are seen, and the 1-sigma of that (relative): of what the barometer tells
        otherwise, the part that is the focal length's."""
        focal = self.origin.camera.focal_sigma
        if not self.measures_height:
            return 1.0, focal
        both = scale_sigma(self.origin.camera)
        part = (focal / both) ** 2 * float(self.graph.state(node).bias[SCALE])
        return float(np.exp(part)), focal * BAROMETER_SCALE / both

    def lever(self, pose: gtsam.Pose3) -> np.ndarray:
        """(2, 2) of which times the middle of the picture is how far aside the graph has a camera."""
        p = pose.translation()
        return np.asarray((float(p[2]) - self.terrain.below(p)) * pose.rotation().matrix()[:2, :2])

    def amsl(self, placed: FrameState) -> tuple[float, float]:
        """Of the camera, and the 1-sigma of it beyond what the graph claims. Without a DEM the graph has the height
        above whatever ground it sees, and the barometer how high that lies."""
        p = placed.pose.translation()
        stretch, sigma = self.stretch(placed.node)
        if self.terrain.is_told or not self.measures_height:
            ground_m = self.terrain.below(p)
            seen_m = float(p[2]) - ground_m
            return ground_m + stretch * seen_m, sigma * seen_m
        seen_m = self.graph.state(placed.node).up_by_barometer_m - self.terrain.ground_m
        drift_m = WALK_SIGMAS[HEIGHT] * np.sqrt(placed.t_s - self._beginning.t_s)
        return self.terrain.ground_m + stretch * seen_m, float(
            np.linalg.norm([self.origin.agl_sigma_m, drift_m, sigma * seen_m])
        )

    def advance(
        self, frame_id: int, t_s: float, odometry: Odometry, attitude: Attitude, felt: ImuQuery = no_imu
    ) -> PropagationResult:
        """``felt(t0_ns, t1_ns)``: acceleration between two times, where the inertial readings cover them."""
        self._newest_odometry = odometry
        if self._substitution is not None:
            odometry = self._substitution.applied(odometry)
        if self._last is None or (self.last_fix_s is None and self._beginning.is_told_more(attitude)):
            # No linear graph recovers from a heading that turns out to be 70 degrees off what was assumed.
            return self._begin(frame_id, t_s, attitude, felt)
        newest = self.graph.newest
        before, dt_s = self.graph.state(newest), max(t_s - self.graph.time_of(newest), 1e-3)
        sighting = self._sighting(odometry, t_s, before, attitude, felt)
        turn = self._turn(odometry, sighting)
        verdict, known = sighting.verdict, sighting.fused
        heading = Verdict.ACCEPTED
        if known is not None and self._cannot_head_so(attitude, known, before):
            if self._headings.begins and self.last_fix_s is None:
                return self._begin(frame_id, t_s, attitude, felt)
            attitude, heading = replace(attitude, yaw_rad=None), Verdict.IMPLAUSIBLE
        if attitude.stands:
            self._take_off.stood()
        way = None if attitude.stands else self._leg(t_s, before, attitude, felt, seen=known is not None)
        spread = spread_after(way, self._velocity_cov)
        led_to, velocity = before.pose.translation(), np.zeros(V_SIZE)
        if way is not None:
            led_to, velocity = way.predicted(led_to, before.velocity, float(before.bias[2]))
        if self._is_motion_timed_out(sighting, t_s) and way is not None:
            spread[3:, 3:] = unknown_cov()
            spread[:3, :3] += unknown_cov()[:3, :3] * dt_s**2
            advance = self._begin_again(frame_id, t_s, attitude, led_to, velocity, spread, verdict)
            return replace(advance, reset=f"odometry contradicts velocity for {MOTION_TIMEOUT_S:.0f} s")
        above_m = None if known is None else float(led_to[2]) - self.terrain.ground_m
        if self._take_off.was_blind(way, above_m):
            # Told of the speed at both ends, a graph would make up the way between them and be too sure of it: it
            # begins again, where and as sure as it is.
            cov = tangent_to_world(self._covariance(newest), before.pose.rotation().matrix())
            sigma_m = float(np.sqrt(np.linalg.eigvalsh(cov[:2, :2] + spread[:2, :2])[-1]))
            placed = self._start_graph(frame_id, t_s, attitude, led_to[:2], sigma_m)
            return PropagationResult(Verdict.ACCEPTED, placed, (led_to - before.pose.translation())[:2], sigma_m)
        unseen = known is None and way is not None and attitude.yaw_rad is None
        told = self._open is not None and attitude.yaw_rad is not None
        if told or (unseen and (self._open is None or not self._open.dark)):
            return self._begin_again(frame_id, t_s, attitude, led_to, velocity, spread, verdict)
        if unseen and self._open is not None:  # all of a dark stretch is one turn
            self._open = self._open.after_unseen(dt_s)
        elif known is not None and self._open is not None:
            self._open.dark = False
        parent, motion = known or self._by_guess(attitude, way is None, led_to, spread)
        pose = self.graph.state(parent).pose.compose(gtsam.Pose3(gtsam.Rot3.ClosestTo(motion.r), motion.p_m))
        r_w_c, p = pose.rotation().matrix(), np.asarray(pose.translation())
        step = (p - before.pose.translation())[:2]
        step_sigma = STANDING_M if way is None else float(np.sqrt(np.linalg.eigvalsh(spread[:2, :2])[-1]))
        if known is not None:
            seen = r_w_c @ motion.cov[3:, 3:] @ r_w_c.T
            # Of the step over the ground: where no map tells how that rises, the height is known far less well.
            aside_m2 = float(np.linalg.eigvalsh(seen[:2, :2])[-1])
            same_keyframe = self._seen_from is not None and self._seen_from[0] == parent
            if self._seen_from is not None and same_keyframe:
                # Both by odometry: against the estimate of the frame before, an error of the leg from the keyframe
                # would be in the step of every frame of it, and add up in the belief that follows these steps.
                step = (p - self.graph.state(parent).pose.transformFrom(self._seen_from[1]))[:2]
            if same_keyframe and motion.seen is not None:
                # A wrong height stretches all of the way since the keyframe alike; the frame before had its part of it.
                way_m2 = float(np.sum((p - self.graph.state(parent).pose.translation())[:2] ** 2))
                stretch2 = motion.seen.ground.stretch_sigma**2
                aside_m2 = max(aside_m2 - way_m2 * stretch2, 0.0) + float(step @ step) * stretch2
            step_sigma = float(np.hypot(STEP_FLOOR_M + STEP_SHARE * np.hypot(*step), np.sqrt(aside_m2)))
            if way is not None:
                way, spread, gained = believed(way, p - led_to, spread, seen)
                velocity = velocity + gained  # or a leg that is right would seem to be in its tail (custom_factors.py)
        step, step_sigma = self._pictured_step(sighting, p, step, step_sigma)
        height = Verdict.ACCEPTED
        if self._cannot_be_so_high(attitude, p, before, float(spread[2, 2])):
            if self._heights.begins and self.last_fix_s is None:
                return self._begin(frame_id, t_s, attitude, felt)
            attitude, height = replace(attitude, agl_m=None), Verdict.IMPLAUSIBLE
        if self._is_too_low_to_be_looked_at(attitude, p):
            cov = tangent_to_world(self._last.cov, before.pose.rotation().matrix()) + _padded(spread[:3, :3])
            sigma_m = float(np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]))
            placed = self._start_graph(frame_id, t_s, attitude, p[:2], sigma_m)
            seen_m, reported_m = float(p[2]) - self.terrain.below(p), self._reported_agl_m(attitude, p)
            why = f"height {seen_m:.0f} m, where {reported_m:.0f} m are reported"
            return PropagationResult(verdict, placed, step, step_sigma, heading, height, turn, reset=why)
        if self.mode is CovarianceMode.JACOBIAN:
            self._cov_of[self.graph.next_node] = _compose_cov(self._cov_of[parent], motion)
        state = NodeState(pose, before.bias, velocity)
        said = self.camera.factor(self.graph.next_keys(), attitude, r_w_c, self.terrain.below(p), dt_s)
        rise_m = self.terrain.rise_sigma_m(float(np.hypot(*step)))
        if way is not None:
            way = replace(way, lifted=not self.terrain.is_told)
            if known is not None:
                ground_m = self.terrain.below(p)
                way = way.above(max(float(p[2]) - ground_m, 1.0), ground_m)
        three = None if known is None else self._three(odometry, parent, motion)
        node = self.graph.extend(t_s, state, parent, motion, way, said, rise_m, three)
        self._felt = None if way is None else way.inertial
        if not attitude.stands:
            self._stood_at = None
        elif self._stood_at is None:
            self._stood_at = node
        self._is_frame(node, frame_id, sighting.fragment)
        self._seen_from = None if known is None else (parent, motion.p_m)
        self._cov_of = {n: cov for n, cov in self._cov_of.items() if self.graph.holds(n)}
        self._velocity_cov = spread[3:, 3:]
        self._be_led(node, t_s, attitude, felt)
        if known is None and way is not None and self._be_blown(node, t_s, dt_s, attitude):
            step = (self.graph.state(node).pose.translation() - before.pose.translation())[:2]
            spread = with_velocity(spread, self._velocity_cov)
            step_sigma = float(np.sqrt(np.linalg.eigvalsh(spread[:2, :2])[-1]))
        self._last = self._placed(frame_id, t_s, node)
        if known is not None:
            self._seen_s = t_s
            self._pace.seen(t_s, self._last.velocity_mps, self._last.velocity_cov)
            self._learn_wind(self._last, attitude)
        return PropagationResult(verdict, self._last, step, step_sigma, heading, height, turn)

    def _sighting(
        self, odometry: Odometry, t_s: float, before: NodeState, attitude: Attitude, felt: ImuQuery
    ) -> Sighting:
        """``before``: the newest node."""
        if odometry.verdict in (Verdict.BAD_IMAGE, Verdict.STALLED):  # no new view, so nothing that could have changed
            return Sighting(odometry.verdict, None, Fragment(t_s))
        answer = self._by_odometry(odometry, attitude)
        if isinstance(answer, Verdict):
            frozen = self._static_picture.is_frozen(t_s, attitude, static=odometry.static, moves=False)
            return Sighting(Verdict.STALLED if frozen else answer, None, Fragment(t_s))
        parent, motion = answer
        fragment, keyframe = self._fragments.of(parent), self.graph.state(parent).pose
        moved_m = keyframe.rotation().matrix() @ motion.p_m
        in_fragment_m = self._fragments.at_m(parent) + moved_m[:2]
        local_step_m = None if fragment.joined else in_fragment_m - fragment.moved_m
        if attitude.stands or self._open is not None:  # nothing predicts the motion
            if self._static_picture.is_frozen(t_s, attitude, static=odometry.static, moves=False):
                return Sighting(Verdict.STALLED, None, Fragment(t_s))
            fragment.joined = True
        else:
            p_m = keyframe.translation() + moved_m
            innovation = self._motion_innovation(t_s, p_m, parent, motion, before, attitude, felt)
            frozen = self._static_picture.is_frozen(
                t_s, attitude, static=odometry.static, moves=not innovation.may_stand
            )
            if frozen or not innovation.is_possible:
                return Sighting(Verdict.STALLED if frozen else Verdict.IMPLAUSIBLE, None, Fragment(t_s))
            if not fragment.joined:
                over_s = max(t_s - self.graph.time_of(parent), 1e-3)
                yaw_off_rad, yaw_sigma_rad = self._heading_innovation(attitude, answer, before)
                turns_agree = abs(yaw_off_rad) <= HEADING_GATE * yaw_sigma_rad
                off_m, cov_m2 = innovation.off_m[:2], innovation.cov_m2[:2, :2]
                fragment.weigh(t_s, MotionEvidence(off_m, cov_m2, over_s, turns_agree))
        verdict = Verdict.ACCEPTED if fragment.joined else Verdict.UNCONFIRMED
        fragment.moved_m = in_fragment_m
        return Sighting(verdict, answer, fragment, local_step_m)

    def _turn(self, odometry: Odometry, sighting: Sighting) -> Turn | None:
        """Since the frame before, when both were seen from one keyframe, or that frame is the keyframe."""
        before, self._heading_seen = self._heading_seen, None
        if sighting.motion is None:
            return None
        parent, motion = sighting.motion
        state = self.graph.state(parent)
        r_w_kf = state.pose.rotation().matrix()
        yaw_kf_rad, yaw_rad = (yaw_of(self.camera.body(r_w_c, state.bias)) for r_w_c in (r_w_kf, r_w_kf @ motion.r))
        since_rad = yaw_rad - yaw_kf_rad
        self._heading_seen = (odometry.t_ns, odometry.keyframe_id, since_rad)
        if before is not None and before[1] == odometry.keyframe_id:
            return Turn(before[0], odometry.t_ns, math.remainder(since_rad - before[2], math.tau))
        if before is not None and parent == self.graph.newest:
            return Turn(before[0], odometry.t_ns, math.remainder(since_rad, math.tau))
        return None

    def _motion_innovation(
        self,
        t_s: float,
        p_m: np.ndarray,
        parent: int,
        motion: RelativePose,
        before: NodeState,
        attitude: Attitude,
        felt: ImuQuery,
    ) -> MotionInnovation:
        """Of a camera at ``p_m`` (3,) by its ``motion`` since the node ``parent``; ``before``: the newest node."""
        way = self._leg(t_s, before, attitude, felt, seen=True)
        led_to, _ = way.predicted(before.pose.translation(), before.velocity, float(before.bias[2]))
        dt_s = max(t_s - self.graph.time_of(self.graph.newest), 1e-3)
        cov_m2 = spread_after(way, self._velocity_cov)[:3, :3]
        if not self._fragments.of(parent).joined:  # velocity led here all the way from the keyframe
            since_s = t_s - self.graph.time_of(parent)
            cov_m2 += self._velocity_cov[:3, :3] * max(since_s**2 - dt_s**2, 0.0)
        r_w_c = self.graph.state(parent).pose.rotation().matrix() @ motion.r
        seen_m2 = r_w_c @ motion.cov[3:, 3:] @ r_w_c.T
        return MotionInnovation(p_m - led_to, cov_m2 + seen_m2, dt_s, way.inertial)

    def _is_motion_timed_out(self, sighting: Sighting, t_s: float) -> bool:
        """Whether impossible motions have gone on for so long that velocity may be what is wrong."""
        if sighting.verdict is not Verdict.IMPLAUSIBLE:
            self._motion_refused_s = None
            return False
        self._motion_refused_s = t_s if self._motion_refused_s is None else self._motion_refused_s
        if t_s - self._motion_refused_s < MOTION_TIMEOUT_S:
            return False
        self._motion_refused_s = None  # velocity is unknown from here on: the next one has its own time
        return True

    def _pictured_step(
        self, sighting: Sighting, p_m: np.ndarray, step_m: np.ndarray, sigma_m: float
    ) -> tuple[np.ndarray, float]:
        """The step (2,) and its 1-sigma for the anchor's belief, which goes where pictures go, whosever they are.
        ``step_m`` (2,), ``sigma_m``: of the estimate, to ``p_m``."""
        last = self._fragment
        if sighting.fragment is last and sighting.local_step_m is not None:
            length_m = float(np.hypot(*sighting.local_step_m))
            return sighting.local_step_m, STEP_FLOOR_M + STEP_SHARE * length_m
        if sighting.fragment is last or last.joined or self._last is None:
            return step_m, sigma_m
        # A fragment ends that nothing has joined: the belief returns to where it began, and goes on from there.
        cov = tangent_to_world(self._last.cov, self._last.pose.rotation().matrix())[:2, :2]
        grown_m2 = max(float(np.linalg.eigvalsh(cov - last.began_cov_m2)[-1]), 0.0)
        return p_m[:2] - last.began_m - last.moved_m, float(np.hypot(sigma_m, np.sqrt(grown_m2)))

    def _cannot_head_so(self, attitude: Attitude, seen: tuple[int, RelativePose], before: NodeState) -> bool:
        """What is told of the heading, with the turn that odometry saw; ``before``: the newest node."""
        if attitude.yaw_rad is None or attitude.stands or self._last is None or self._open is not None:
            return False
        return self._headings.refuses(*self._heading_innovation(attitude, seen, before), self.last_fix_s)

    def _heading_innovation(
        self, attitude: Attitude, seen: tuple[int, RelativePose], before: NodeState
    ) -> tuple[float, float]:
        """The reported heading less the one that odometry has turned to, and the 1-sigma of that [rad]; zero where none
        is reported. ``seen``: node of the keyframe and the motion since; ``before``: the newest node."""
        assert self._last is not None
        parent, motion = seen
        yaw_rad = self.camera.yaw_rad(self.graph.state(parent).pose.rotation().matrix() @ motion.r)
        cov = tangent_to_world(self._last.cov, before.pose.rotation().matrix())
        sigma_rad = float(np.sqrt(np.radians(self.origin.yaw_sigma_deg) ** 2 + COMPASS_SWING_RAD**2 + cov[5, 5]))
        if attitude.yaw_rad is None:
            return 0.0, sigma_rad
        told_rad = self.camera.yaw_rad(self.camera.expected(attitude, before.bias))
        return math.remainder(told_rad - yaw_rad, math.tau), sigma_rad

    def _cannot_be_so_high(self, attitude: Attitude, p_m: np.ndarray, before: NodeState, moved_m2: float) -> bool:
        """What is told of the height, with the camera predicted at ``p_m`` (3,); ``moved_m2``: variance of the way up
        since ``before``, the newest node."""
        if attitude.agl_m is None or attitude.stands or self._last is None:
            return False
        ground_m = self.terrain.below(p_m)
        expected_m = np.exp(before.bias[SCALE]) * (float(p_m[2] + before.bias[HEIGHT]) - ground_m)
        told_m = (self.origin.ground_amsl_m or 0.0) + attitude.agl_m - ground_m
        cov = tangent_to_world(self._last.cov, before.pose.rotation().matrix())
        sigma_m = float(np.sqrt(self.origin.agl_sigma_m**2 + cov[2, 2] + moved_m2))
        return self._heights.refuses(told_m - float(expected_m), sigma_m, self.last_fix_s)

    def _is_too_low_to_be_looked_at(self, attitude: Attitude, p_m: np.ndarray) -> bool:
        """Whether a height that has walked off keeps the anchor from looks that would correct it, while the reported
        one, above the ground that a map tells, would allow them. ``p_m`` (3,) of the camera."""
        if attitude.agl_m is None or attitude.stands or not self.terrain.is_told or self._open is not None:
            return False
        agl_m = float(p_m[2]) - self.terrain.below(p_m)
        return agl_m < LEAST_LOOK_AGL_M and self._reported_agl_m(attitude, p_m) > LOW_RATIO * LEAST_LOOK_AGL_M

    def _reported_agl_m(self, attitude: Attitude, p_m: np.ndarray) -> float:
        """Reported height above the ground below ``p_m`` (3,)."""
        assert attitude.agl_m is not None
        return (self.origin.ground_amsl_m or 0.0) + attitude.agl_m - self.terrain.below(p_m)

    def _leg(self, t_s: float, before: NodeState, attitude: Attitude, felt: ImuQuery, *, seen: bool) -> MotionIncrement:
        """From the newest node to now."""
        from_s = self.graph.time_of(self.graph.newest)
        measured = felt(round(from_s * 1e9), round(t_s * 1e9))
        r_w_c = before.pose.rotation().matrix()
        yaws = tuple(self.camera.yaw_rad(r) for r in (r_w_c, self.camera.expected(attitude, before.bias, r_w_c)))
        return integrate_motion(
            max(t_s - from_s, 1e-3),
            measured,
            (yaws[0], yaws[1]),
            float(before.bias[2]),
            self._pace.mps,
            float(np.hypot(np.radians(self.origin.attitude_sigma_deg), attitude.righted_rad)),
            same_kind=self._felt is (measured is not None),
            launching=self._take_off.launching,
            course_told=not seen and self._blown(t_s, before, attitude) is not None,
        )

    def coasted(self, coast: DeadReckoning, attitude: Attitude | None, felt: ImuQuery) -> bool:
        """How the autopilot moved while nobody saw the flight, and the attitude at the newest frame. -> whether that is
        led by it: a picture that was taken a moment before waits for no other."""
        self._coasts.add(coast)
        last = self._last
        if last is None or not self._be_led(last.node, last.t_s, attitude, felt):
            return False
        self._last = self._placed(last.frame_id, last.t_s, last.node)
        return True

    def _be_led(self, node: int, t_s: float, attitude: Attitude | None, felt: ImuQuery) -> bool:
        """By how the autopilot moved, to the newest node. -> whether it was."""
        coast = self._coasts.taken(t_s)
        if coast is None or attitude is None or attitude.yaw_rad is None or attitude.stands or self._open is not None:
            return False
        state, tilt_rad = self.graph.state(node), np.radians(self.origin.attitude_sigma_deg)
        tilts_rad = tilt_rad, float(np.hypot(tilt_rad, attitude.righted_rad))
        since = felt(*sorted((round(coast.t_s * 1e9), round(t_s * 1e9))))
        carried = coast.until(t_s, since, attitude.yaw_rad, float(state.bias[2]), tilts_rad)
        cov = tangent_to_world(self.graph.covariance(node), state.pose.rotation().matrix())
        if not carried.agrees_with(state.pose.translation()[:2], cov[:2, :2]):
            return False
        self.graph.add_motion(node, carried)
        self._cov_of.pop(node, None)
        self._velocity_cov = self.graph.velocity_covariance(node)
        self.led_s = t_s
        return True

    def _learn_wind(self, seen: FrameState, attitude: Attitude) -> None:
        if attitude.yaw_rad is None or attitude.stands or self._open is not None:
            return
        yaw_rad = attitude.yaw_rad - float(self.graph.state(seen.node).bias[2])
        self._wind.seen(seen.t_s, seen.velocity_mps, seen.velocity_cov, attitude.airspeed_mps, yaw_rad)

    def _blown(self, t_s: float, state: NodeState, attitude: Attitude) -> AirspeedObservation | None:
        if self._open is not None:
            return None
        return self._wind.tells(t_s, attitude.airspeed_mps, attitude.yaw_rad, float(state.velocity[2]))

    def _be_blown(self, node: int, t_s: float, dt_s: float, attitude: Attitude) -> bool:
        """The newest node, that nobody saw, by airspeed and wind. -> whether these told anything."""
        state = self.graph.state(node)
        air = self._blown(t_s, state, attitude)
        if air is None:
            return False
        if not air.agrees_with(state.velocity[:2], self.graph.velocity_covariance(node)[:2, :2], float(state.bias[2])):
            self._wind.doubt(t_s)
            return False
        self.graph.add_air(node, air, air.cov(dt_s, t_s - self._seen_s))
        self._cov_of.pop(node, None)
        self._velocity_cov = self.graph.velocity_covariance(node)
        return True

    def _begin(self, frame_id: int, t_s: float, attitude: Attitude, felt: ImuQuery) -> PropagationResult:
        begun = self._beginning.begun(t_s, attitude, self.terrain)
        self._heights.begun()
        self._headings.begun()
        placed = self._start_graph(frame_id, t_s, attitude, begun.at_m, begun.sigma_m, begun.slow)
        self._be_led(placed.node, t_s, attitude, felt)
        self._last = self._placed(frame_id, t_s, placed.node)
        return PropagationResult(Verdict.ACCEPTED, self._last, begun.way_m, begun.way_sigma_m)

    def _begin_again(
        self,
        frame_id: int,
        t_s: float,
        attitude: Attitude,
        led_to_m: np.ndarray,
        velocity: np.ndarray,
        spread: np.ndarray,
        verdict: Verdict,
    ) -> PropagationResult:
        """Where velocity leads, as sure as it is of that, with a heading that is told now, or that is open: a vehicle
        that nobody saw may have turned, and the graph would take its course for a witness of how far."""
        assert self._last is not None
        dt_s = t_s - self._last.t_s
        before, bias_cov = self.graph.state(self._last.node), self.graph.bias_covariance(self._last.node)
        r_before = before.pose.rotation().matrix()
        r_w_c = self.camera.expected(attitude, before.bias, r_before)
        step, level = (led_to_m - before.pose.translation())[:2], np.diag([1.0, 1.0, 0.0])
        cov = tangent_to_world(self._last.cov, r_before)
        cov[:3, :3] += spread[:3, :3]
        if self._open is not None:  # led along axes that were chosen
            cov[:3, :3] += self._open.share**2 * float(step @ step) * level
        cov[3:, 3:] += np.diag([UNKNOWN_ATTITUDE_RAD, UNKNOWN_ATTITUDE_RAD, UNKNOWN_RAD]) ** 2
        was = self._open or YawGauge(led_to_m[:2], 0.0)
        now = was.after_unseen(dt_s, led_to_m[:2])
        self._open = now if attitude.yaw_rad is None else None
        rise_m = self.terrain.rise_sigma_m(float(np.hypot(*step)))
        bias_cov += np.diag(walk_sigmas(dt_s, 0.0, rise_m) ** 2)
        self._velocity_cov = spread[3:, 3:].copy()
        self._velocity_cov[:3, :3] += now.share**2 * float(velocity[:2] @ velocity[:2]) * level
        state = NodeState(gtsam.Pose3(gtsam.Rot3.ClosestTo(r_w_c), led_to_m), before.bias, velocity)
        placed = self._new_graph(frame_id, t_s, attitude, state, cov, bias_cov, self.terrain.below(led_to_m))
        return PropagationResult(verdict, placed, step, float(np.sqrt(np.linalg.eigvalsh(spread[:2, :2])[-1])))

    def _start_graph(
        self,
        frame_id: int,
        t_s: float,
        attitude: Attitude,
        at_m: np.ndarray,
        sigma_m: float,
        slow: Slow | None = None,
    ) -> FrameState:
        """Anew at ``at_m`` (east, north), known to ``sigma_m``; all else as the autopilot says it, less ``slow``."""
        origin = self.origin
        tolerance = np.radians(origin.camera.mount_tolerance_deg)
        agl = DEFAULT_AGL_M if attitude.agl_m is None else attitude.agl_m
        agl_sigma = DEFAULT_AGL_SIGMA_M if attitude.agl_m is None else origin.agl_sigma_m
        yaw = float(np.hypot(np.radians(origin.yaw_sigma_deg), COMPASS_BIAS_RAD))
        # The ground, over that of the take-off; where the vehicle stands on it a barometer may say less than none.
        below_m = self.terrain.rise_sigma_m(TAKE_OFF_AWAY * max(agl, 0.0))
        height = float(np.linalg.norm([agl_sigma, HEIGHT_BIAS * agl, below_m]))
        assumed = (
            np.diag([tolerance, tolerance, yaw, height, lens_sigma(origin.camera), scale_sigma(origin.camera)]) ** 2
        )
        bias, bias_cov = (np.zeros(BIAS_SIZE), assumed) if slow is None else slow
        r_w_c = self.camera.expected(attitude, bias)
        up_m = self.terrain.ground_m + agl
        if origin.ground_amsl_m is not None and attitude.agl_m is not None:  # above the ground of the take-off
            up_m = origin.ground_amsl_m + attitude.agl_m
        if slow is not None:  # seen heights, from the one that is told above the barometer's zero
            told_m = (origin.ground_amsl_m or 0.0) + agl - self.terrain.ground_m
            up_m = self.terrain.ground_m + told_m * float(np.exp(-bias[SCALE])) - float(bias[HEIGHT])
        pose = gtsam.Pose3(gtsam.Rot3.ClosestTo(r_w_c), np.array([*at_m, up_m]))
        wide = np.diag([1.0, 1.0, UNKNOWN_RAD, sigma_m, sigma_m, 3 * agl_sigma]) ** 2
        cov_world = np.zeros((6, 6))
        cov_world[:3, :3], cov_world[3:, 3:] = wide[3:, 3:], wide[:3, :3]
        self._open = YawGauge(at_m) if attitude.yaw_rad is None else None
        self._velocity_cov = standing_cov() if attitude.stands else unknown_cov()
        state = NodeState(pose, bias, np.zeros(V_SIZE))
        return self._new_graph(frame_id, t_s, attitude, state, cov_world, bias_cov, self.terrain.ground_m)

    def _new_graph(
        self,
        frame_id: int,
        t_s: float,
        attitude: Attitude,
        state: NodeState,
        cov: np.ndarray,
        bias_cov: np.ndarray,
        ground_m: float,
    ) -> FrameState:
        """Of one node, whose pose is known to ``cov`` (6x6, world axes), above ground at ``ground_m``."""
        r_w_c = state.pose.rotation().matrix()
        node = self.graph.start(
            t_s,
            state,
            world_to_tangent(cov, r_w_c),
            bias_cov,
            self._velocity_cov,
            self.camera.factor(self.graph.next_keys(), attitude, r_w_c, ground_m),
            world_to_tangent(cov if self._open is None else self._open.chosen(cov), r_w_c),
        )
        self._graph_began(node, frame_id, t_s)
        self._last = self._placed(frame_id, t_s, node)
        return self._last

    def _graph_began(self, node: int, frame_id: int, t_s: float) -> None:
        """With the newest frame as its only ``node``."""
        assert self._newest_odometry is not None
        self._substitution = KeyframeSubstitution.of(self._newest_odometry)
        self._felt = self._stood_at = self._seen_from = None
        self._is_frame(node, frame_id, Fragment(t_s, joined=True))

    def _is_frame(self, node: int, frame_id: int, fragment: Fragment) -> None:
        """The newest node."""
        pose = self.graph.state(node).pose
        if fragment.frames == 1 and not fragment.joined:
            fragment.began_m = pose.translation()[:2]
            fragment.began_cov_m2 = tangent_to_world(self._covariance(node), pose.rotation().matrix())[:2, :2]
        self._fragment = fragment
        self._fragments.add(node, fragment)
        self._fragments.keep({n for n in self._node_of.values() if self.graph.holds(n)} | {node})
        self._node_of = {frame: n for frame, n in self._node_of.items() if self.graph.holds(n)}
        self._node_of[frame_id] = node
        self._frames.append(frame_id)
        self._levers.extend(self.lever(pose).ravel())

    def _by_odometry(self, odometry: Odometry, attitude: Attitude) -> tuple[int, RelativePose] | Verdict:
        """The keyframe's node and the motion since; or why odometry does not tell it."""
        if odometry.verdict is not Verdict.ACCEPTED or not odometry.pairs:
            return Verdict.FEW_INLIERS if odometry.verdict is Verdict.ACCEPTED else odometry.verdict
        parent = self._node_of.get(odometry.keyframe_id)
        if parent is None or not self.graph.holds(parent):
            return Verdict.STALE
        state = self.graph.state(parent)
        r_w_kf = state.pose.rotation().matrix()
        place_cov = r_w_kf @ self._cov_of[parent][3:, 3:] @ r_w_kf.T
        p = state.pose.translation()
        height = float(p[2]) - self.terrain.below(p)
        if height < 2.0:
            return Verdict.TOO_LOW
        r_w_k = self.camera.expected(attitude, state.bias, r_w_kf)
        tilt_sigma = np.radians(max(self.origin.attitude_sigma_deg, 1.0))
        if attitude.pitch_rad is None or attitude.roll_rad is None:
            r_w_k, tilt_sigma = r_w_kf, UNKNOWN_ATTITUDE_RAD  # nobody knows of a change of tilt
        share = min(1.0, odometry.inliers / max(odometry.tracked, 1))
        ground = self._ground(p, height, place_cov, share)
        if ground.level_sigma_m > MAX_LEVEL_SIGMA * height:
            return Verdict.DEGENERATE
        newest = self.graph.state(self.graph.newest)
        onward = newest.velocity[:3] * (odometry.t_ns * 1e-9 - self.graph.time_of(self.graph.newest))
        way_m = float(np.hypot(*(newest.pose.translation() + onward - p)[:2]))
        ground = replace(ground, rise_sigma_m=self.terrain.rise_sigma_m(way_m))
        motion = relative_pose(
            np.array(odometry.pairs),
            odometry.sigma_norm,
            r_w_kf,
            r_w_k,
            tilt_sigma,
            ground,
            float(newest.bias[LENS]),
        )
        if motion is None:
            return Verdict.FEW_INLIERS
        dt_s = max(odometry.t_ns * 1e-9 - self.graph.time_of(parent), 1e-3)
        possible = float(np.linalg.norm(motion.p_m)) <= MAX_SPEED_MPS * dt_s + height
        return (parent, motion) if possible else Verdict.IMPLAUSIBLE

    def _three(self, odometry: Odometry, parent: int, motion: RelativePose) -> tuple[int, ThreeViewConstraint] | None:
        """What the keyframe before saw of the same points, and its node."""
        first = self._node_of.get(odometry.before_id)
        if not odometry.triples or first is None or not self.graph.holds(first):
            return None
        before, middle = self.graph.state(first), self.graph.state(parent)
        ground_m = self.terrain.below(middle.pose.translation())
        risen = 0.0 if self.terrain.is_told else float(before.bias[HEIGHT] - middle.bias[HEIGHT])
        moved = gtsam.Pose3(before.pose.rotation(), before.pose.translation() + np.array([0.0, 0.0, risen]))
        guess = ThreeViewPose(
            middle.pose.between(moved),
            gtsam.Pose3(gtsam.Rot3.ClosestTo(motion.r), motion.p_m),
            float(middle.pose.translation()[2]) - ground_m,
            ground_m,
            float(middle.bias[LENS]),
        )
        triples, sigma_norm = np.array(odometry.triples), odometry.triples_sigma_norm
        seen = three_view_constraint(triples, sigma_norm, guess, self.origin.camera.focal_sigma)
        if seen is None:
            return None
        self.middle.see(triples, sigma_norm, seen.at)
        return first, seen

    def _ground(self, p_m: np.ndarray, height_m: float, place_cov: np.ndarray, share: float) -> Ground:
        """The plane under a camera at ``p_m`` (3,), known to ``place_cov`` (3x3). ``share`` of the matches agreed."""
        ground = self.terrain.seen_from(p_m, height_m, float(np.sqrt(place_cov[2, 2])), share)
        # Its slope was fitted at one place: where the camera may be elsewhere, the ground may lie higher or lower.
        slope = np.array([ground.slope_e, ground.slope_n])
        level_m = RELIEF_REPEATS * float(np.sqrt(slope @ place_cov[:2, :2] @ slope))
        return replace(ground, level_share=float(np.hypot(ground.level_share, level_m / height_m)))

    def _by_guess(
        self, attitude: Attitude, stands: bool, led_to_m: np.ndarray, spread: np.ndarray
    ) -> tuple[int, RelativePose]:
        """Nothing was seen: where velocity leads; the heading from the compass. A vehicle that stands is where it was
        when that began: a long silence is one guess from there, not a chain of short ones."""
        parent = self.graph.newest
        if stands and self._stood_at is not None and self.graph.holds(self._stood_at):
            parent = self._stood_at
            self.graph.keep(parent)
        state = self.graph.state(parent)
        r_parent = state.pose.rotation().matrix()
        r_w_c = self.camera.expected(attitude, state.bias, r_parent)
        turn = UNKNOWN_ATTITUDE_RAD + (0.3 if attitude.yaw_rad is None else np.radians(self.origin.yaw_sigma_deg))
        cov = np.diag([turn, turn, turn, 0.0, 0.0, 0.0]) ** 2
        cov[3:, 3:] = r_w_c.T @ spread[:3, :3] @ r_w_c
        step = np.zeros(3) if stands else led_to_m - state.pose.translation()
        return parent, RelativePose(r_parent.T @ r_w_c, r_parent.T @ step, cov)

    def _placed(self, frame_id: int, t_s: float, node: int) -> FrameState:
        if self.mode is CovarianceMode.MARGINALS and node == self.graph.newest:
            self._velocity_cov = self.graph.velocity_covariance(node)
            self._lens_sigma = float(np.sqrt(self.graph.bias_covariance(node)[LENS, LENS]))
        state = self.graph.state(node)
        velocity, velocity_cov, cov = state.velocity[:3], self._velocity_cov[:3, :3], self._covariance(node)
        if self._open is not None:
            cov, velocity_cov = self._open.opened(state.pose, cov, velocity, velocity_cov)
        return FrameState(frame_id, t_s, state.pose, cov, velocity, velocity_cov, node)

    def _covariance(self, node: int) -> np.ndarray:
        """Of C_node, 6x6, tangent order: the smoother's marginal, or under thermal throttle what the chain of motions
        and the inliers of the map fixes gave (O(inliers), ON-2)."""
        if self.mode is CovarianceMode.MARGINALS or node not in self._cov_of:
            self._cov_of[node] = self.graph.covariance(node)
        return self._cov_of[node]


def scale_sigma(camera: Camera) -> float:
    """1-sigma of SCALE before anything was seen."""
    return float(np.hypot(camera.focal_sigma, BAROMETER_SCALE))


def _padded(position_m2: np.ndarray) -> np.ndarray:
    """(6, 6), position first, of a covariance (3, 3) of position."""
    cov = np.zeros((6, 6))
    cov[:3, :3] = position_m2
    return cov


def _compose_cov(cov_parent: np.ndarray, motion: RelativePose) -> np.ndarray:
    """Covariance of parent * motion, tangent order, first order."""
    adjoint = gtsam.Pose3(gtsam.Rot3.ClosestTo(motion.r), motion.p_m).inverse().AdjointMap()
    return adjoint @ cov_parent @ adjoint.T + motion.cov
