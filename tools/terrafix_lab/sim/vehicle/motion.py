"""Integrates velocity and attitude steps to a State with exactly consistent inertial readings.

Rates and specific force are the means over the step that ends at the state's time, like those of a sensor that
integrates between two samples: a strapdown integration that rotates by the rates and applies the force in the mid-step
attitude reproduces the velocities and, with mean velocities, the positions.
"""

import math

import numpy as np

from terrafix_lab.sim.interfaces import State
from terrafix_tools.mission.items import HeightOf

GRAVITY_MPS2 = 9.80665
AIRBORNE_M = 1.0  # below this height after take-off the vehicle still stands on the ground
HEIGHT_INTERVAL_STEPS = (
    10  # steps between two ground height look-ups; in between the slope along the path is extrapolated
)

Quat = tuple[float, float, float, float]


class Motion:
    """True motion of one vehicle. ``state`` is the latest."""

    def __init__(
        self,
        height: HeightOf,
        *,
        e_m: float,
        n_m: float,
        up_m: float,
        velocity_enu_mps: tuple[float, float, float] = (0.0, 0.0, 0.0),
        yaw_rad: float = 0.0,
        pitch_rad: float = 0.0,
        roll_rad: float = 0.0,
        airspeed_mps: float = 0.0,
    ) -> None:
        self._height = height
        self.t_s, self.e_m, self.n_m, self.up_m = 0.0, e_m, n_m, up_m
        self.ve_mps, self.vn_mps, self.vu_mps = velocity_enu_mps
        self.ground_m = self._sampled_ground_m = height(e_m, n_m)
        self._slope_m = 0.0  # rise of the ground per step
        self._steps = 0
        self._attitude = quat_of(yaw_rad, pitch_rad, roll_rad)
        still = (0.0, 0.0, 0.0), rotate_to_body(self._attitude, 0.0, 0.0, -GRAVITY_MPS2)
        self.state = self._state((yaw_rad, pitch_rad, roll_rad), *still, airspeed_mps)

    @property
    def agl_m(self) -> float:
        return self.up_m - self.ground_m

    def move(
        self,
        dt_s: float,
        velocity_enu_mps: tuple[float, float, float],
        angles_rad: tuple[float, float, float],
        airspeed_mps: float,
    ) -> State:
        """Advances one step to a new velocity and attitude (yaw, pitch, roll)."""
        ve, vn, vu = velocity_enu_mps
        self.t_s += dt_s
        self.e_m += 0.5 * (self.ve_mps + ve) * dt_s
        self.n_m += 0.5 * (self.vn_mps + vn) * dt_s
        self.up_m += 0.5 * (self.vu_mps + vu) * dt_s
        attitude = quat_of(*angles_rad)
        rates, mid_attitude = mean_rates(self._attitude, attitude, dt_s)
        force = rotate_to_body(
            mid_attitude,
            (vn - self.vn_mps) / dt_s,
            (ve - self.ve_mps) / dt_s,
            -(vu - self.vu_mps) / dt_s - GRAVITY_MPS2,
        )
        self.ve_mps, self.vn_mps, self.vu_mps, self._attitude = ve, vn, vu, attitude
        self._follow_ground()
        self.state = self._state(angles_rad, rates, force, airspeed_mps)
        return self.state

    def _follow_ground(self) -> None:
        self._steps += 1
        if self._steps % HEIGHT_INTERVAL_STEPS == 0:
            now_m = self._height(self.e_m, self.n_m)
            self._slope_m, self._sampled_ground_m, self.ground_m = (
                (now_m - self._sampled_ground_m) / HEIGHT_INTERVAL_STEPS,
                now_m,
                now_m,
            )
        else:
            self.ground_m += self._slope_m

    def _state(
        self,
        angles_rad: tuple[float, float, float],
        rates: tuple[float, float, float],
        force: tuple[float, float, float],
        airspeed_mps: float,
    ) -> State:
        yaw, pitch, roll = angles_rad
        return State(
            t_s=self.t_s,
            p_b_in_w_m=np.array((self.e_m, self.n_m, self.up_m)),
            velocity_enu_mps=np.array((self.ve_mps, self.vn_mps, self.vu_mps)),
            yaw_rad=math.remainder(yaw, math.tau),
            pitch_rad=pitch,
            roll_rad=roll,
            agl_m=self.up_m - self.ground_m,
            rates_b_radps=np.array(rates),
            force_b_mps2=np.array(force),
            airspeed_mps=airspeed_mps,
        )


def quat_of(yaw_rad: float, pitch_rad: float, roll_rad: float) -> Quat:
    """Unit quaternion (w, x, y, z), body (FRD) to north, east, down, of the aerospace angles (Z-Y-X)."""
    cy, sy = math.cos(0.5 * yaw_rad), math.sin(0.5 * yaw_rad)
    cp, sp = math.cos(0.5 * pitch_rad), math.sin(0.5 * pitch_rad)
    cr, sr = math.cos(0.5 * roll_rad), math.sin(0.5 * roll_rad)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def mean_rates(a: Quat, b: Quat, dt_s: float) -> tuple[tuple[float, float, float], Quat]:
    """Returns the mean body rates [rad/s] from attitude ``a`` to ``b`` in ``dt_s``, and the mid-step attitude."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    w = aw * bw + ax * bx + ay * by + az * bz  # conj(a) * b
    x = aw * bx - ax * bw - ay * bz + az * by
    y = aw * by + ax * bz - ay * bw - az * bx
    z = aw * bz - ax * by + ay * bx - az * bw
    if w < 0.0:  # same attitude with the opposite sign
        w, x, y, z, bw, bx, by, bz = -w, -x, -y, -z, -bw, -bx, -by, -bz
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 / dt_s if sine < 1e-9 else 2.0 * math.atan2(sine, w) / (sine * dt_s)
    mw, mx, my, mz = aw + bw, ax + bx, ay + by, az + bz
    norm = 1.0 / math.sqrt(mw * mw + mx * mx + my * my + mz * mz)
    return (x * scale, y * scale, z * scale), (mw * norm, mx * norm, my * norm, mz * norm)


def rotate_to_body(q: Quat, north: float, east: float, down: float) -> tuple[float, float, float]:
    """Transforms a vector from north, east, down to the body with attitude ``q``."""
    w, x, y, z = q
    # v + 2 w (u x v) + 2 u x (u x v) with u = -(x, y, z)
    tx, ty, tz = 2.0 * (z * east - y * down), 2.0 * (x * down - z * north), 2.0 * (y * north - x * east)
    return (
        north + w * tx + z * ty - y * tz,
        east + w * ty + x * tz - z * tx,
        down + w * tz + y * tx - x * ty,
    )
