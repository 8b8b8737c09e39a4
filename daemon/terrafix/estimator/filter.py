"""The estimator proper: motion, attitude, height and map fixes become nodes and factors of one graph.

Everything is asked in two steps: ``advance`` takes a frame's odometry and says where the camera should be, ``fix``
takes the frame's map match. Both answer with a verdict."""

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

from terrafix.core.camera import Mount
from terrafix.core.geodesy import rot_w_b, yaw_of
from terrafix.core.pose import exp_so3, tangent_to_world, world_to_tangent
from terrafix.core.start import SEARCHED_START_M
from terrafix.estimator.doubt import Doubt
from terrafix.estimator.factors import attitude_and_height_factor
from terrafix.estimator.graph import NodeState, PoseGraph
from terrafix.estimator.matched import determined, measured_pose
from terrafix.estimator.motion import RelativePose, relative_pose
from terrafix.estimator.rival import Rival
from terrafix.estimator.telemetry import Attitude
from terrafix.estimator.terrain import Terrain
from terrafix.estimator.velocity import (
    STANDING_M,
    TYPICAL_SPEED_MPS,
    Felt,
    Leg,
    believed,
    leg,
    spread_after,
    standing_cov,
    unknown_cov,
    wandered_m,
)
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
MAX_SPEED_MPS = 80.0  # faster than any drone that this is made for
FLYING_M = 20.0  # above the ground: a vehicle that is seen to move there has taken off
STEP_SHARE = 0.04  # of a step: what odometry over real ground gets wrong, for the anchor's belief
STEP_FLOOR_M = 0.5
GATE_6DOF = 22.5  # chi-square, 6 degrees of freedom, 99.9 %
SAME_GROUND_SHARE = 0.5  # of the height: fixes closer together than this share their errors ...
MIN_NEW_GROUND = 0.1  # ... and a fix over the same ground counts at least this much
COARSE_CONTINUES = 0.5  # of the height: sigma of the estimate up to which the belief's mode alone is taken as a fix
RECOVER_AFTER = 3  # fixes that agree with each other and not with the graph
RECOVER_OVER = 0.5  # of the height: the motion they must span, so that they are not one mistake seen thrice
RECOVER_AGREE_M = 15.0
RECOVER_MASS = 0.97
RESTART_INFLATION = 4.0  # of the covariance of the fix that starts the graph anew


Feel = Callable[[int, int], Felt | None]


def nothing_felt(_t0_ns: int, _t1_ns: int) -> None:
    """There are no inertial readings."""


@dataclass(frozen=True)
class Placed:
    """The camera at a frame: pose, covariance (6x6, tangent order), velocity with covariance (3x3), and its node."""

    frame_id: int
    t_s: float
    pose: gtsam.Pose3
    cov: np.ndarray
    velocity_mps: np.ndarray
    velocity_cov: np.ndarray
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
        self.last_fix_t_s: float | None = None
        self.mode = CovarianceMode.MARGINALS
        self.doubt = Doubt.of(origin)
        self.rival = Rival()
        self._torn: dict[int, np.ndarray] = {}  # frame -> spread (2, 2) of the two places between which it was
        self.map_sigma_m = 0.0  # of the map that placed us; nothing until it did
        self.terrain = Terrain(origin.ground_amsl_m or 0.0)
        self._r_b_c = Mount.of(origin.camera).r_b_c()
        self._node_of: dict[int, int] = {}  # frame -> node
        self._cov_of: dict[int, np.ndarray] = {}  # node -> newest covariance of C, for the cheap mode
        self._velocity_cov = np.zeros((6, 6))  # of V of the newest node
        self._pace_mps = TYPICAL_SPEED_MPS  # how fast it was when it was last seen to fly
        self._felt: bool | None = None  # whether the last leg was measured; None: there was none
        self._stood_at: int | None = None  # node at which a vehicle stands, motors off
        self._launching = False  # it stood, and was not seen to fly since ...
        self._blind = False  # ... nor felt
        self._last: Placed | None = None  # newest frame
        self._fixed_at_m: np.ndarray | None = None
        self._refused: _Disagreement | None = None
        self._began_with = (False, False)  # heading, height
        self._began_s: float | None = None
        self._tilt_said = False  # the autopilot reports roll and pitch

    # --- motion ---------------------------------------------------------------------------------------------

    def advance(
        self, frame_id: int, t_s: float, odometry: Odometry, attitude: Attitude, felt: Feel = nothing_felt
    ) -> Advance:
        """``felt(t0_ns, t1_ns)``: acceleration between two times, where the inertial readings cover them."""
        if self._last is None or self._knows_more(attitude):
            return self._begin(frame_id, t_s, attitude)
        newest = self.graph.newest
        before = self.graph.state(newest)
        known = self._by_odometry(odometry, attitude)
        self._launching = attitude.stands or self._launching
        way = None if attitude.stands else self._leg(t_s, before, attitude, felt)
        spread = spread_after(way, self._velocity_cov)
        led_to, velocity = before.pose.translation(), np.zeros(6)
        if way is not None:
            led_to, velocity = way.predicted(led_to, before.velocity, float(before.bias[2]))
        if self._has_taken_off_blind(known is not None, way, led_to):
            cov = tangent_to_world(self._covariance(newest), before.pose.rotation().matrix())
            sigma_m = float(np.sqrt(np.linalg.eigvalsh(cov[:2, :2] + spread[:2, :2])[-1]))
            placed = self._start_graph(frame_id, t_s, attitude, led_to[:2], sigma_m)
            return Advance(Verdict.ACCEPTED, placed, (led_to - before.pose.translation())[:2], sigma_m)
        if known is not None:
            parent, motion = known
            verdict = Verdict.ACCEPTED
        else:
            parent, motion = self._by_guess(attitude, way is None, led_to, spread)
            verdict = odometry.verdict if odometry.verdict is not Verdict.ACCEPTED else Verdict.FEW_INLIERS
        pose = self.graph.state(parent).pose.compose(gtsam.Pose3(gtsam.Rot3.ClosestTo(motion.r), motion.p_m))
        r_w_c, p = pose.rotation().matrix(), np.asarray(pose.translation())
        step = (p - before.pose.translation())[:2]
        step_sigma = STANDING_M if way is None else float(np.sqrt(np.linalg.eigvalsh(spread[:2, :2])[-1]))
        if known is not None:
            seen = r_w_c @ motion.cov[3:, 3:] @ r_w_c.T
            step_sigma = float(np.hypot(STEP_FLOOR_M + STEP_SHARE * np.hypot(*step), np.sqrt(np.trace(seen) / 3.0)))
            if way is not None:
                way, spread = believed(way, p - led_to, spread, seen)
        if self.mode is CovarianceMode.JACOBIAN:
            self._cov_of[self.graph.next_node] = _compose_cov(self._cov_of[parent], motion)
        state = NodeState(pose, before.bias, velocity)
        node = self.graph.extend(t_s, state, parent, motion, way, self._attitude(attitude, r_w_c))
        self._felt = None if way is None else way.inertial
        if not attitude.stands:
            self._stood_at = None
        elif self._stood_at is None:
            self._stood_at = node
        self._node_of[frame_id] = node
        self._cov_of = {n: cov for n, cov in self._cov_of.items() if self.graph.holds(n)}
        self._velocity_cov = spread[3:, 3:]
        self._last = self._placed(frame_id, t_s, node)
        if known is not None:
            v = self._last.velocity_mps[:2]
            self._pace_mps = float(np.sqrt(v @ v + np.trace(self._last.velocity_cov[:2, :2])))
        self._note_rival(frame_id)
        return Advance(verdict, self._last, step, step_sigma)

    def _leg(self, t_s: float, before: NodeState, attitude: Attitude, felt: Feel) -> Leg:
        """From the newest node to now."""
        from_s = self.graph.time_of(self.graph.newest)
        measured = felt(round(from_s * 1e9), round(t_s * 1e9))
        r_w_c = before.pose.rotation().matrix()
        yaws = tuple(yaw_of(r @ self._r_b_c.T) for r in (r_w_c, self._expected_rotation(attitude, before.bias, r_w_c)))
        return leg(
            max(t_s - from_s, 1e-3),
            measured,
            (yaws[0], yaws[1]),
            float(before.bias[2]),
            self._pace_mps,
            np.radians(self.origin.attitude_sigma_deg),
            same_kind=self._felt is (measured is not None),
            launching=self._launching,
        )

    def _has_taken_off_blind(self, seen: bool, way: Leg | None, led_to_m: np.ndarray) -> bool:
        """It is seen to fly after a take-off that nothing measured. Told of the speed at both ends, a graph would
        make up the way between them and be too sure of it: it begins again, where and as sure as it is."""
        if not self._launching or way is None:
            return False
        self._blind = self._blind or not way.inertial
        if not seen or float(led_to_m[2]) - self.terrain.ground_m < FLYING_M:
            return False
        blind, self._launching, self._blind = self._blind, False, False
        return blind

    def _knows_more(self, attitude: Attitude) -> bool:
        """The first words of the autopilot came after the first frame, before the first fix. No linear graph recovers
        from a heading that turns out to be 70 degrees off what was assumed, so it begins again."""
        heading = not self._began_with[0] and attitude.yaw_rad is not None
        height = not self._began_with[1] and attitude.agl_m is not None
        return self.last_fix_t_s is None and (heading or height)

    def _begin(self, frame_id: int, t_s: float, attitude: Attitude) -> Advance:
        """At the flight's start, less sure the longer that was ago."""
        self._began_with = (attitude.yaw_rad is not None, attitude.agl_m is not None)
        waited_s = 0.0 if self._began_s is None else t_s - self._began_s
        self._began_s = t_s - waited_s
        drift_m = wandered_m(waited_s) if waited_s > 0.0 else 0.0
        start_m = float(np.hypot(min(max(self.origin.start_sigma_m, 1.0), SEARCHED_START_M), drift_m))
        placed = self._start_graph(frame_id, t_s, attitude, np.zeros(2), start_m)
        return Advance(Verdict.ACCEPTED, placed, np.zeros(2), drift_m)

    def _start_graph(self, frame_id: int, t_s: float, attitude: Attitude, at_m: np.ndarray, sigma_m: float) -> Placed:
        """Anew at ``at_m`` (east, north), known to ``sigma_m``; all else as the autopilot says it."""
        origin = self.origin
        tolerance = np.radians(origin.camera.mount_tolerance_deg)
        agl = DEFAULT_AGL_M if attitude.agl_m is None else attitude.agl_m
        agl_sigma = DEFAULT_AGL_SIGMA_M if attitude.agl_m is None else origin.agl_sigma_m
        r_w_c = self._expected_rotation(attitude, np.zeros(4))
        pose = gtsam.Pose3(gtsam.Rot3.ClosestTo(r_w_c), np.array([*at_m, self.terrain.ground_m + agl]))
        wide = np.diag([1.0, 1.0, UNKNOWN_RAD, sigma_m, sigma_m, 3 * agl_sigma]) ** 2
        cov_world = np.zeros((6, 6))
        cov_world[:3, :3], cov_world[3:, 3:] = wide[3:, 3:], wide[:3, :3]
        yaw = float(np.hypot(np.radians(origin.yaw_sigma_deg), COMPASS_BIAS_RAD))
        bias_cov = np.diag([tolerance, tolerance, yaw, float(np.hypot(agl_sigma, HEIGHT_BIAS * agl))]) ** 2
        self._velocity_cov = standing_cov() if attitude.stands else unknown_cov()
        self._felt = self._stood_at = None
        node = self.graph.start(
            t_s,
            NodeState(pose, np.zeros(4), np.zeros(6)),
            world_to_tangent(cov_world, r_w_c),
            bias_cov,
            self._velocity_cov,
            self._attitude(attitude, r_w_c),
        )
        self._node_of[frame_id] = node
        self._last = self._placed(frame_id, t_s, node)
        return self._last

    def _by_odometry(self, odometry: Odometry, attitude: Attitude) -> tuple[int, RelativePose] | None:
        """The keyframe's node and the motion since, when odometry has both."""
        if odometry.verdict is not Verdict.ACCEPTED or not odometry.pairs:
            return None
        parent = self._node_of.get(odometry.keyframe_id)
        if parent is None or not self.graph.holds(parent):
            return None
        state = self.graph.state(parent)
        r_w_kf = state.pose.rotation().matrix()
        height_sigma = float(np.sqrt(r_w_kf[2] @ self._cov_of[parent][3:, 3:] @ r_w_kf[2]))
        p = state.pose.translation()
        height = float(p[2]) - self.terrain.below(p)
        if height < 2.0:
            return None
        r_w_k = self._expected_rotation(attitude, state.bias, r_w_kf)
        tilt_sigma = np.radians(max(self.origin.attitude_sigma_deg, 1.0))
        if attitude.pitch_rad is None or attitude.roll_rad is None:
            r_w_k, tilt_sigma = r_w_kf, UNKNOWN_ATTITUDE_RAD  # nobody knows of a change of tilt
        share = min(1.0, odometry.inliers / max(odometry.tracked, 1))
        ground = self.terrain.seen_from(height, height_sigma, share)
        motion = relative_pose(np.array(odometry.pairs), odometry.sigma_norm, r_w_kf, r_w_k, tilt_sigma, ground)
        if motion is None:
            return None
        dt_s = max(odometry.t_ns * 1e-9 - self.graph.time_of(parent), 1e-3)
        possible = float(np.linalg.norm(motion.p_m)) <= MAX_SPEED_MPS * dt_s + height
        return (parent, motion) if possible else None

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
        r_w_c = self._expected_rotation(attitude, state.bias, r_parent)
        turn = UNKNOWN_ATTITUDE_RAD + (0.3 if attitude.yaw_rad is None else np.radians(self.origin.yaw_sigma_deg))
        cov = np.diag([turn, turn, turn, 0.0, 0.0, 0.0]) ** 2
        cov[3:, 3:] = r_w_c.T @ spread[:3, :3] @ r_w_c
        step = np.zeros(3) if stands else led_to_m - state.pose.translation()
        return parent, RelativePose(r_parent.T @ r_w_c, r_parent.T @ step, cov)

    def _placed(self, frame_id: int, t_s: float, node: int) -> Placed:
        if self.mode is CovarianceMode.MARGINALS and node == self.graph.newest:
            self._velocity_cov = self.graph.velocity_covariance(node)
        state = self.graph.state(node)
        velocity = state.velocity[:3]
        return Placed(frame_id, t_s, state.pose, self._covariance(node), velocity, self._velocity_cov[:3, :3], node)

    def _covariance(self, node: int) -> np.ndarray:
        """Of C_node, 6x6, tangent order: the smoother's marginal, or under thermal throttle what the chain of motions
        and the inliers of the map fixes gave (O(inliers), ON-2)."""
        if self.mode is CovarianceMode.MARGINALS or node not in self._cov_of:
            self._cov_of[node] = self.graph.covariance(node)
        return self._cov_of[node]

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
        self._tilt_said = attitude.pitch_rad is not None and attitude.roll_rad is not None
        if self._tilt_said:
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
        node = self._node_of.get(match.frame_id)
        if node is not None and not self.graph.holds(node):
            node = None
        self.terrain.hear(match, None if node is None else self.graph.state(node).pose.translation())
        lost = self.doubt.hear(match)
        if lost:
            return FixResult(Verdict.LOST, None, lost)
        if match.verdict is not Verdict.ACCEPTED:
            return FixResult(match.verdict, None)
        if not determined(match):
            return FixResult(Verdict.DEGENERATE, None)
        if node is None:
            return FixResult(Verdict.STALE, None)
        measured, cov = measured_pose(match, self.terrain.ground_m)
        r_w_c = measured.rotation().matrix()
        height = max(float(measured.translation()[2]) - self.terrain.ground_m, 1.0)
        if match.found:  # by a search, over several frames: it outweighs whatever the graph believes
            self.rival = Rival()
            return self._restart(match, node, measured, cov, "found")
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
            if not match.coarse:
                self.rival.fade(moved / height)
        self.graph.add_pose(node, measured, cov / new)
        if self.mode is CovarianceMode.JACOBIAN:
            self._cov_of[node] = np.linalg.inv(np.linalg.inv(self._cov_of[node]) + np.linalg.inv(cov / new))
        self._accepted(match, self.graph.time_of(node), here)
        return FixResult(Verdict.ACCEPTED, d2, f"new ground {new:.2f}")

    def _accepted(self, match: MapMatch, t_s: float, here: np.ndarray) -> None:
        self._fixed_at_m = here
        self.doubt.start_m = 0.0
        self.map_sigma_m = match.map_sigma_m
        self.last_fix_t_s = t_s
        assert self._last is not None
        self._last = self._placed(self._last.frame_id, self._last.t_s, self.graph.newest)

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
            self.rival.disagreed(refused.offsets_m)
            height = float(measured.translation()[2]) - self.terrain.ground_m
            far = float(np.hypot(*(here - refused.began_at_m))) > RECOVER_OVER * height
            if len(refused.offsets_m) >= RECOVER_AFTER and far and match.mode_mass >= RECOVER_MASS:
                self.rival.left(offset)
                return self._restart(match, node, measured, cov, "restarted")
        return FixResult(Verdict.INNOVATION, d2, f"{float(np.hypot(*offset)):.0f} m from the estimate")

    def _restart(self, match: MapMatch, node: int, measured: gtsam.Pose3, cov: np.ndarray, how: str) -> FixResult:
        """The graph begins anew: where the map says that the camera was, and since a match comes late, from there by
        what the graph has of the way to the newest frame."""
        was, now = self.graph.state(node), self.graph.state(self.graph.newest)
        fixed_s, now_s = self.graph.time_of(node), self.graph.time_of(self.graph.newest)
        offset = (measured.translation() - was.pose.translation())[:2]
        onward = was.pose.between(now.pose)
        moved = onward.inverse().AdjointMap()
        cov = RESTART_INFLATION * moved @ cov @ moved.T
        velocity_sigma = float(np.sqrt(np.linalg.eigvalsh(self._velocity_cov[:3, :3])[-1]))
        way_m = float(np.linalg.norm(onward.translation()))
        cov[3:, 3:] += np.hypot(STEP_SHARE * way_m, velocity_sigma * (now_s - fixed_s)) ** 2 * np.eye(3)
        bias = now.bias.copy()
        if match.found:  # the ground there lies at another height than the one that was assumed
            bias[3] -= float(measured.translation()[2] - was.pose.translation()[2])
        bias_cov = self.graph.bias_covariance(self.graph.newest)
        self._velocity_cov = RESTART_INFLATION * self.graph.velocity_covariance(self.graph.newest)
        self.graph.start(
            now_s, NodeState(measured.compose(onward), bias, now.velocity), cov, bias_cov, self._velocity_cov
        )
        assert self._last is not None
        self._felt = self._stood_at = None
        self._node_of[self._last.frame_id] = self.graph.newest
        self._cov_of.clear()
        self._refused = None
        self.doubt = Doubt()
        self._accepted(match, fixed_s, measured.translation()[:2])
        return FixResult(Verdict.ACCEPTED, None, f"{how} {float(np.hypot(*offset)):.0f} m away")

    def _note_rival(self, frame_id: int) -> None:
        """For the refinement, which cannot tell a wrong stretch from a right one either."""
        if self.rival.probability > 0.0:
            self._torn[frame_id] = self.rival.spread_m2()

    @property
    def last(self) -> Placed | None:
        """The newest frame, with all that is known of it by now."""
        return self._last

    @property
    def body_sigma_rad(self) -> float:
        """Of the body in the camera: an attitude that is off for long cannot be told from a mount that is."""
        said = self._tilt_said
        return float(np.radians(self.origin.attitude_sigma_deg if said else self.origin.camera.mount_tolerance_deg))

    def body(self, placed: Placed) -> np.ndarray:
        """R_w_b (3x3) of a placed frame, with the mount as it was learnt."""
        bias = self.graph.state(placed.node).bias
        r_b_c = self._r_b_c @ exp_so3(np.array([bias[0], bias[1], 0.0]))
        return np.asarray(placed.pose.rotation().matrix() @ r_b_c.T)

    def refine(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """frame -> position (3,) and its covariance (3x3), after a batch optimisation of the whole flight."""
        refined = self.graph.refine()
        result = {}
        for frame, node in self._node_of.items():
            if node in refined:
                pose, cov = refined[node]
                if frame in self._torn:
                    cov = cov.copy()
                    cov[:2, :2] += self._torn[frame]
                result[frame] = (np.asarray(pose.translation()), cov)
        return result


def _compose_cov(cov_parent: np.ndarray, motion: RelativePose) -> np.ndarray:
    """Covariance of parent * motion, tangent order, first order."""
    adjoint = gtsam.Pose3(gtsam.Rot3.ClosestTo(motion.r), motion.p_m).inverse().AdjointMap()
    return adjoint @ cov_parent @ adjoint.T + motion.cov
