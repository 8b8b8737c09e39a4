"""A small fixed-wing aircraft that flies a closed course in wind and gusts: its true state as a function of time.

The course is integrated once, at a fixed step, from the seed; ``state`` interpolates it, from LEAD_S before time zero
to LEAD_S after the end. ``Sensors`` says what an
autopilot would report of that state: biased, noisy, and without a position."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from terrafix.core.geodesy import rot_w_b

GRAVITY_MPS2 = 9.81
STEP_S = 0.02
AIRSPEED_MPS = 24.0
MAX_BANK_RAD = math.radians(27.0)
BANK_TIME_S = 0.9  # how fast roll follows its command
LOOK_AHEAD_M = 130.0  # of the course guidance
CLIMB_MPS = 2.5
AGL_M = (120.0, 150.0)
AGL_PERIOD_S = 70.0  # the height above ground wanders between the two with this period
GUST_TIME_S = 1.8  # correlation of the gusts
GUST_MPS = 0.7
GUST_RAD = math.radians(1.3)  # how far gusts shake roll and pitch
TRIM_PITCH_RAD = math.radians(2.0)
TURN_REACHED_M = 140.0  # a corner counts as flown when it is this close
LEAD_S = 20.0  # flown before time zero and after the end: an autopilot is in the air before the first picture


@dataclass(frozen=True)
class Wind:
    east_mps: float = 4.5
    north_mps: float = -3.0


@dataclass(frozen=True)
class State:
    """Truth at one moment, in the local frame of the flight (ENU, up AMSL)."""

    t_s: float
    p_b_in_w_m: np.ndarray  # (3,)
    velocity_enu_mps: np.ndarray  # (3,)
    yaw_rad: float  # clockwise from north
    pitch_rad: float
    roll_rad: float
    agl_m: float  # above the ground straight below

    def r_w_b(self) -> np.ndarray:
        """R_w_b (3x3)."""
        return rot_w_b(self.yaw_rad, self.pitch_rad, self.roll_rad)


class Trajectory:
    """``height(e_m, n_m) -> ground AMSL``; ``corners_m`` (N, 2) east, north of the course, flown round and round."""

    def __init__(
        self,
        corners_m: np.ndarray,
        height: Callable[[float, float], float],
        duration_s: float,
        *,
        wind: Wind = Wind(),
        seed: int = 0,
    ) -> None:
        rng = np.random.default_rng([seed, 21])
        steps = math.ceil((duration_s + 2 * LEAD_S) / STEP_S) + 2
        gusts = _gusts(rng, steps)
        self.duration_s = duration_s
        self._rows = np.empty((steps, 10))
        e, n = corners_m[0]
        course = corners_m[1] - corners_m[0]
        heading, roll, goal = math.atan2(course[0], course[1]), 0.0, 1
        up, climb = height(e, n) + AGL_M[0], 0.0
        ground = height(e, n)
        for i in range(steps):
            t_s = i * STEP_S - LEAD_S
            goal = _next_corner(corners_m, goal, e, n)
            bank = _bank_command(corners_m, goal, e, n, heading, wind)
            roll += (bank - roll) * STEP_S / BANK_TIME_S
            heading += GRAVITY_MPS2 * math.tan(roll) / AIRSPEED_MPS * STEP_S
            ve = AIRSPEED_MPS * math.sin(heading) + wind.east_mps + gusts[i, 0]
            vn = AIRSPEED_MPS * math.cos(heading) + wind.north_mps + gusts[i, 1]
            if i % 10 == 0:  # the terrain changes slowly
                ground = height(e, n)
                ahead = height(e + 6.0 * ve, n + 6.0 * vn)
            wave = 0.5 - 0.5 * math.cos(2.0 * math.pi * t_s / AGL_PERIOD_S)
            wanted = 0.5 * (ground + ahead) + AGL_M[0] + (AGL_M[1] - AGL_M[0]) * wave
            climb += (float(np.clip((wanted - up) * 0.35, -CLIMB_MPS, CLIMB_MPS)) - climb) * STEP_S / 1.5
            vu = climb + 0.4 * gusts[i, 2]
            pitch = TRIM_PITCH_RAD + climb / AIRSPEED_MPS + gusts[i, 4]
            self._rows[i] = (e, n, up, ve, vn, vu, heading, pitch, roll + gusts[i, 3], up - height(e, n))
            e, n, up = e + ve * STEP_S, n + vn * STEP_S, up + vu * STEP_S

    def state(self, t_s: float) -> State:
        """Beyond the lead the aircraft stands still in the air."""
        at = min(max((t_s + LEAD_S) / STEP_S, 0.0), len(self._rows) - 1.001)
        i = int(at)
        row = self._rows[i] + (self._rows[i + 1] - self._rows[i]) * (at - i)
        yaw = math.remainder(float(row[6]), 2.0 * math.pi)
        return State(t_s, row[:3], row[3:6], yaw, float(row[7]), float(row[8]), float(row[9]))

    def length_m(self) -> float:
        """Flown over ground, horizontally, from time zero to the end."""
        lead = round(LEAD_S / STEP_S)
        return float(np.hypot(*np.diff(self._rows[lead:-lead, :2], axis=0).T).sum())


@dataclass(frozen=True)
class Report:
    """What an autopilot says about itself; radians and metres."""

    yaw_rad: float
    pitch_rad: float
    roll_rad: float
    agl_m: float  # above the ground at take-off, as a barometer tells it
    velocity_enu_mps: tuple[float, float, float]


class Sensors:
    """Errors of compass, barometer and attitude: fixed biases and noise, functions of seed and time."""

    def __init__(self, trajectory: Trajectory, take_off_amsl_m: float, *, seed: int = 0) -> None:
        rng = np.random.default_rng([seed, 31])
        self._trajectory, self._take_off_amsl_m = trajectory, take_off_amsl_m
        self.yaw_bias_rad = math.radians(2.0) * float(rng.choice([-1.0, 1.0]))
        self._height_bias_m = float(rng.normal(0.0, 2.0))
        self._waves = rng.uniform((0.15, 0.0), (1.1, 2 * math.pi), (7, 3, 2))  # smooth noise: sums of slow sines

    def report(self, t_s: float) -> Report:
        """The autopilot's view at ``t_s``."""
        truth = self._trajectory.state(t_s)
        yaw, pitch, roll, up, ve, vn, vu = (self._noise(i, t_s) for i in range(7))
        v = truth.velocity_enu_mps
        return Report(
            yaw_rad=math.remainder(truth.yaw_rad + self.yaw_bias_rad + math.radians(0.7) * yaw, 2.0 * math.pi),
            pitch_rad=truth.pitch_rad + math.radians(0.5) * pitch,
            roll_rad=truth.roll_rad + math.radians(0.5) * roll,
            agl_m=float(truth.p_b_in_w_m[2]) - self._take_off_amsl_m + self._height_bias_m + 0.7 * up,
            velocity_enu_mps=(float(v[0]) + 0.3 * ve, float(v[1]) + 0.3 * vn, float(v[2]) + 0.2 * vu),
        )

    def _noise(self, channel: int, t_s: float) -> float:
        """Unit deviation over a long time."""
        rates, phases = self._waves[channel].T
        return float(np.sin(2.0 * math.pi * rates * t_s + phases).sum() * math.sqrt(2.0 / 3.0))


def _gusts(rng: np.random.Generator, steps: int) -> np.ndarray:
    """(steps, 5): east, north, up (m/s), roll, pitch (rad); first-order Gauss-Markov, smoothed once more."""
    keep = math.exp(-STEP_S / GUST_TIME_S)
    draws = rng.normal(size=(steps, 5)) * math.sqrt(1.0 - keep * keep)
    out, raw, smooth = np.empty((steps, 5)), np.zeros(5), np.zeros(5)
    for i in range(steps):
        raw = raw * keep + draws[i]
        smooth = smooth + (raw - smooth) * STEP_S / 0.3
        out[i] = smooth
    return out * (GUST_MPS, GUST_MPS, GUST_MPS, GUST_RAD, GUST_RAD)


def _next_corner(corners_m: np.ndarray, goal: int, e: float, n: float) -> int:
    target = corners_m[goal % len(corners_m)]
    return goal + 1 if math.hypot(target[0] - e, target[1] - n) < TURN_REACHED_M else goal


def _bank_command(corners_m: np.ndarray, goal: int, e: float, n: float, heading: float, wind: Wind) -> float:
    """Bank towards a point that runs ahead on the leg (Park, Deyst, How: A New Nonlinear Guidance Logic, 2004)."""
    start, end = corners_m[(goal - 1) % len(corners_m)], corners_m[goal % len(corners_m)]
    leg = end - start
    length = math.hypot(leg[0], leg[1])
    along = ((e - start[0]) * leg[0] + (n - start[1]) * leg[1]) / length
    aim = start + leg / length * min(along + LOOK_AHEAD_M, length + LOOK_AHEAD_M)
    ve, vn = AIRSPEED_MPS * math.sin(heading) + wind.east_mps, AIRSPEED_MPS * math.cos(heading) + wind.north_mps
    eta = math.remainder(math.atan2(aim[0] - e, aim[1] - n) - math.atan2(ve, vn), 2.0 * math.pi)
    speed2 = ve * ve + vn * vn
    sideways = 2.0 * speed2 / LOOK_AHEAD_M * math.sin(max(-math.pi / 2, min(math.pi / 2, eta)))
    return max(-MAX_BANK_RAD, min(MAX_BANK_RAD, math.atan(sideways / GRAVITY_MPS2)))
