"""Model of a multicopter that flies a mission: climb, straight legs with braking, hover, circles, descent.

It steers by the given Navigation. Thrust is along the body's up axis, so that tilt determines acceleration; rotor drag
is linear in airspeed (Mahony, Kumar, Corke, "Multirotor Aerial Vehicles", 2012).
"""

import math
from dataclasses import dataclass

from terrafix.core.geodesy import LocalFrame
from terrafix_lab.sim.interfaces import Navigation, State, navigation_of
from terrafix_lab.sim.vehicle.copter_guidance import CopterGuidance
from terrafix_lab.sim.vehicle.motion import AIRBORNE_M, GRAVITY_MPS2, Motion
from terrafix_lab.sim.vehicle.wind import BREEZE, Gusts, Wind
from terrafix_tools.mission.items import HeightOf, Mission

DRAG_PER_S = 0.25  # acceleration per m/s of airspeed
SPEED_GAIN_PER_S = 1.2
TILT_TIME_S = 0.12  # time constant of two stages: rotors, then the body
LIFT_TIME_S = 0.15
YAW_GAIN_PER_S = 1.5
YAW_TIME_S = 0.25
YAW_MIN_SPEED_MPS = 2.0  # below this speed the course does not determine the yaw
GROUND_S = 10.0  # standing time before the take-off, for the autopilot's calibration


@dataclass(frozen=True)
class CopterLimits:
    """Limits of a 1 to 3 kg quadcopter; ArduCopter's defaults where they exist (WPNAV_SPEED, WPNAV_SPEED_UP, _DN)."""

    cruise_mps: float = 10.0
    accel_mps2: float = 2.5
    climb_mps: float = 2.5
    sink_mps: float = 1.5
    tilt_rad: float = math.radians(30.0)
    yaw_rate_radps: float = math.radians(45.0)


class Copter:
    """``height(e_m, n_m) -> ground AMSL``. Check the mission with ``mission.check`` first."""

    def __init__(
        self,
        mission: Mission,
        frame: LocalFrame,
        height: HeightOf,
        *,
        wind: Wind = BREEZE,
        seed: int = 0,
        limits: CopterLimits = CopterLimits(),
    ) -> None:
        self._wind, self._limits, self._gusts = wind, limits, Gusts(wind, seed)
        self._guidance = CopterGuidance(mission, frame, height, limits.cruise_mps, limits.accel_mps2)
        e_m, n_m, self._yaw_rad = self._guidance.start()
        ground_m = height(e_m, n_m)
        self._on_ground, self._landed = mission.starts_on_ground(), False
        self._airborne = not self._on_ground
        self.crashed = False  # hit the ground outside a landing
        up_m = ground_m if self._on_ground else self._guidance.first_height_m(ground_m)
        self._motion = Motion(height, e_m=e_m, n_m=n_m, up_m=up_m, yaw_rad=self._yaw_rad)
        # Commanded and actual rotor acceleration beyond hover: east, north, up [m/s^2].
        self._rotor_mps2 = [0.0, 0.0, 0.0]
        self._thrust_mps2 = [0.0, 0.0, 0.0]
        if not self._on_ground:  # hovers against the wind
            self._rotor_mps2 = [-DRAG_PER_S * wind.east_mps, -DRAG_PER_S * wind.north_mps, 0.0]
            self._thrust_mps2 = list(self._rotor_mps2)
        self._yaw_rate_radps = 0.0

    @property
    def state(self) -> State:
        return self._motion.state

    @property
    def finished(self) -> bool:
        """True when the mission is complete: landed, or hovering after the last item."""
        return self._landed or self._guidance.finished

    def step(self, dt_s: float, navigation: Navigation | None) -> State:
        """``navigation`` None: steers by the truth."""
        if self._on_ground:
            return self._stand(dt_s)
        motion, truth, limits = self._motion, self._motion.state, self._limits
        navigated = navigation or navigation_of(truth)
        command = self._guidance.step(dt_s, navigated, motion.agl_m)
        self._follow(dt_s, command, navigated)
        gust = self._gusts.step(dt_s, motion.agl_m, truth.airspeed_mps, self._yaw_rad)
        velocity = [motion.ve_mps, motion.vn_mps, motion.vu_mps]
        air = [
            v - w - g for v, w, g in zip(velocity, (self._wind.east_mps, self._wind.north_mps, 0.0), gust, strict=True)
        ]
        for i in range(3):
            velocity[i] += (self._thrust_mps2[i] - DRAG_PER_S * air[i]) * dt_s
        if not self._airborne:
            velocity[2] = max(0.0, velocity[2])
        airspeed_mps = math.sqrt(air[0] ** 2 + air[1] ** 2 + air[2] ** 2)
        self._turn(dt_s, command, navigated, limits)
        state = motion.move(dt_s, (velocity[0], velocity[1], velocity[2]), self._attitude(), airspeed_mps)
        self._airborne = self._airborne or state.agl_m > AIRBORNE_M
        if self._airborne and state.agl_m <= 0.0:
            self._on_ground = self._landed = True
            self.crashed = not self._guidance.landing
        return state

    def _follow(self, dt_s: float, command: tuple[float, float, float], navigated: Navigation) -> None:
        """Rotors and body follow the commanded velocity within the limits of tilt and thrust."""
        limits = self._limits
        wanted_mps2 = []
        for i, limit in enumerate((2.0 * limits.accel_mps2,) * 2 + (limits.accel_mps2,)):
            error = SPEED_GAIN_PER_S * (command[i] - float(navigated.velocity_enu_mps[i]))
            # Drag at the estimated airspeed is fed forward, as the result of an integrator.
            drag = DRAG_PER_S * (command[i] - (self._wind.east_mps, self._wind.north_mps, 0.0)[i])
            wanted_mps2.append(min(max(error, -limit), limit) + drag)
        level = math.hypot(wanted_mps2[0], wanted_mps2[1])
        max_level = math.tan(limits.tilt_rad) * (GRAVITY_MPS2 + wanted_mps2[2])
        if level > max_level:
            wanted_mps2[0], wanted_mps2[1] = wanted_mps2[0] * max_level / level, wanted_mps2[1] * max_level / level
        for i in range(3):
            time_s = LIFT_TIME_S if i == 2 else TILT_TIME_S
            self._rotor_mps2[i] += (wanted_mps2[i] - self._rotor_mps2[i]) * dt_s / time_s
            self._thrust_mps2[i] += (self._rotor_mps2[i] - self._thrust_mps2[i]) * dt_s / time_s

    def _turn(
        self, dt_s: float, command: tuple[float, float, float], navigated: Navigation, limits: CopterLimits
    ) -> None:
        """Turns the yaw towards the course."""
        rate = 0.0
        if math.hypot(command[0], command[1]) > YAW_MIN_SPEED_MPS:
            error = math.remainder(math.atan2(command[0], command[1]) - navigated.yaw_rad, math.tau)
            rate = min(max(YAW_GAIN_PER_S * error, -limits.yaw_rate_radps), limits.yaw_rate_radps)
        self._yaw_rate_radps += (rate - self._yaw_rate_radps) * dt_s / YAW_TIME_S
        self._yaw_rad += self._yaw_rate_radps * dt_s

    def _attitude(self) -> tuple[float, float, float]:
        """Yaw, pitch and roll whose up axis is along the thrust."""
        east, north, up = self._thrust_mps2
        up += GRAVITY_MPS2
        s, c = math.sin(self._yaw_rad), math.cos(self._yaw_rad)
        forward, right = east * s + north * c, east * c - north * s
        pitch = math.atan2(-forward, up)
        return self._yaw_rad, pitch, math.atan2(right, math.hypot(forward, up))

    def _stand(self, dt_s: float) -> State:
        """Standing on the ground, before the take-off and after the landing."""
        motion = self._motion
        if not self._landed and motion.t_s >= GROUND_S:
            self._on_ground = False
        settle = 1.0 - dt_s / LIFT_TIME_S
        state = motion.state
        velocity = (motion.ve_mps * settle, motion.vn_mps * settle, motion.vu_mps * settle)
        angles = (state.yaw_rad, state.pitch_rad * settle, state.roll_rad * settle)
        return motion.move(dt_s, velocity, angles, self._wind.speed_mps())
