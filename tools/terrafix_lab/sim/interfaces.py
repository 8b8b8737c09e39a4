"""Data types shared by the parts of a simulated flight: true state, sensor readings, navigation. One local frame per
flight.

World frame w: east, north, up of the flight's LocalFrame; "up" is metres AMSL. Body frame b: forward, right, down.
Angles in radians, yaw clockwise from true north; seconds count from the start of the flight.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from terrafix.core.geodesy import rot_w_b
from terrafix.messages import Quat


@dataclass(frozen=True)
class State:
    """True state of the vehicle at one time."""

    t_s: float
    p_b_in_w_m: np.ndarray  # (3,)
    velocity_enu_mps: np.ndarray  # (3,)
    yaw_rad: float
    pitch_rad: float
    roll_rad: float
    agl_m: float  # above the ground vertically below
    rates_b_radps: np.ndarray  # (3,) angular velocity of the body against the world, in b
    force_b_mps2: np.ndarray  # (3,) specific force in b, the output of an error-free accelerometer
    airspeed_mps: float

    def r_w_b(self) -> np.ndarray:
        """R_w_b (3x3)."""
        return rot_w_b(self.yaw_rad, self.pitch_rad, self.roll_rad)


@dataclass(frozen=True)
class Navigation:
    """The autopilot's navigation solution, which it steers by."""

    p_b_in_w_m: np.ndarray  # (3,)
    velocity_enu_mps: np.ndarray  # (3,)
    yaw_rad: float
    pitch_rad: float
    roll_rad: float
    airspeed_mps: float


def navigation_of(state: State) -> Navigation:
    """Returns an error-free navigation solution."""
    return Navigation(
        state.p_b_in_w_m, state.velocity_enu_mps, state.yaw_rad, state.pitch_rad, state.roll_rad, state.airspeed_mps
    )


@dataclass(frozen=True)
class GnssFix:
    """A receiver's fix; with ``fix_type`` below 3 the other fields are invalid."""

    fix_type: int
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float
    velocity_ned_mps: tuple[float, float, float]
    horizontal_m: float  # accuracies as reported by the receiver, 1-sigma
    vertical_m: float
    speed_mps: float
    satellites: int
    hdop: float


@dataclass(frozen=True)
class Readings:
    """Sensor readings at ``t_s``; None for a sensor without a new sample."""

    t_s: float
    gyro_b_radps: np.ndarray  # (3,)
    accel_b_mps2: np.ndarray  # (3,)
    yaw_rad: float  # compass, true north as the autopilot computes it
    pitch_rad: float  # attitude of the autopilot's filter
    roll_rad: float
    baro_amsl_m: float
    airspeed_mps: float | None
    gnss: GnssFix | None
    gimbal: Quat | None = None  # attitude that a gimbal reports, of its axes into north, east, down


class Vehicle(Protocol):
    """A vehicle that flies its mission on a given navigation solution."""

    @property
    def state(self) -> State:
        """Returns the true state now."""

    def step(self, dt_s: float, navigation: Navigation | None) -> State:
        """Advances by ``dt_s``. ``navigation`` None: it steers by the truth."""


class Sensors(Protocol):
    """Errors are functions of seed and time: the same flight gives the same readings."""

    def read(self, state: State) -> Readings: ...
