"""Model of a small fixed-wing aircraft that flies a mission: runway, climb, coordinated turns, glide, roll-out.

Guidance uses the given Navigation; only the motion uses the truth. The flight path angles follow their commands
through lags and limits; attitude, rates and forces follow from the path (sim/vehicle/motion.py).
"""

import math
from dataclasses import dataclass

from terrafix.core.geodesy import LocalFrame
from terrafix_lab.sim.interfaces import Navigation, State, navigation_of
from terrafix_lab.sim.vehicle.motion import AIRBORNE_M, GRAVITY_MPS2, Motion
from terrafix_lab.sim.vehicle.plane_guidance import GuidanceCommand, PlaneGuidance
from terrafix_lab.sim.vehicle.wind import BREEZE, Gusts, Wind
from terrafix_tools.mission.items import HeightOf, Mission

ROLL_TIME_S = 0.4  # time constant of the roll angle
ROLL_RATE_RADPS = math.radians(60.0)
AILERON_TIME_S = 0.15  # time constant of the roll rate
SPEED_TIME_S = 3.0
THRUST_MPS2 = 2.0  # largest change of airspeed by thrust and drag
CLIMB_TIME_S = 1.2
GUST_TIME_S = (1.5, 0.4)  # horizontal, vertical: time constant with which the aircraft follows the air
GUST_ANGLE_RAD = math.radians(1.0)  # roll and pitch per 1 m/s of gust
GUST_ANGLE_TIME_S = 0.3
TRIM_PITCH_RAD = math.radians(2.0)  # angle of attack in level flight at cruise
GROUND_S = 10.0  # standing time before the take-off, for the autopilot's calibration
RUNWAY_MPS2 = 3.0
BRAKE_MPS2 = 2.5
ROTATE_SHARE = 0.8  # of cruise speed
FLARE_M, FLARE_SINK_MPS = 2.5, 0.8
WHEELS_TIME_S = 0.3  # time constant with which the wheels follow the ground


@dataclass(frozen=True)
class PlaneLimits:
    """Limits of a 2 to 5 kg aircraft with 1.8 m wingspan; ArduPlane's defaults where they exist."""

    cruise_mps: float = 22.0
    bank_rad: float = math.radians(35.0)
    climb_mps: float = 3.0
    sink_mps: float = 2.5


class Plane:
    """``height(e_m, n_m) -> ground AMSL``. Check the mission with ``mission.check`` first."""

    def __init__(
        self,
        mission: Mission,
        frame: LocalFrame,
        height: HeightOf,
        *,
        wind: Wind = BREEZE,
        seed: int = 0,
        limits: PlaneLimits = PlaneLimits(),
    ) -> None:
        self._wind, self._limits, self._gusts = wind, limits, Gusts(wind, seed)
        self._guidance = PlaneGuidance(mission, frame, height, limits.cruise_mps, limits.bank_rad)
        e_m, n_m, self._heading_rad = self._guidance.start()
        self._speed_mps = limits.cruise_mps
        self._roll_rad = self._roll_rate_radps = self._climb_mps = 0.0
        self._gust_velocity = [0.0, 0.0, 0.0]  # east, north, up: velocity caused by gusts
        self._gust_angles = [0.0, 0.0]  # roll, pitch
        self._on_ground = mission.starts_on_ground()
        self._airborne = not self._on_ground
        self._landed = False
        self.crashed = False  # hit the ground outside a landing
        up_m, velocity = height(e_m, n_m), (0.0, 0.0, 0.0)
        if self._on_ground:
            self._speed_mps = 0.0
            angles = (self._heading_rad, 0.0, 0.0)
        else:
            up_m = self._guidance.first_height_m(up_m)
            velocity = self._ground_velocity()
            angles = (self._heading_rad, TRIM_PITCH_RAD, 0.0)
        self._motion = Motion(
            height,
            e_m=e_m,
            n_m=n_m,
            up_m=up_m,
            velocity_enu_mps=velocity,
            yaw_rad=angles[0],
            pitch_rad=angles[1],
            roll_rad=angles[2],
            airspeed_mps=self._speed_mps,
        )

    @property
    def state(self) -> State:
        return self._motion.state

    @property
    def finished(self) -> bool:
        """True when the mission is complete: landed, or circling after the last item."""
        return self._landed or self._guidance.finished

    def step(self, dt_s: float, navigation: Navigation | None) -> State:
        """``navigation`` None: steers by the truth."""
        if self._on_ground:
            return self._roll(dt_s)
        truth = self._motion.state
        navigated = navigation or navigation_of(truth)
        command = self._guidance.step(dt_s, navigated)
        self._fly(dt_s, command, navigated.airspeed_mps)
        gust = self._gusts.step(dt_s, self._motion.agl_m, self._speed_mps, self._heading_rad)
        for i in range(3):
            self._gust_velocity[i] += (gust[i] - self._gust_velocity[i]) * dt_s / GUST_TIME_S[i == 2]
        velocity = self._ground_velocity()
        air = [
            v - w - g for v, w, g in zip(velocity, (self._wind.east_mps, self._wind.north_mps, 0.0), gust, strict=True)
        ]
        airspeed_mps = math.sqrt(air[0] ** 2 + air[1] ** 2 + air[2] ** 2)
        if not self._airborne:
            velocity = (velocity[0], velocity[1], max(0.0, velocity[2]))
        state = self._motion.move(dt_s, velocity, self._attitude(dt_s, gust), airspeed_mps)
        self._airborne = self._airborne or state.agl_m > AIRBORNE_M
        if self._airborne and state.agl_m <= 0.0:
            self._touch_down(velocity)
            self.crashed = not command.landing
        return state

    def _fly(self, dt_s: float, command: GuidanceCommand, airspeed_mps: float) -> None:
        limits = self._limits
        rate = _clip((command.bank_rad - self._roll_rad) / ROLL_TIME_S, ROLL_RATE_RADPS)
        self._roll_rate_radps += (rate - self._roll_rate_radps) * dt_s / AILERON_TIME_S
        self._roll_rad += self._roll_rate_radps * dt_s
        self._speed_mps += _clip((command.airspeed_mps - airspeed_mps) / SPEED_TIME_S, THRUST_MPS2) * dt_s
        self._heading_rad += GRAVITY_MPS2 * math.tan(self._roll_rad) / self._speed_mps * dt_s
        sink = FLARE_SINK_MPS if command.landing and self._motion.agl_m < FLARE_M else limits.sink_mps
        climb = min(max(command.climb_mps, -sink), limits.climb_mps)
        self._climb_mps += (climb - self._climb_mps) * dt_s / CLIMB_TIME_S

    def _ground_velocity(self) -> tuple[float, float, float]:
        """Ground velocity: airspeed along the path, wind, and the velocity caused by gusts."""
        level_mps = math.sqrt(max(0.0, self._speed_mps**2 - self._climb_mps**2))
        return (
            level_mps * math.sin(self._heading_rad) + self._wind.east_mps + self._gust_velocity[0],
            level_mps * math.cos(self._heading_rad) + self._wind.north_mps + self._gust_velocity[1],
            self._climb_mps + self._gust_velocity[2],
        )

    def _attitude(self, dt_s: float, gust: tuple[float, float, float]) -> tuple[float, float, float]:
        """Nose along the air path, with an angle of attack according to the required lift."""
        right = gust[0] * math.cos(self._heading_rad) - gust[1] * math.sin(self._heading_rad)
        for i, gust_mps in enumerate((right, gust[2])):
            self._gust_angles[i] += (GUST_ANGLE_RAD * gust_mps - self._gust_angles[i]) * dt_s / GUST_ANGLE_TIME_S
        lift = (self._limits.cruise_mps / self._speed_mps) ** 2 / math.cos(self._roll_rad)
        pitch = math.asin(_clip(self._climb_mps / self._speed_mps, 0.5)) + TRIM_PITCH_RAD * lift
        return self._heading_rad, pitch + self._gust_angles[1], self._roll_rad + self._gust_angles[0]

    # --- on the ground ---

    def _roll(self, dt_s: float) -> State:
        """Rolls on the runway: before the take-off, and after the landing until standstill."""
        motion = self._motion
        ve, vn, vu = motion.ve_mps, motion.vn_mps, motion.vu_mps
        speed_mps = math.hypot(ve, vn)
        if self._landed:
            speed_mps = max(0.0, speed_mps - BRAKE_MPS2 * dt_s)
        elif motion.t_s >= GROUND_S:
            speed_mps += RUNWAY_MPS2 * dt_s
        east, north = math.sin(self._course_rad()), math.cos(self._course_rad())
        ground_rate = (motion.ground_m - motion.up_m) / WHEELS_TIME_S
        vu += (ground_rate - vu) * dt_s / WHEELS_TIME_S if speed_mps else -vu
        yaw, pitch, roll = motion.state.yaw_rad, motion.state.pitch_rad, motion.state.roll_rad
        settle = dt_s / WHEELS_TIME_S
        yaw += math.remainder(self._course_rad() - yaw, math.tau) * settle
        pitch, roll = pitch * (1.0 - settle), roll * (1.0 - settle)
        ahead_mps = speed_mps - self._wind.east_mps * east - self._wind.north_mps * north
        velocity = (speed_mps * east, speed_mps * north, vu)
        state = motion.move(dt_s, velocity, (yaw, pitch, roll), abs(ahead_mps))
        if not self._landed and ahead_mps >= ROTATE_SHARE * self._limits.cruise_mps:
            self._lift_off(velocity, ahead_mps)
        return state

    def _course_rad(self) -> float:
        return self._heading_rad

    def _lift_off(self, velocity: tuple[float, float, float], airspeed_mps: float) -> None:
        """The wind acts like a gust from here on, so that the velocity does not jump."""
        self._on_ground = False
        self._speed_mps, self._climb_mps = airspeed_mps, 0.0
        self._gust_velocity = [0.0, 0.0, 0.0]
        self._gust_velocity = [v - w for v, w in zip(velocity, self._ground_velocity(), strict=True)]

    def _touch_down(self, velocity: tuple[float, float, float]) -> None:
        self._on_ground = self._landed = True
        self._heading_rad = math.atan2(velocity[0], velocity[1])


def _clip(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)
