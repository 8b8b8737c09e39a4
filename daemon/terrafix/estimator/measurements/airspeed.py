"""Wind estimator, and airspeed as a measurement of velocity where no image shows the ground.

While odometry gives the velocity, a Kalman filter estimates the wind, the scale of the airspeed sensor (air density: a
tenth at 2000 m; the position error of the pitot tube is of the same size) and the strength of gusts. Without odometry,
airspeed and heading give the velocity: its error grows with the change of the wind, while integrated acceleration
errors grow with the square of the time.

As in ArduPilot (NavEKF3, airspeed and sideslip fusion) a fixed wing is assumed to fly without sideslip. For a vehicle
that does not, the sideslip appears as gusts, and the measurement gets the weight of these."""

from dataclasses import dataclass

import numpy as np
from gtsam.symbol_shorthand import B, V

from terrafix.core.gate import GATE
from terrafix.estimator.factors.airspeed import airspeed_factor, heading_vector
from terrafix.estimator.filter_state import FilterState, FrameState
from terrafix.estimator.integrity.innovation import Innovation
from terrafix.estimator.measurements.aid_source import AidSample, AidSource
from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.state import HEADING, UP, NodeState
from terrafix.messages import Verdict

MIN_TAS_MPS = 8.0  # below stall speed, where a pitot tube reads noise [tuned]
WIND_SIGMA_MPS, AIRSPEED_SCALE_SIGMA = 15.0, 0.1  # 1-sigma of the prior [tuned]
# A fixed wing in 7 m/s of wind (thor_flight75: 329 s, 20 to 80 m above the ground): velocity less airspeed and wind
# scatters by 1.5 m/s along and 1.9 across, correlated over 4 s; the rest changes by 1.0 in half a minute.
GUST_MPS, GUST_S = 1.5, 5.0  # [measured: flight log thor_flight75]
MIN_GUST_MPS = 0.5  # [tuned]
WIND_WALK, SCALE_WALK = 0.2, 5e-4  # [m/s] and relative, per square root of a second [tuned]
GUST_AVERAGE_S = 60.0  # time constant of the estimated gust strength [tuned]
UPDATE_EVERY_S = 1.0  # [tuned]
MAX_UPDATE_SIGMA_MPS = 3.0  # 1-sigma of a velocity that updates the wind, and of a wind that updates gusts [tuned]
# of a predicted velocity: wind estimated on one heading is poorly known on the opposite one [tuned]
MAX_PREDICT_SIGMA_MPS = 8.0
MAX_TAS_CHANGE = 0.25  # relative, without odometry: autopilots hold airspeed, a tube that ices up does not [tuned]
FUSION_TIMEOUT_S = 5.0  # after which a sensor that contradicts odometry is estimated anew [tuned]


@dataclass(frozen=True)
class AirspeedObservation:
    """Velocity over ground (2,), east and north [m/s], by airspeed and wind. ``still_mps``: speed over ground in calm
    air along the heading; ``yaw_rad``: reported heading. Covariance terms (2, 2): ``common``, of the wind when odometry
    last gave it; ``changed``, by its random walk since; ``gust2`` (each axis), correlated over GUST_S."""

    still_mps: float
    yaw_rad: float
    wind_mps: np.ndarray
    common: np.ndarray
    changed: np.ndarray
    gust2: float

    def velocity(self, heading_bias_rad: float) -> np.ndarray:
        return self.wind_mps + self.still_mps * heading_vector(self.yaw_rad - heading_bias_rad)

    def cov(self, dt_s: float, unseen_s: float) -> np.ndarray:
        """(2, 2) for one of the frames that come every ``dt_s``, ``unseen_s`` after the last one with odometry.

        The smoother takes noise for white, so that correlated errors are inflated until the position error grows as it
        should: a gust counts once in GUST_S; a constant wind error P gives P t^2, a random walk q t gives q t^3 / 3."""
        gusts = self.gust2 * max(1.0, 2.0 * GUST_S / dt_s) * np.eye(2)
        frames = unseen_s / dt_s
        return gusts + max(1.0, 2.0 * frames) * self.common + max(1.0, frames) * self.changed


@dataclass(frozen=True)
class AirspeedMeasurement:
    """Airspeed at a frame without odometry, one of those that come every ``dt_s``, ``unseen_s`` after the last one with
    odometry."""

    observation: AirspeedObservation
    dt_s: float
    unseen_s: float
    name: str = "airspeed"

    def innovation(self, state: FilterState, node: int) -> Innovation:
        newest, observed = state.graph.state(node), self.observation
        residual = observed.velocity(float(newest.calibration[HEADING])) - newest.motion[:2]
        now = observed.common + observed.changed + observed.gust2 * np.eye(2)
        return Innovation(residual, now + state.covariances.motion(node)[:2, :2], GATE[2])

    def add_to(self, state: FilterState, node: int) -> None:
        cov = self.observation.cov(self.dt_s, self.unseen_s)
        air = self.observation
        state.add_factors(node, airspeed_factor(V(node), B(node), air.wind_mps, air.still_mps, air.yaw_rad, cov))


class WindEstimator:
    """``update`` with every velocity from odometry; ``predict`` without odometry."""

    def __init__(self) -> None:
        self._gust2 = GUST_MPS**2
        self._reset()

    def _reset(self) -> None:
        self._x = np.zeros(3)  # wind east, north [m/s], logarithm of true over read airspeed
        self._p = np.diag([WIND_SIGMA_MPS, WIND_SIGMA_MPS, AIRSPEED_SCALE_SIGMA]) ** 2
        self._t_s: float | None = None  # of x and P
        self._read_mps = 0.0  # airspeed at that time
        self._rejected_s: float | None = None  # since when the airspeed has contradicted odometry

    def update(
        self, t_s: float, velocity_mps: np.ndarray, cov: np.ndarray, read_mps: float | None, yaw_rad: float
    ) -> None:
        """``velocity_mps`` (3,) in the world with ``cov`` (3, 3); ``read_mps``: of the sensor; ``yaw_rad``: heading,
        its bias removed."""
        level = _horizontal(read_mps, velocity_mps[UP])
        since_s = None if self._t_s is None else t_s - self._t_s
        if read_mps is None or level is None or np.trace(cov[:2, :2]) > 2.0 * MAX_UPDATE_SIGMA_MPS**2:
            return
        if since_s is not None and since_s < UPDATE_EVERY_S:
            return
        dt_s = UPDATE_EVERY_S if since_s is None else since_s
        self._t_s, self._p = t_s, self._cov_at(t_s)
        still, h = self._observation(level, yaw_rad)
        off = velocity_mps[:2] - self._x[:2] - still
        known, seen = h @ self._p @ h.T, cov[:2, :2] + self._gust2 * np.eye(2)
        if float(off @ np.linalg.solve(known + seen, off)) > GATE[2]:
            self._rejected_s = t_s if self._rejected_s is None else self._rejected_s
            if t_s - self._rejected_s > FUSION_TIMEOUT_S:
                self._reset()
            return
        self._rejected_s, self._read_mps = None, read_mps
        if np.trace(known + cov[:2, :2]) < 2.0 * MAX_UPDATE_SIGMA_MPS**2:
            # The wind error is not subtracted: the wind was estimated from these gusts.
            now = max(float(off @ off - np.trace(cov[:2, :2])) / 2.0, 0.0)
            share = -np.expm1(-min(dt_s, GUST_S) / GUST_AVERAGE_S)
            self._gust2 = max(self._gust2 + share * (now - self._gust2), MIN_GUST_MPS**2)
        s = known + max(1.0, 2.0 * GUST_S / dt_s) * seen  # velocity error and gust are much the same a second later
        gain = np.linalg.solve(s, h @ self._p).T
        self._x = self._x + gain @ off
        self._p = self._p - gain @ h @ self._p

    def predict(
        self, t_s: float, read_mps: float | None, yaw_rad: float | None, up_mps: float
    ) -> AirspeedObservation | None:
        """``yaw_rad``: reported heading; ``up_mps``: climb rate. None: the wind is not known well enough."""
        level = _horizontal(read_mps, up_mps)
        if read_mps is None or level is None or yaw_rad is None or self._t_s is None or self._rejected_s is not None:
            return None
        if not abs(read_mps - self._read_mps) <= MAX_TAS_CHANGE * self._read_mps:
            return None
        _, h = self._observation(level, yaw_rad)
        common, changed = h @ self._p @ h.T, h @ (self._cov_at(t_s) - self._p) @ h.T
        if np.linalg.eigvalsh(common + changed)[-1] > MAX_PREDICT_SIGMA_MPS**2:
            return None
        return AirspeedObservation(
            level * float(np.exp(self._x[2])), yaw_rad, self._x[:2].copy(), common, changed, self._gust2
        )

    def reject(self, t_s: float) -> None:
        """The prediction was rejected by the gate: there is none until an update agrees with odometry."""
        self._rejected_s = t_s

    def _cov_at(self, t_s: float) -> np.ndarray:
        """P at ``t_s``."""
        dt_s = 0.0 if self._t_s is None else max(t_s - self._t_s, 0.0)
        return self._p + np.diag([WIND_WALK, WIND_WALK, SCALE_WALK]) ** 2 * dt_s

    def _observation(self, level_mps: float, yaw_rad: float) -> tuple[np.ndarray, np.ndarray]:
        """-> velocity through the air (2,), and the Jacobian (2, 3) of the velocity over ground by the filter state."""
        still = level_mps * float(np.exp(self._x[2])) * heading_vector(yaw_rad)
        return still, np.column_stack([np.eye(2), still])


def _horizontal(read_mps: float | None, up_mps: float) -> float | None:
    """Horizontal part of an airspeed; None: there is none, or it is too slow."""
    if read_mps is None or read_mps < MIN_TAS_MPS:
        return None
    return float(np.sqrt(max(read_mps**2 - up_mps**2, 0.25 * read_mps**2)))


class AirspeedAid(AidSource):
    """Airspeed at frames without odometry; frames with odometry update the wind."""

    leads_step = True

    def __init__(self, state: FilterState) -> None:
        super().__init__(state)
        self._wind = WindEstimator()

    def measurement(self, sample: AidSample) -> AirspeedMeasurement | None:
        state = self._state
        if sample.observed:
            return None
        observation = self._observation(sample.t_s, state.graph.state(sample.node), sample.attitude)
        if observation is None:
            return None
        return AirspeedMeasurement(observation, sample.dt_s, sample.t_s - state.last_fused_s)

    def on_fused(self, sample: AidSample, verdict: Verdict) -> None:
        if verdict is not Verdict.ACCEPTED:
            self._wind.reject(sample.t_s)

    def after_frame(self, frame: FrameState, attitude: Attitude) -> None:
        if attitude.of_vehicle.yaw_rad is None or attitude.stands or self._state.yaw_gauge is not None:
            return
        yaw_rad = attitude.of_vehicle.yaw_rad - float(self._state.graph.state(frame.node).calibration[HEADING])
        self._wind.update(frame.t_s, frame.velocity_mps, frame.velocity_cov, attitude.airspeed_mps, yaw_rad)

    def observes_velocity(self, t_s: float, node: NodeState, attitude: Attitude) -> bool:
        return self._observation(t_s, node, attitude) is not None

    def _observation(self, t_s: float, node: NodeState, attitude: Attitude) -> AirspeedObservation | None:
        if self._state.yaw_gauge is not None:
            return None
        return self._wind.predict(t_s, attitude.airspeed_mps, attitude.of_vehicle.yaw_rad, float(node.motion[UP]))
