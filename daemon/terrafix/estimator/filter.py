"""The estimator proper: motion, attitude, height and map fixes become nodes and factors of one graph.

Everything is asked in two steps: ``advance`` takes a frame's odometry and says where the camera should be, ``fix``
takes the frame's map match. Both answer with a verdict."""

import math
from collections import deque
from dataclasses import dataclass

import gtsam
import numpy as np

from terrafix.core.camera import Mount
from terrafix.core.geodesy import local_rotation_up, rot_from_quat, rot_w_b, yaw_of
from terrafix.core.pose import exp_so3, tangent_to_world, world_to_tangent
from terrafix.estimator.factors import attitude_and_height_factor
from terrafix.estimator.graph import NodeState, PoseGraph
from terrafix.estimator.motion import Ground, RelativePose, relative_pose
from terrafix.estimator.telemetry import Attitude
from terrafix.messages import CovarianceMode, MapMatch, Odometry, Origin, Verdict

UNKNOWN_RAD = 3.0  # sigma of a heading that nobody reports
# What an autopilot's own sigma leaves out: a compass beside motors and wires, a barometer over sloping ground, a focal
# length that is a few per cent off. On real flights the heading was 12 degrees and the scale 8 % away from the log, and
# a compass that is 15 degrees off must still be inside the search (1.5 sigma).
COMPASS_BIAS_RAD = np.radians(10.0)
HEIGHT_BIAS = 0.05  # of the height
UNKNOWN_ATTITUDE_RAD = np.radians(4.0)  # sigma of roll and pitch that nobody reports: level flight and gentle turns
DEFAULT_AGL_M = 120.0  # when nobody reports a height: the usual ceiling of small drones ...
DEFAULT_AGL_SIGMA_M = 50.0  # ... and wide enough for all of them
MAX_ACCELERATION_MPS2 = 3.0  # of small drones in cruise: how wrong the last velocity may become
MAX_SPEED_SIGMA_MPS = 10.0  # per axis: of a velocity of which nothing is known
MAX_SPEED_MPS = 80.0  # faster than any drone that this is made for
VELOCITY_MEMORY_S = 10.0  # how long a drone keeps its course when nobody looks
# 1-sigma of the slope and of the level (share of the height) of the ground that is seen: fields and towns without a
# DEM; what houses and trees leave with one.
FLAT_SIGMAS, DEM_SIGMAS = (0.03, 0.02), (0.015, 0.01)
RELIEF_SLOPE = 2.0  # a plane that misses the ground by this share of the height misses its slope by so much more
STANDING_M, STANDING_MPS = 0.3, 0.1  # 1-sigma of a vehicle whose motors may not turn
VELOCITY_SPAN_S = 0.9  # a velocity is measured over about a second: shorter is noise, longer misses turns
VELOCITY_FLOOR_M = 0.15  # error of the relative position of two nodes that close, at best
VELOCITY_SHARE = 0.03  # ... of their distance, when the graph is not asked (cheap mode)
BEND_SHARE = 0.4  # of the change of velocity that is carried on: the turn may have ended ...
TURN_SHARE = 0.15  # ... which a nose that turned with it up to now denies
TURN_AGREES = 0.5  # of the change of velocity: so close must the turn of the nose explain it
STEP_SHARE = 0.04  # of a step: what odometry over real ground gets wrong, for the anchor's belief
STEP_FLOOR_M = 0.5
GATE_6DOF = 22.5  # chi-square, 6 degrees of freedom, 99.9 %
LOCAL_WARP = 0.33  # of the map's own error: by so much orthophotos are stretched over one footprint
ROOFS = 0.03  # of the height, 1-sigma: roofs and crowns lift the ground that is seen, and with it the height
SAME_GROUND_SHARE = 0.5  # of the height: fixes closer together than this share their errors ...
MIN_NEW_GROUND = 0.1  # ... and a fix over the same ground counts at least this much
COARSE_CONTINUES = 0.5  # of the height: sigma of the estimate up to which the belief's mode alone is taken as a fix
RECOVER_AFTER = 3  # fixes that agree with each other and not with the graph
RECOVER_OVER = 0.5  # of the height: the motion they must span, so that they are not one mistake seen thrice
RECOVER_AGREE_M = 15.0
RECOVER_MASS = 0.97
RESTART_INFLATION = 4.0  # of the covariance of the fix that starts the graph anew


@dataclass(frozen=True)
class Placed:
    """The camera at a frame: pose, covariance (6x6, tangent order), and which node it is."""

    frame_id: int
    t_s: float
    pose: gtsam.Pose3
    cov: np.ndarray
    node: int


@dataclass(frozen=True)
class Advance:
    verdict: Verdict
    placed: Placed
    step_m: np.ndarray  # (2,) east, north since the frame before, by odometry alone
    step_sigma_m: float


@dataclass(frozen=True)
class FixResult:
    verdict: Verdict
    mahalanobis2: float | None
    detail: str = ""


@dataclass
class _Disagreement:
    """Map fixes that the graph refused, as offsets from it."""

    offsets_m: list[np.ndarray]
    began_at_m: np.ndarray


class Estimator:
    def __init__(self, origin: Origin) -> None:
        self.origin = origin
        self.graph = PoseGraph()
        self.velocity_mps = np.zeros(3)
        self.velocity_sigma_mps = MAX_SPEED_SIGMA_MPS
        self.last_fix_t_s: float | None = None
        self.mode = CovarianceMode.MARGINALS
        self.map_sigma_m = 0.0  # of the map that placed us; nothing until it did
        self.ground_m = origin.ground_amsl_m or 0.0  # AMSL of the ground below, from the map's DEM
        self._relief_m = 0.0  # how far the ground departs from a plane
        self._slope: tuple[float, float] | None = None  # of the ground, east and north; None: no DEM
        self._r_b_c = Mount.of(origin.camera).r_b_c()
        self._node_of: dict[int, int] = {}  # frame -> node
        self._cov_of: dict[int, np.ndarray] = {}  # node -> newest covariance of C, for the cheap mode
        self._last: Placed | None = None  # newest frame
        self._fixed_at_m: np.ndarray | None = None
        self._refused: _Disagreement | None = None
        self._began_with = (False, False)  # heading, height
        self._began_s: float | None = None
        # Nodes that odometry or the map vouches for; others hang on it as leaves.
        self._trunk: deque[int] = deque(maxlen=40)

    # --- motion ---------------------------------------------------------------------------------------------

    def advance(self, frame_id: int, t_s: float, odometry: Odometry, attitude: Attitude) -> Advance:
        if self._last is None or self._knows_more(attitude):
            return self._begin(frame_id, t_s, attitude)
        last = self._last
        known = self._by_odometry(odometry, attitude)
        if known is not None:
            parent, motion = known
            verdict = Verdict.ACCEPTED
        else:
            parent, motion = self._by_guess(t_s, attitude)
            verdict = odometry.verdict if odometry.verdict is not Verdict.ACCEPTED else Verdict.FEW_INLIERS
        before = self.graph.state(parent)
        pose = before.pose.compose(gtsam.Pose3(gtsam.Rot3.ClosestTo(motion.r), motion.p_m))
        last_pose = self.graph.state(last.node).pose
        step = (pose.translation() - last_pose.translation())[:2]
        dt_s = max(t_s - last.t_s, 1e-3)
        if known is not None:
            spread = float(np.sqrt(np.trace(motion.cov[3:, 3:]) / 3.0))
            step_sigma = float(np.hypot(STEP_FLOOR_M + STEP_SHARE * float(np.hypot(*step)), spread))
        else:
            step_sigma = STANDING_M if attitude.stands else self._drift_sigma(dt_s)
            grown = min(MAX_SPEED_SIGMA_MPS, self.velocity_sigma_mps + MAX_ACCELERATION_MPS2 * dt_s)
            self.velocity_sigma_mps = STANDING_MPS if attitude.stands else grown
        self._cov_of[self.graph.next_node] = _compose_cov(self._covariance(parent), motion)
        node = self.graph.extend(
            t_s, NodeState(pose, before.bias), parent, motion, self._attitude(attitude, pose.rotation().matrix())
        )
        self._node_of[frame_id] = node
        if known is not None:
            self._trunk.append(node)
            self._learn_velocity(node)
        self._last = Placed(frame_id, t_s, self.graph.state(node).pose, self._covariance(node), node)
        return Advance(verdict, self._last, step, step_sigma)

    def _knows_more(self, attitude: Attitude) -> bool:
        """The first words of the autopilot came after the first frame, before the first fix. No linear graph recovers
        from a heading that turns out to be 70 degrees off what was assumed, so it begins again."""
        heading = not self._began_with[0] and attitude.yaw_rad is not None
        height = not self._began_with[1] and attitude.agl_m is not None
        return self.last_fix_t_s is None and (heading or height)

    def _begin(self, frame_id: int, t_s: float, attitude: Attitude) -> Advance:
        origin = self.origin
        self._began_with = (attitude.yaw_rad is not None, attitude.agl_m is not None)
        waited_s = 0.0 if self._began_s is None else t_s - self._began_s
        self._began_s = t_s - waited_s
        drift_m = self._drift_sigma(waited_s) if waited_s > 0.0 else 0.0
        tolerance = np.radians(origin.camera.mount_tolerance_deg)
        agl = DEFAULT_AGL_M if attitude.agl_m is None else attitude.agl_m
        agl_sigma = DEFAULT_AGL_SIGMA_M if attitude.agl_m is None else origin.agl_sigma_m
        r_w_c = self._expected_rotation(attitude, np.zeros(4))
        pose = gtsam.Pose3(gtsam.Rot3.ClosestTo(r_w_c), np.array([0.0, 0.0, self.ground_m + agl]))
        start = float(np.hypot(max(origin.start_sigma_m, 1.0), drift_m))
        wide = np.diag([1.0, 1.0, UNKNOWN_RAD, start, start, 3 * agl_sigma]) ** 2
        cov_world = np.zeros((6, 6))
        cov_world[:3, :3], cov_world[3:, 3:] = wide[3:, 3:], wide[:3, :3]
        yaw = float(np.hypot(np.radians(origin.yaw_sigma_deg), COMPASS_BIAS_RAD))
        bias_cov = np.diag([tolerance, tolerance, yaw, float(np.hypot(agl_sigma, HEIGHT_BIAS * agl))]) ** 2
        self._trunk.clear()
        node = self.graph.start(
            t_s,
            NodeState(pose, np.zeros(4)),
            world_to_tangent(cov_world, r_w_c),
            bias_cov,
            self._attitude(attitude, r_w_c),
        )
        self._trunk.append(node)
        self._node_of[frame_id] = node
        self._last = Placed(frame_id, t_s, self.graph.state(node).pose, self._covariance(node), node)
        return Advance(Verdict.ACCEPTED, self._last, np.zeros(2), drift_m)

    def _by_odometry(self, odometry: Odometry, attitude: Attitude) -> tuple[int, RelativePose] | None:
        """The keyframe's node and the motion since, when odometry has both."""
        if odometry.verdict is not Verdict.ACCEPTED or not odometry.pairs:
            return None
        parent = self._node_of.get(odometry.keyframe_id)
        if parent is None or not self.graph.holds(parent):
            return None
        state = self.graph.state(parent)
        r_w_kf = state.pose.rotation().matrix()
        height_sigma = float(np.sqrt(r_w_kf[2] @ self._covariance(parent)[3:, 3:] @ r_w_kf[2]))
        height = float(state.pose.translation()[2]) - self.ground_m
        if height < 2.0:
            return None
        r_w_k = self._expected_rotation(attitude, state.bias, r_w_kf)
        tilt_sigma = np.radians(max(self.origin.attitude_sigma_deg, 1.0))
        if attitude.pitch_rad is None or attitude.roll_rad is None:
            r_w_k, tilt_sigma = r_w_kf, UNKNOWN_ATTITUDE_RAD  # nobody knows of a change of tilt
        known_slope = self._slope is not None
        slope_e, slope_n = self._slope or (0.0, 0.0)
        slope_sigma, level_share = DEM_SIGMAS if known_slope else FLAT_SIGMAS
        # Over hills the tracked points lie off the plane, all on one side for a while.
        slope_sigma = float(np.hypot(slope_sigma, RELIEF_SLOPE * self._relief_m / height))
        level_share = float(np.hypot(level_share, self._relief_m / height))
        share = min(1.0, odometry.inliers / max(odometry.tracked, 1))
        ground = Ground(height, height_sigma, slope_e, slope_n, slope_sigma, level_share, share)
        motion = relative_pose(np.array(odometry.pairs), odometry.sigma_norm, r_w_kf, r_w_k, tilt_sigma, ground)
        if motion is None:
            return None
        dt_s = max(odometry.t_ns * 1e-9 - self.graph.time_of(parent), 1e-3)
        possible = float(np.linalg.norm(motion.p_m)) <= MAX_SPEED_MPS * dt_s + height
        return (parent, motion) if possible else None

    def _by_guess(self, t_s: float, attitude: Attitude) -> tuple[int, RelativePose]:
        """Nothing was seen: the last velocity, less certain the longer it lasts; the heading from the compass."""
        parent = self._trunk[-1] if self.graph.holds(self._trunk[-1]) else self.graph.newest
        self.graph.keep(parent)  # a long silence is one long guess from here, not a chain of short ones
        state = self.graph.state(parent)
        dt_s = max(t_s - self.graph.time_of(parent), 1e-3)
        r_parent = state.pose.rotation().matrix()
        r_w_c = self._expected_rotation(attitude, state.bias, r_parent)
        sigma = self._drift_sigma(dt_s)
        if attitude.stands:
            self.velocity_mps, sigma = np.zeros(3), STANDING_M
        tau = VELOCITY_MEMORY_S
        turn = UNKNOWN_ATTITUDE_RAD + (0.3 if attitude.yaw_rad is None else np.radians(self.origin.yaw_sigma_deg))
        cov = np.diag([turn, turn, turn, sigma, sigma, sigma]) ** 2
        step = self.velocity_mps * tau * (1 - float(np.exp(-dt_s / tau)))
        return parent, RelativePose(r_parent.T @ r_w_c, r_parent.T @ step, cov)

    def _drift_sigma(self, dt_s: float) -> float:
        """How far a drone may be from where its last velocity would have taken it, per axis: an integrated
        Ornstein-Uhlenbeck process, since a drone that is out of sight also turns back."""
        tau = VELOCITY_MEMORY_S
        speed = max(MAX_SPEED_SIGMA_MPS, float(np.linalg.norm(self.velocity_mps)))
        wander = speed * float(np.sqrt(2 * tau * (dt_s - tau * (1 - np.exp(-dt_s / tau)))))
        course = float(np.hypot(self.velocity_sigma_mps * dt_s, 0.5 * MAX_ACCELERATION_MPS2 * dt_s**2))
        return max(min(course, wander), STEP_FLOOR_M)

    def _covariance(self, node: int) -> np.ndarray:
        """Of C_node, 6x6, tangent order: the smoother's marginal, or under thermal throttle what the chain of motions
        and the inliers of the map fixes gave (O(inliers), ON-2)."""
        if self.mode is CovarianceMode.MARGINALS or node not in self._cov_of:
            self._cov_of[node] = self.graph.covariance(node)
        return self._cov_of[node]

    def _learn_velocity(self, node: int) -> None:
        """From the newest nodes: mean velocity of the last second and of the one before, carried on to now."""
        now_s = self.graph.time_of(node)
        middle = self._trunk_before(now_s - VELOCITY_SPAN_S)
        if middle is None:
            return
        p = self.graph.state(node).pose.translation()
        p1 = self.graph.state(middle).pose.translation()
        span_s = now_s - self.graph.time_of(middle)
        v1 = (p - p1) / span_s
        noise = max(VELOCITY_FLOOR_M, self._relative_sigma(middle, node)) / span_s
        bend = np.zeros(3)
        first = self._trunk_before(self.graph.time_of(middle) - VELOCITY_SPAN_S)
        if first is not None:
            before_s = self.graph.time_of(middle) - self.graph.time_of(first)
            v0 = (p1 - self.graph.state(first).pose.translation()) / before_s
            bend = (v1 - v0) * span_s / (span_s + before_s)
        self.velocity_mps = v1 + bend
        share = TURN_SHARE if self._turning(middle, node, v1, bend) else BEND_SHARE
        unseen = MAX_ACCELERATION_MPS2 * max(span_s - 2 * VELOCITY_SPAN_S, 0.0) / 2  # a span too long to follow turns
        self.velocity_sigma_mps = min(
            MAX_SPEED_SIGMA_MPS, float(np.sqrt(1.5 * noise**2 + unseen**2 + (share * np.linalg.norm(bend)) ** 2))
        )

    def _turning(self, a: int, b: int, velocity_mps: np.ndarray, bend_mps: np.ndarray) -> bool:
        """Whether the turn of the nose between two nodes explains how the velocity changed from their middle to now:
        the banked turn of an aircraft that flies where its nose points."""
        nose_a, nose_b = (yaw_of(self.graph.state(n).pose.rotation().matrix() @ self._r_b_c.T) for n in (a, b))
        half = local_rotation_up(-0.5 * math.remainder(nose_b - nose_a, math.tau))  # yaw runs clockwise
        left = bend_mps - (half @ velocity_mps - velocity_mps)
        return float(np.linalg.norm(left[:2])) < TURN_AGREES * float(np.linalg.norm(bend_mps[:2]))

    def _relative_sigma(self, a: int, b: int) -> float:
        """1-sigma per horizontal axis of the way between two nodes of the window, metres."""
        if self.mode is CovarianceMode.JACOBIAN:
            way = self.graph.state(b).pose.translation() - self.graph.state(a).pose.translation()
            return VELOCITY_SHARE * float(np.linalg.norm(way))
        return float(np.sqrt(np.trace(self.graph.relative_covariance(a, b)[:2, :2]) / 2.0))

    def _trunk_before(self, t_s: float) -> int | None:
        """Newest node that odometry or the map vouches for at or before a time, within the window."""
        return next((n for n in reversed(self._trunk) if self.graph.holds(n) and self.graph.time_of(n) <= t_s), None)

    # --- attitude and height --------------------------------------------------------------------------------

    def _expected_rotation(self, attitude: Attitude, bias: np.ndarray, before: np.ndarray | None = None) -> np.ndarray:
        """R_w_c by the autopilot's attitude and the mount as it was learnt; heading as before when nobody says it."""
        r_w_b = rot_w_b(attitude.yaw_rad or 0.0, attitude.pitch_rad or 0.0, attitude.roll_rad or 0.0)
        if attitude.yaw_rad is None and before is not None:
            return before
        return exp_so3(np.array([0.0, 0.0, bias[2]])) @ r_w_b @ self._r_b_c @ exp_so3(np.array([bias[0], bias[1], 0.0]))

    def _attitude(self, attitude: Attitude, r_w_c: np.ndarray) -> gtsam.CustomFactor:
        """``r_w_c``: the predicted camera, whose heading stands in for one that nobody reports."""
        origin = self.origin
        tilt = UNKNOWN_ATTITUDE_RAD
        if attitude.pitch_rad is not None and attitude.roll_rad is not None:
            tilt = np.radians(max(origin.attitude_sigma_deg, 0.3))
        yaw_rad, yaw_sigma = attitude.yaw_rad, np.radians(max(origin.yaw_sigma_deg, 1.0))
        if yaw_rad is None:
            yaw_rad, yaw_sigma = yaw_of(r_w_c @ self._r_b_c.T), UNKNOWN_RAD * 10
        height = DEFAULT_AGL_SIGMA_M * 20 if attitude.agl_m is None else max(origin.agl_sigma_m, 0.5)
        up = (origin.ground_amsl_m or 0.0) + (DEFAULT_AGL_M if attitude.agl_m is None else attitude.agl_m)
        r_w_b = rot_w_b(yaw_rad, attitude.pitch_rad or 0.0, attitude.roll_rad or 0.0)
        return attitude_and_height_factor(
            *self.graph.next_keys(), np.array([tilt, tilt, yaw_sigma, height]), r_w_b, self._r_b_c, up
        )

    # --- map ------------------------------------------------------------------------------------------------

    def fix(self, match: MapMatch) -> FixResult:
        """A map match of a frame that ``advance`` has seen. Gated; enters the graph at its own node."""
        if match.ground is not None:
            self.ground_m, self._slope, self._relief_m = match.ground[0], match.ground[1:], match.relief_m
        if match.verdict is not Verdict.ACCEPTED or match.p_c_in_w_m is None or match.q_w_c is None:
            return FixResult(match.verdict, None)
        node = self._node_of.get(match.frame_id)
        if node is None or not self.graph.holds(node):
            return FixResult(Verdict.STALE, None)
        r_w_c = rot_from_quat(match.q_w_c)
        measured = gtsam.Pose3(gtsam.Rot3.ClosestTo(r_w_c), np.array(match.p_c_in_w_m))
        cov = world_to_tangent(np.array(match.cov).reshape(6, 6), r_w_c)
        height = max(match.p_c_in_w_m[2] - self.ground_m, 1.0)
        local_m = LOCAL_WARP * match.map_sigma_m
        warp = np.diag([local_m, local_m, ROOFS * height]) ** 2
        cov[3:, 3:] += r_w_c.T @ warp @ r_w_c
        predicted = self.graph.state(node).pose
        spread = float(np.sqrt(np.max(np.diag(tangent_to_world(self._covariance(node), r_w_c))[:2])))
        if match.coarse and spread > COARSE_CONTINUES * height:
            return FixResult(Verdict.AMBIGUOUS, None, "a coarse fix continues a track, it does not find one")
        innovation = predicted.logmap(measured)
        d2 = float(innovation @ np.linalg.solve(self._covariance(node) + cov, innovation))
        if d2 > GATE_6DOF:
            return self._refuse(match, node, measured, cov, d2)
        self._refused = None
        here = measured.translation()[:2]
        new = 1.0
        if self._fixed_at_m is not None:
            moved = float(np.hypot(*(here - self._fixed_at_m)))
            new = float(np.clip(moved / (SAME_GROUND_SHARE * height), MIN_NEW_GROUND, 1.0))
        before = self._covariance(node)
        self.graph.add_pose(node, measured, cov / new)
        self._cov_of[node] = np.linalg.inv(np.linalg.inv(before) + np.linalg.inv(cov / new))
        self._accepted(match, node, here)
        return FixResult(Verdict.ACCEPTED, d2, f"new ground {new:.2f}")

    def _accepted(self, match: MapMatch, node: int, here: np.ndarray) -> None:
        self._fixed_at_m = here
        self.map_sigma_m = match.map_sigma_m
        if node > self._trunk[-1]:
            self._trunk.append(node)
        self.last_fix_t_s = self.graph.time_of(node)
        last = self._last
        if last is not None and last.frame_id in self._node_of:
            newest = self._node_of[last.frame_id]
            pose = self.graph.state(newest).pose
            self._last = Placed(last.frame_id, last.t_s, pose, self._covariance(newest), newest)

    def _refuse(self, match: MapMatch, node: int, measured: gtsam.Pose3, cov: np.ndarray, d2: float) -> FixResult:
        """Refused, unless several fixes over new ground agree with each other: then it is the graph that is lost."""
        predicted = self.graph.state(node).pose
        offset = (measured.translation() - predicted.translation())[:2]
        here = predicted.translation()[:2]
        refused = self._refused
        if refused is None or float(np.hypot(*(offset - np.mean(refused.offsets_m, axis=0)))) > RECOVER_AGREE_M:
            self._refused = _Disagreement([offset], here)
        else:
            refused.offsets_m.append(offset)
            height = float(measured.translation()[2]) - self.ground_m
            far = float(np.hypot(*(here - refused.began_at_m))) > RECOVER_OVER * height
            if len(refused.offsets_m) >= RECOVER_AFTER and far and match.mode_mass >= RECOVER_MASS:
                bias = self.graph.state(node).bias
                bias_cov = self.graph.bias_covariance(node)
                self.graph.start(self.graph.time_of(node), NodeState(measured, bias), RESTART_INFLATION * cov, bias_cov)
                self._node_of[match.frame_id] = self.graph.newest
                self._cov_of.clear()
                self._refused = None
                self._accepted(match, self.graph.newest, measured.translation()[:2])
                return FixResult(Verdict.ACCEPTED, d2, f"restarted {float(np.hypot(*offset)):.0f} m away")
        return FixResult(Verdict.INNOVATION, d2, f"{float(np.hypot(*offset)):.0f} m from the estimate")

    @property
    def last(self) -> Placed | None:
        """The newest frame, with all that is known of it by now."""
        return self._last

    def body(self, placed: Placed) -> np.ndarray:
        """R_w_b (3x3) of a placed frame, with the mount as it was learnt."""
        bias = self.graph.state(placed.node).bias
        r_b_c = self._r_b_c @ exp_so3(np.array([bias[0], bias[1], 0.0]))
        return np.asarray(placed.pose.rotation().matrix() @ r_b_c.T)

    def refine(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """frame -> position (3,) and its covariance (3x3), after a batch optimisation of the whole flight."""
        refined = self.graph.refine()
        return {
            frame: (np.asarray(refined[node][0].translation()), refined[node][1])
            for frame, node in self._node_of.items()
            if node in refined
        }


def _compose_cov(cov_parent: np.ndarray, motion: RelativePose) -> np.ndarray:
    """Covariance of parent * motion, tangent order, first order."""
    adjoint = gtsam.Pose3(gtsam.Rot3.ClosestTo(motion.r), motion.p_m).inverse().AdjointMap()
    return adjoint @ cov_parent @ adjoint.T + motion.cov
