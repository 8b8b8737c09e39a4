"""A stretch that nobody saw, as the autopilot's filter coasted through it: what an estimator knows after a restart.

The filter had a position until then, and its tilt and the bias of its accelerometers were known: what it lost in six
seconds (ArduPilot's plane, 36 times, half of them in a turn) is what the autopilot's own attitude is believed to be
off by."""

from dataclasses import dataclass, replace

import numpy as np

from terrafix.core.gate import GATE
from terrafix.core.geodesy import LocalFrame
from terrafix.estimator.models.motion_model import (
    STEADY_MPS2,
    V_SIZE,
    WorldAcceleration,
    integrate_motion,
    spread_after,
    unknown_cov,
)
from terrafix.messages import Coasted

BEFORE_S = 0.3  # by which a picture may be older than what leads it there: filters tell of themselves 3 times a second


@dataclass(frozen=True)
class PropagatedState:
    """At a frame: ``at_m`` (2,), ``velocity_mps`` (3,), each with its covariance."""

    at_m: np.ndarray
    cov_m2: np.ndarray
    velocity_mps: np.ndarray
    velocity_cov: np.ndarray

    def agrees_with(self, at_m: np.ndarray, cov_m2: np.ndarray) -> bool:
        """With a position (2,) that is known otherwise, to ``cov_m2`` (2, 2); one that jumped does not."""
        off_m = self.at_m - at_m
        return float(off_m @ np.linalg.solve(self.cov_m2 + cov_m2, off_m)) <= GATE[2]


@dataclass(frozen=True)
class DeadReckoning:
    """``t_s``: its end, ``at_m`` (2,): its beginning."""

    t_s: float
    at_m: np.ndarray
    said: Coasted

    @classmethod
    def of(cls, said: Coasted, frame: LocalFrame) -> "DeadReckoning":
        return cls(said.t_ns * 1e-9, np.array(frame.to_local(said.lat_deg, said.lon_deg)), said)

    def until(
        self,
        t_s: float,
        felt: WorldAcceleration | None,
        yaw_rad: float,
        heading_bias_rad: float,
        sigmas_rad: tuple[float, float],
    ) -> PropagatedState:
        """``felt``: between its end and ``t_s``, which may be before it. ``sigmas_rad``: of the attitude's tilt, in it
        and since."""
        said, yaws = self.said, (yaw_rad, yaw_rad)
        before = np.zeros(V_SIZE)
        before[:3] = said.velocity_enu_mps
        speed_mps = float(np.hypot(*before[:2]))
        cov = unknown_cov()
        cov[:3, :3] = said.velocity_sigma_mps**2 * np.eye(3)
        cov[6:, 6:] = 0.0  # the filter knows the bias of its accelerometers
        unknown = WorldAcceleration(np.array([0.0, said.coast_s]), np.zeros((2, 3)), np.array(yaws), 0.0)
        coast = integrate_motion(
            said.coast_s, unknown, yaws, heading_bias_rad, speed_mps, sigmas_rad[0], same_kind=False
        )
        coast = replace(coast, way_m=np.array([*said.way_m, 0.0]), gain_mps=np.array(said.gain_mps))
        spread = spread_after(coast, cov)
        p, v = coast.predicted(np.array([*self.at_m, 0.0]), before, heading_bias_rad)
        spread[9:, 9:] = STEADY_MPS2**2 * np.eye(2)
        dt_s = max(abs(t_s - self.t_s), 1e-3)
        since = integrate_motion(dt_s, felt, yaws, heading_bias_rad, speed_mps, sigmas_rad[1], same_kind=False)
        after = spread_after(since, spread[3:, 3:])
        both = since.reach_s * spread[:2, 3:5]  # what was wrong of the velocity by then goes on
        if t_s >= self.t_s:
            p, v = since.predicted(p, v, heading_bias_rad)
        else:
            way_m, gain = since.predicted(np.zeros(3), np.zeros(V_SIZE), heading_bias_rad)
            v = v - gain
            p, both = p - way_m - since.reach_s * v[:3], -both
        way_cov = spread[:2, :2] + both + both.T + after[:2, :2]
        return PropagatedState(p[:2], said.position_sigma_m**2 * np.eye(2) + way_cov, v[:3], after[3:6, 3:6])


class DeadReckoningBuffer:
    """What was said of it until the first picture that it leads."""

    def __init__(self) -> None:
        self._said: list[DeadReckoning] | None = []

    def add(self, coast: DeadReckoning) -> None:
        if self._said is not None:
            self._said.append(coast)

    def taken(self, t_s: float) -> DeadReckoning | None:
        """For a frame, once: the nearest, older rather than newer."""
        said = self._said or []
        until = [coast for coast in said if coast.t_s <= t_s]
        soon = [coast for coast in said if t_s < coast.t_s <= t_s + BEFORE_S]
        if not until and not soon:
            return None
        self._said = None
        return until[-1] if until else soon[0]
