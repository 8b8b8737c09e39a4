"""The autopilot's own dead reckoning through a restart of this estimator, as a measurement of position and velocity.

Its filter had our position until then, so that its tilt and the bias of its accelerometers were estimated: its error
after six seconds (ArduPilot plane, 36 times, half of them in a turn) is that of the attitude which the autopilot
reports."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, V

from terrafix.core.gate import GATE
from terrafix.core.geodesy import LocalFrame
from terrafix.core.pose import tangent_to_world
from terrafix.estimator.filter_state import FilterState
from terrafix.estimator.integrity.innovation import Innovation
from terrafix.estimator.measurements.aid_source import AidSample, AidSource
from terrafix.estimator.models.motion_model import (
    STEADY_ACCEL_SIGMA_MPS2,
    WorldAcceleration,
    integrate_motion,
    predict_covariance,
    unknown_motion_cov,
)
from terrafix.estimator.state import HEADING, MOTION_SIZE, VELOCITY
from terrafix.messages import EkfDeadReckoning, Verdict

UNCONSTRAINED = 1e8  # variance of what a factor does not constrain [spec: far beyond any state]
MAX_AHEAD_S = 0.3  # by which a frame may be older than the sample: filter status comes at 3 Hz [spec: link rates]


@dataclass(frozen=True)
class PropagatedState:
    """Position ``at_m`` (2,) and ``velocity_mps`` (3,), ENU, at the time of a frame, each with its covariance."""

    at_m: np.ndarray
    cov_m2: np.ndarray
    velocity_mps: np.ndarray
    velocity_cov: np.ndarray


@dataclass(frozen=True)
class DeadReckoningMeasurement:
    """Position and velocity of a frame by the autopilot's dead reckoning. A position that jumped is rejected."""

    propagated: PropagatedState
    name: str = "dead_reckoning"

    def innovation(self, state: FilterState, node: int) -> Innovation:
        pose = state.graph.state(node).pose
        cov = tangent_to_world(state.covariance(node), pose.rotation().matrix())
        residual = self.propagated.at_m - pose.translation()[:2]
        return Innovation(residual, self.propagated.cov_m2 + cov[:2, :2], GATE[2])

    def add_to(self, state: FilterState, node: int) -> None:
        propagated, gaussian = self.propagated, gtsam.noiseModel.Gaussian.Covariance
        velocity_cov = np.diag([UNCONSTRAINED] * MOTION_SIZE)
        velocity_cov[VELOCITY, VELOCITY] = propagated.velocity_cov
        position_cov = np.diag([UNCONSTRAINED] * 3)
        position_cov[:2, :2] = propagated.cov_m2
        at_m = np.array([*propagated.at_m, 0.0])
        velocity = np.array([*propagated.velocity_mps, *[0.0] * (MOTION_SIZE - 3)])
        state.add_factors(
            node,
            gtsam.GPSFactor(C(node), at_m, gaussian(position_cov)),
            gtsam.PriorFactorVector(V(node), velocity, gaussian(velocity_cov)),
        )


@dataclass(frozen=True)
class DeadReckoning:
    """Motion by the autopilot's own sensors up to ``t_s``, from ``at_m`` (2,): our last position with a 3D fix."""

    t_s: float
    at_m: np.ndarray
    sample: EkfDeadReckoning

    @classmethod
    def of(cls, sample: EkfDeadReckoning, frame: LocalFrame) -> "DeadReckoning":
        return cls(sample.t_ns * 1e-9, np.array(frame.to_local(sample.lat_deg, sample.lon_deg)), sample)

    def until(
        self,
        t_s: float,
        measured: WorldAcceleration | None,
        yaw_rad: float,
        heading_bias_rad: float,
        sigmas_rad: tuple[float, float],
    ) -> PropagatedState:
        """The state at ``t_s``, which may be before its end. ``measured``: acceleration between the two.
        ``sigmas_rad``: of the tilt, until its end and since."""
        sample, yaws = self.sample, (yaw_rad, yaw_rad)
        before = np.zeros(MOTION_SIZE)
        before[:3] = sample.velocity_enu_mps
        speed_mps = float(np.hypot(*before[:2]))
        cov = unknown_motion_cov()
        cov[:3, :3] = sample.velocity_sigma_mps**2 * np.eye(3)
        cov[6:, 6:] = 0.0  # the filter knows the bias of its accelerometers
        unknown = WorldAcceleration(np.array([0.0, sample.duration_s]), np.zeros((2, 3)), np.array(yaws), 0.0)
        coast = integrate_motion(
            sample.duration_s, unknown, yaws, heading_bias_rad, speed_mps, sigmas_rad[0], same_source=False
        )
        coast = replace(coast, delta_p_m=np.array([*sample.delta_p_m, 0.0]), delta_v_mps=np.array(sample.delta_v_mps))
        spread = predict_covariance(coast, cov)
        p, v = coast.predict(np.array([*self.at_m, 0.0]), before, heading_bias_rad)
        spread[9:, 9:] = STEADY_ACCEL_SIGMA_MPS2**2 * np.eye(2)
        dt_s = max(abs(t_s - self.t_s), 1e-3)
        since = integrate_motion(dt_s, measured, yaws, heading_bias_rad, speed_mps, sigmas_rad[1], same_source=False)
        after = predict_covariance(since, spread[3:, 3:])
        both = since.phi_pv_s * spread[:2, 3:5]  # the velocity error at its end continues
        if t_s >= self.t_s:
            p, v = since.predict(p, v, heading_bias_rad)
        else:
            way_m, gain = since.predict(np.zeros(3), np.zeros(MOTION_SIZE), heading_bias_rad)
            v = v - gain
            p, both = p - way_m - since.phi_pv_s * v[:3], -both
        way_cov = spread[:2, :2] + both + both.T + after[:2, :2]
        return PropagatedState(p[:2], sample.position_sigma_m**2 * np.eye(2) + way_cov, v[:3], after[3:6, 3:6])


class DeadReckoningBuffer:
    """Samples until the first frame that one of them places."""

    def __init__(self) -> None:
        self._samples: list[DeadReckoning] | None = []

    def add(self, sample: DeadReckoning) -> None:
        if self._samples is not None:
            self._samples.append(sample)

    def take(self, t_s: float) -> DeadReckoning | None:
        """The sample for a frame at ``t_s``, once: the nearest, an older one rather than a newer one; None: there is
        none."""
        samples = self._samples or []
        until = [coast for coast in samples if coast.t_s <= t_s]
        soon = [coast for coast in samples if t_s < coast.t_s <= t_s + MAX_AHEAD_S]
        if not until and not soon:
            return None
        self._samples = None
        return until[-1] if until else soon[0]


class DeadReckoningAid(AidSource):
    """The autopilot's dead reckoning at the first frame after a restart. ``placed_s``: time of that frame; 0: none."""

    def __init__(self, state: FilterState) -> None:
        super().__init__(state)
        self._buffer = DeadReckoningBuffer()
        self.placed_s = 0.0

    def add(self, sample: DeadReckoning) -> None:
        self._buffer.add(sample)

    def measurement(self, sample: AidSample) -> DeadReckoningMeasurement | None:
        state, attitude = self._state, sample.attitude
        reckoned = self._buffer.take(sample.t_s)
        if reckoned is None or attitude.of_vehicle.yaw_rad is None or attitude.stands or state.yaw_gauge is not None:
            return None
        tilt_rad = np.radians(state.origin.attitude_sigma_deg)
        tilts_rad = tilt_rad, float(np.hypot(tilt_rad, attitude.of_vehicle.righted_rad))
        since = sample.imu(*sorted((round(reckoned.t_s * 1e9), round(sample.t_s * 1e9))))
        heading_bias_rad = float(state.graph.state(sample.node).calibration[HEADING])
        at_frame = reckoned.until(sample.t_s, since, attitude.of_vehicle.yaw_rad, heading_bias_rad, tilts_rad)
        return DeadReckoningMeasurement(at_frame)

    def on_fused(self, sample: AidSample, verdict: Verdict) -> None:
        if verdict is Verdict.ACCEPTED:
            self.placed_s = sample.t_s
