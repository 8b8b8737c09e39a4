"""Mount of the camera in the vehicle, and its motion during an exposure."""

import math
from dataclasses import dataclass

import numpy as np

from terrafix.core.camera import Mount
from terrafix.core.geodesy import rot_w_b
from terrafix_lab.sim.interfaces import State

DOWN = Mount()
WANDER_S = (2.3, 5.9, 13.7)  # periods of a gimbal's error, from fast corrections to slow drift


@dataclass(frozen=True)
class CameraMotion:
    """Velocity and angular rate of the camera at the time of an image, constant during the exposure."""

    velocity_enu_mps: np.ndarray  # (3,)
    rates_c_radps: np.ndarray  # (3,) angular velocity of the camera against the world, in c

    def pose(self, p_c_in_w_m: np.ndarray, r_w_c: np.ndarray, after_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns positions (N, 3) and rotations R_w_c (N, 3, 3) at ``after_s`` (N,) seconds from the given pose."""
        positions = p_c_in_w_m + after_s[:, None] * self.velocity_enu_mps
        speed_radps = float(np.linalg.norm(self.rates_c_radps))
        x, y, z = np.asarray(self.rates_c_radps, np.float64) / max(speed_radps, 1e-12)
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        angle = (speed_radps * after_s)[:, None, None]  # Rodrigues' formula
        return positions, r_w_c @ (np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross))


@dataclass(frozen=True)
class Fixed:
    """A camera fixed to the body."""

    mount: Mount = DOWN

    def r_w_c(self, state: State) -> np.ndarray:
        return state.r_w_b() @ self.mount.r_b_c()

    def motion(self, state: State) -> CameraMotion:
        return CameraMotion(state.velocity_enu_mps, self.mount.r_b_c().T @ state.rates_b_radps)


@dataclass(frozen=True)
class Gimbal:
    """A camera that follows the heading and is stabilised against the horizon, with an error of ``error_deg``."""

    mount: Mount = DOWN
    error_deg: float = 0.5  # 1-sigma of pitch and roll, slowly varying
    seed: int = 0

    def r_w_c(self, state: State) -> np.ndarray:
        """R_w_c (3, 3), independent of the body's pitch and roll."""
        phases = np.random.default_rng([self.seed, 23]).uniform(0.0, 2 * math.pi, (2, len(WANDER_S)))
        waves = np.sin(2 * math.pi * state.t_s / np.array(WANDER_S) + phases).sum(axis=1)
        pitch_rad, roll_rad = np.radians(self.error_deg) * waves / math.sqrt(len(WANDER_S) / 2)
        return rot_w_b(state.yaw_rad, float(pitch_rad), float(roll_rad)) @ self.mount.r_b_c()

    def motion(self, state: State) -> CameraMotion:
        """Turns with the heading (Euler's kinematic equation); the gimbal's own corrections are negligible."""
        _, q, r = (float(v) for v in state.rates_b_radps)
        yaw_rate_radps = (q * math.sin(state.roll_rad) + r * math.cos(state.roll_rad)) / math.cos(state.pitch_rad)
        return CameraMotion(state.velocity_enu_mps, self.r_w_c(state).T @ np.array([0.0, 0.0, -yaw_rate_radps]))
