"""How a flight began, for as long as that matters: where, with which words of the autopilot, and its take-off."""

import math
from dataclasses import dataclass

import numpy as np

from terrafix.estimator.graph.pose_graph import walk_sigmas
from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.models.motion_model import MotionIncrement
from terrafix.estimator.models.terrain import Terrain
from terrafix.estimator.prior import NavPrior
from terrafix.messages import Origin

FLYING_M = 20.0  # above the ground: a vehicle that is seen to move there has taken off

Slow = tuple[np.ndarray, np.ndarray]  # slow errors (6,), covariance (6x6)


@dataclass(frozen=True)
class InitialPose:
    """Where a graph begins: ``at_m`` (2,) east and north, known to ``sigma_m``. ``way_m`` (2,), ``way_sigma_m``: the
    part of it that was flown since the flight was known last. ``slow``: what was learnt before; None: nothing."""

    at_m: np.ndarray
    sigma_m: float
    way_m: np.ndarray
    way_sigma_m: float
    slow: Slow | None


class Initializer:
    """``known``: where the flight was known last, if that is not its start now: this process was started in flight.

    ``has_heading``, ``has_height``: the autopilot said it. ``t_s``: when the flight was known last."""

    def __init__(self, origin: Origin, known: NavPrior | None) -> None:
        self._origin, self._known = origin, known
        self.has_heading = self.has_height = False
        self.t_s = 0.0

    def is_told_more(self, attitude: Attitude) -> bool:
        """The first words of the autopilot came after the first frame."""
        heading = not self.has_heading and attitude.yaw_rad is not None
        return heading or (not self.has_height and attitude.agl_m is not None)

    def begun(self, t_s: float, attitude: Attitude, terrain: Terrain) -> InitialPose:
        """Where the flight was known last, and has flown on since."""
        self.has_heading, self.has_height = attitude.yaw_rad is not None, attitude.agl_m is not None
        self._known = known = self._known or NavPrior.start(self._origin, t_s)
        self.t_s = known.t_s
        if known.match is not None:
            terrain.hear(known.match, np.array([known.match.mode_e_m, known.match.mode_n_m]))
        way_m, way_sigma_m = known.later(t_s, attitude.yaw_rad)
        sigma_m = float(np.hypot(known.sigma_m, way_sigma_m))
        rise_m = terrain.rise_sigma_m(float(np.hypot(*way_m)) + way_sigma_m)
        slow = _slow_now(known, t_s, attitude, rise_m)
        return InitialPose(known.at_m + way_m, sigma_m, way_m, way_sigma_m, slow)


def _slow_now(known: NavPrior, t_s: float, attitude: Attitude, rise_sigma_m: float) -> Slow | None:
    """What was learnt before this process was started holds on, but for what has changed since. None: nothing was, or
    a word is missing now to which it belongs."""
    learnt = known.learnt
    if learnt is None or known.yaw_rad is None or attitude.yaw_rad is None or attitude.agl_m is None:
        return None
    turned_rad = math.remainder(attitude.yaw_rad - known.yaw_rad, math.tau)
    sigmas = walk_sigmas(max(t_s - learnt.t_s, 0.0), turned_rad, rise_sigma_m)
    return learnt.error, learnt.cov + np.diag(sigmas**2)


class TakeOff:
    """``launching``: the vehicle stood, and was not seen to fly since."""

    def __init__(self) -> None:
        self.launching = False
        self._blind = False  # ... nor felt

    def stood(self) -> None:
        self.launching = True

    def was_blind(self, way: MotionIncrement | None, seen_at_m: float | None) -> bool:
        """It is seen to fly after a take-off that nothing measured. ``way`` to the newest frame, None: it stands;
        ``seen_at_m``: its height above the ground, None: it was not seen."""
        if not self.launching or way is None:
            return False
        self._blind = self._blind or not way.inertial
        if seen_at_m is None or seen_at_m < FLYING_M:
            return False
        blind, self.launching, self._blind = self._blind, False, False
        return blind
