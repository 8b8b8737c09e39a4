"""What the parts of a simulated flight say to each other: truth, readings, beliefs. One flight, one local frame.

World frame w: east, north, up of the flight's LocalFrame; "up" is metres AMSL. Body frame b: forward, right, down.
Angles in radians, yaw clockwise from true north; seconds count from the start of the flight."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from terrafix.core.geodesy import rot_w_b


@dataclass(frozen=True)
class State:
    """The truth about the vehicle at one moment."""

    t_s: float
    p_b_in_w_m: np.ndarray  # (3,)
    velocity_enu_mps: np.ndarray  # (3,)
    yaw_rad: float
    pitch_rad: float
    roll_rad: float
    agl_m: float  # above the ground straight below
    rates_b_radps: np.ndarray  # (3,) angular velocity of the body against the world, in b
    force_b_mps2: np.ndarray  # (3,) specific force in b: what an accelerometer without error shows
    airspeed_mps: float

    def r_w_b(self) -> np.ndarray:
        """R_w_b (3x3)."""
        return rot_w_b(self.yaw_rad, self.pitch_rad, self.roll_rad)


@dataclass(frozen=True)
class Navigation:
    """What the autopilot believes of itself and steers by."""

    p_b_in_w_m: np.ndarray  # (3,)
    velocity_enu_mps: np.ndarray  # (3,)
    yaw_rad: float
    pitch_rad: float
    roll_rad: float
    airspeed_mps: float


def navigation_of(state: State) -> Navigation:
    """What an autopilot believes that knows the truth."""
    return Navigation(
        state.p_b_in_w_m, state.velocity_enu_mps, state.yaw_rad, state.pitch_rad, state.roll_rad, state.airspeed_mps
    )


@dataclass(frozen=True)
class GnssFix:
    """A receiver's fix; with ``fix_type`` below 3 the rest means nothing."""

    fix_type: int
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float
    velocity_ned_mps: tuple[float, float, float]
    horizontal_m: float  # accuracies as the receiver claims them, 1-sigma
    vertical_m: float
    speed_mps: float
    satellites: int
    hdop: float


@dataclass(frozen=True)
class Readings:
    """What the sensors of the vehicle show at ``t_s``; None where that sensor has nothing new at this moment."""

    t_s: float
    gyro_b_radps: np.ndarray  # (3,)
    accel_b_mps2: np.ndarray  # (3,)
    yaw_rad: float  # compass, true north as the autopilot computes it
    pitch_rad: float  # attitude as the autopilot's filter has it
    roll_rad: float
    baro_amsl_m: float
    airspeed_mps: float | None
    range_m: float | None
    gnss: GnssFix | None


class Vehicle(Protocol):
    """A vehicle that flies its mission on what it is told."""

    def step(self, dt_s: float, navigation: Navigation | None) -> State:
        """``navigation`` None: it flies on the truth."""


class Sensors(Protocol):
    """Errors are functions of seed and time: the same flight gives the same readings."""

    def read(self, state: State) -> Readings: ...


class Autopilot(Protocol):
    """Lock-step: no thread, no socket, no clock but ``now_s``."""

    def step(self, now_s: float, readings: Readings) -> None: ...

    def receive(self, packets: bytes, now_s: float) -> None:
        """MAVLink bytes from the companion."""

    def transmit(self) -> bytes:
        """MAVLink bytes for the companion since the last call."""

    def navigation(self) -> Navigation | None:
        """None before it has a position."""
