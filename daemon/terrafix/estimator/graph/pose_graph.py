"""The one graph: iSAM2 in a fixed lag of nodes; what leaves it is kept for the refinement after landing
(marginalized.py).

A node is a frame: C_k, the camera pose in the world, B_k, the slow errors, and V_k, the velocity (see
custom_factors.py)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, V

from terrafix.estimator.factors.custom_factors import (
    BIAS_SIZE,
    HEIGHT,
    map_fix_factor,
    motion_factor,
    plane_two_view_factor,
    robust,
)
from terrafix.estimator.factors.three_view import ThreeViewConstraint, three_view_factor
from terrafix.estimator.graph.fixed_lag import FixedLagSmoother
from terrafix.estimator.graph.marginalized import MarginalizedHistory
from terrafix.estimator.measurements.airspeed import AirspeedObservation, air_factor
from terrafix.estimator.measurements.ekf_dead_reckoning import PropagatedState
from terrafix.estimator.models.lens_prior import LENS_SIGMA
from terrafix.estimator.models.motion_model import V_SIZE, MotionIncrement, standing_cov, unknown_cov
from terrafix.estimator.models.plane_motion import RelativePose

LEFT_TO_LEG_M = 1e4  # 1-sigma of a guessed way, which its leg says already
UNTOLD = 1e8  # variance of what a factor says nothing of
# Random walk of the slow errors per square root of a second: mount tilt (a gimbal creeps), heading (a gyro drifts),
# barometer (a front brings 1 hPa, 8 m, in an hour), lens (it warms up: a tenth of its error in ten minutes), scale
# (air warms up by 4 degrees an hour, 1.5 %). A looser barometer lets minutes of dead reckoning carry the height off.
WALK_SIGMAS = np.array([np.radians(0.15), np.radians(0.15), np.radians(0.3), 0.15, 2e-5, 2.5e-4])
COMPASS_BY_TURN_RAD = np.radians(2.5)  # ... and of the compass per square root of a radian turned: iron on board


def walk_sigmas(dt_s: float, turned_rad: float, rise_sigma_m: float) -> np.ndarray:
    """1-sigma (6,) of what the slow errors have changed by. ``rise_sigma_m``: of the ground, when no map tells."""
    sigmas = WALK_SIGMAS * np.sqrt(dt_s)
    sigmas[2] = np.hypot(sigmas[2], COMPASS_BY_TURN_RAD * np.sqrt(abs(turned_rad)))
    sigmas[HEIGHT] = np.hypot(sigmas[HEIGHT], rise_sigma_m)
    return sigmas


@dataclass(frozen=True)
class NodeState:
    pose: gtsam.Pose3
    bias: np.ndarray  # (6,) B_k
    velocity: np.ndarray  # (8,) V_k

    @property
    def up_by_barometer_m(self) -> float:
        """AMSL as seen heights have it, where no map tells the ground and C is above whatever is seen."""
        return float(self.pose.translation()[2] + self.bias[HEIGHT])


class PoseGraph:
    def __init__(self, past: MarginalizedHistory | None = None) -> None:
        self._past = past or MarginalizedHistory()
        self._kept = gtsam.Values()  # the window, as it was before the last nodes came
        self.rebuilds = 0
        self._smoother = FixedLagSmoother()
        self._states: dict[int, NodeState] = {}  # asked for since the last update
        self._marginals: dict[int, np.ndarray] = {}  # the same, by key
        self._times: dict[int, float] = {}  # nodes in the window: measurement time, s
        self._next = 0

    @property
    def newest(self) -> int:
        return self._next - 1

    @property
    def next_node(self) -> int:
        return self._next

    def holds(self, node: int) -> bool:
        return node in self._times

    def state(self, node: int) -> NodeState:
        """Newest estimate of a node in the window."""
        if node not in self._states:
            pose = self._smoother.pose(node)
            # Rounding makes rotations drift off SO(3), and every frame builds on the last one: the drift would double.
            upright = gtsam.Pose3(gtsam.Rot3.ClosestTo(pose.rotation().matrix()), pose.translation())
            bias, velocity = (self._smoother.vector(key(node)) for key in (B, V))
            self._states[node] = NodeState(upright, bias, velocity)
        return self._states[node]

    def covariance(self, node: int) -> np.ndarray:
        """Marginal of C_node, 6x6, tangent order (rotation, translation); asked of the smoother itself."""
        return self._marginal(C(node))

    def velocity_covariance(self, node: int) -> np.ndarray:
        """Marginal of V_node, 8x8."""
        return self._marginal(V(node))

    def bias_covariance(self, node: int) -> np.ndarray:
        return self._marginal(B(node))

    def _marginal(self, key: int) -> np.ndarray:
        if key not in self._marginals:
            self._marginals[key] = self._smoother.marginal(key)
        return self._marginals[key].copy()

    def time_of(self, node: int) -> float:
        """Measurement time of a node in the window, s."""
        return self._times[node]

    def start(
        self,
        t_s: float,
        state: NodeState,
        cov: np.ndarray,
        bias_cov: np.ndarray,
        velocity_cov: np.ndarray,
        attitude: gtsam.CustomFactor | None = None,
        held: np.ndarray | None = None,
    ) -> int:
        """First node, or the first after a loss: priors on C (tangent covariance 6x6), B (6x6) and V (8x8).
        ``held`` stands for that of C here, when part of the pose is not known but chosen.

        The past stays as it was estimated."""
        node = self._next
        self._leave_all()
        self._renew()
        factors = _priors(node, state, cov if held is None else held, bias_cov, velocity_cov)
        if attitude is not None:
            factors.add(attitude)
        self._insert(t_s, state, factors)
        return node

    def extend(
        self,
        t_s: float,
        state: NodeState,
        parent: int,
        motion: RelativePose,
        leg: MotionIncrement | None,
        attitude: gtsam.CustomFactor | None,
        rise_sigma_m: float = 0.0,
        three: tuple[int, ThreeViewConstraint] | None = None,
    ) -> int:
        """A node that follows ``parent`` (in the window) by ``motion``, and the newest by ``leg``; None: it stands.
        ``rise_sigma_m``: of the ground since the newest, when no map tells. ``three``: what an earlier node, ``parent``
        and this one saw together."""
        node = self._next
        newest = self.newest
        dt_s = max(t_s - self._times[newest], 1e-3)
        factors = gtsam.NonlinearFactorGraph()
        if motion.seen is None:
            between = gtsam.Pose3(gtsam.Rot3.ClosestTo(motion.r), motion.p_m)
            cov = motion.cov.copy()
            if leg is not None:
                cov[3:, 3:] += LEFT_TO_LEG_M**2 * np.eye(3)
            factors.add(gtsam.BetweenFactorPose3(C(parent), C(node), between, robust(cov)))
        else:
            seen, keyframe = motion.seen, self.state(parent).pose
            factors.add(
                plane_two_view_factor(
                    C(parent),
                    C(node),
                    B(node),
                    keyframe,
                    state.pose,
                    seen.pairs,
                    seen.sigma,
                    seen.ground,
                    B(parent),
                    seen.lens,
                )
            )
        if leg is not None:
            factors.add(motion_factor((C(newest), V(newest)), (C(node), V(node)), (B(newest), B(node)), leg))
        else:
            standing = gtsam.noiseModel.Gaussian.Covariance(standing_cov())
            factors.add(gtsam.PriorFactorVector(V(node), np.zeros(V_SIZE), standing))
        turned = state.pose.rotation().compose(self.state(newest).pose.rotation().inverse())
        sigmas = walk_sigmas(dt_s, float(gtsam.Rot3.Logmap(turned)[2]), rise_sigma_m)
        walk = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        factors.add(gtsam.BetweenFactorVector(B(newest), B(node), np.zeros(BIAS_SIZE), walk))
        if attitude is not None:
            factors.add(attitude)
        if three is not None and three[0] not in self._smoother.leaving(node):
            first, middle, last = ((C(n), B(n)) for n in (three[0], parent, node))
            factors.add(three_view_factor((first, middle, last), three[1], rises=rise_sigma_m > 0.0))
        self._insert(t_s, state, factors)
        return node

    def add_pose(
        self, node: int, pose: gtsam.Pose3, cov: np.ndarray, by_lens: np.ndarray | None = None, lens: float = 0.0
    ) -> None:
        """A map fix of a node in the window: camera pose with its covariance (tangent order), seen through ``lens``,
        and what one of more bend would have moved it by."""
        if by_lens is None:
            self._join(gtsam.PriorFactorPose3(C(node), pose, robust(cov)))
        else:
            self._join(map_fix_factor(C(node), B(node), pose, cov, by_lens, lens))

    def add_motion(self, node: int, carried: PropagatedState) -> None:
        """Where a node in the window was led to, and how fast it was then."""
        wide = np.diag([UNTOLD] * V_SIZE)
        wide[:3, :3] = carried.velocity_cov
        level = np.diag([UNTOLD] * 3)
        level[:2, :2] = carried.cov_m2
        gaussian = gtsam.noiseModel.Gaussian.Covariance
        at_m, velocity = np.array([*carried.at_m, 0.0]), np.array([*carried.velocity_mps, *[0.0] * (V_SIZE - 3)])
        self._join(
            gtsam.GPSFactor(C(node), at_m, gaussian(level)), gtsam.PriorFactorVector(V(node), velocity, gaussian(wide))
        )

    def add_air(self, node: int, air: AirspeedObservation, cov: np.ndarray) -> None:
        """The velocity of a node in the window, by what flows past it; ``cov`` (2, 2)."""
        self._join(air_factor(V(node), B(node), air, cov))

    def _join(self, *new: gtsam.NonlinearFactor) -> None:
        """Of nodes in the window."""
        factors = gtsam.NonlinearFactorGraph()
        for factor in new:
            factors.add(factor)
        self._past.add(factors)
        self._update(partial(self._smoother.add, factors))

    def keep(self, node: int) -> None:
        """Holds a node of the window in it for another full lag."""
        self._smoother.keep(node)

    def next_keys(self) -> tuple[int, int]:
        return C(self._next), B(self._next)

    def refine(self) -> tuple[np.ndarray, np.ndarray]:
        """After landing: positions (N, 3) of all nodes by all that was measured, covariances (N, 3, 3), world axes;
        nan where that is indeterminate."""
        self._leave_all()
        return self._past.refine()

    def _insert(self, t_s: float, state: NodeState, factors: gtsam.NonlinearFactorGraph) -> None:
        node = self._next
        leaving = self._smoother.leaving(node)
        if leaving:
            self._kept = self._smoother.estimate()
            self._past.leave(leaving, self._smoother.linear_around())
        else:
            self._past.tidy()
        values = _values(node, state)
        self._kept.insert(values)
        self._next += 1
        self._times[node] = t_s
        for n in leaving:
            del self._times[n]
        if not any({C(node), B(node)} <= set(factors.at(i).keys()) for i in range(factors.size())):
            factors.add(_tie(node))
        self._past.add(factors)
        self._update(partial(self._smoother.insert, node, factors, values))

    def _update(self, work: Callable[[], None]) -> None:
        self._states.clear()
        self._marginals.clear()
        try:
            work()
            healthy = bool(np.isfinite(self.state(self.newest).pose.matrix()).all())
        # How GTSAM, and a factor, say that a system is indeterminate; or that the tree has lost a variable.
        except (RuntimeError, OverflowError, ValueError, IndexError):
            healthy = False
        if not healthy:
            self._rebuild()

    def _rebuild(self) -> None:
        """From the last good estimate, with little confidence."""
        self.rebuilds += 1
        node = self.newest
        state = NodeState(self._kept.atPose3(C(node)), self._kept.atVector(B(node)), self._kept.atVector(V(node)))
        self._past.leave([n for n in self._times if n != node], self._kept)
        self._past.begin(node)
        self._renew()
        self._times = {node: self._times[node]}
        wide = np.array([0.1, 0.1, 0.2, 50.0, 50.0, 20.0])
        slow = np.array([0.1, 0.1, 0.1, 5.0, LENS_SIGMA, 0.1])
        factors = _priors(node, state, np.diag(wide**2), np.diag(slow**2), unknown_cov())
        self._past.add(factors)
        self._smoother.insert(node, factors, _values(node, state))

    def _renew(self) -> None:
        self._smoother = FixedLagSmoother()
        self._states.clear()
        self._marginals.clear()

    def _leave_all(self) -> None:
        """The window becomes the past."""
        if self._times:
            self._past.leave(list(self._times), self._smoother.estimate())
        self._past.begin(self._next)
        self._times.clear()


def _tie(node: int) -> gtsam.LinearContainerFactor:
    """Of C and B, and says nothing. ISAM2.marginalizeLeaves forgets a variable that leaves together with one that is
    above it in the tree, if nothing ties the two, and raises (GTSAM 4.3: it climbs to the clique of the latter, and
    takes out only what is below that by name). B of a node that begins a graph may be such a one."""
    nothing = np.zeros((1, 6))
    return gtsam.LinearContainerFactor(
        gtsam.JacobianFactor(C(node), nothing, B(node), nothing, np.zeros(1), gtsam.noiseModel.Unit.Create(1))
    )


def _priors(
    node: int, state: NodeState, cov: np.ndarray, bias_cov: np.ndarray, velocity_cov: np.ndarray
) -> gtsam.NonlinearFactorGraph:
    """``cov`` 6x6, tangent order; ``bias_cov`` 6x6; ``velocity_cov`` 8x8."""
    gaussian = gtsam.noiseModel.Gaussian.Covariance
    factors = gtsam.NonlinearFactorGraph()
    factors.add(gtsam.PriorFactorPose3(C(node), state.pose, gaussian(cov)))
    factors.add(gtsam.PriorFactorVector(B(node), state.bias, gaussian(bias_cov)))
    factors.add(gtsam.PriorFactorVector(V(node), state.velocity, gaussian(velocity_cov)))
    return factors


def _values(node: int, state: NodeState) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(C(node), state.pose)
    values.insert(B(node), state.bias)
    values.insert(V(node), state.velocity)
    return values
