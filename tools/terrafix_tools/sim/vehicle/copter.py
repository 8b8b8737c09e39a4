"""A multicopter that flies a mission: climb, straight legs with braking, hover, circles, descent.

It steers by the Navigation that it is given. Thrust points along the body's up axis, so tilt and acceleration are one
thing; drag of the rotors is linear in airspeed (Mahony, Kumar, Corke, "Multirotor Aerial Vehicles", 2012)."""

import math
from dataclasses import dataclass

from terrafix.core.geodesy import LocalFrame
from terrafix_tools.mission.mission import HeightOf, Mission
from terrafix_tools.sim.interfaces import Navigation, State, navigation_of
from terrafix_tools.sim.vehicle.copter_guidance import Guidance
from terrafix_tools.sim.vehicle.motion import AIRBORNE_M, GRAVITY_MPS2, Motion
from terrafix_tools.sim.vehicle.wind import BREEZE, Gusts, Wind

DRAG_PER_S = 0.25  # acceleration per m/s of airspeed
SPEED_GAIN_PER_S = 1.2
TILT_TIME_S = 0.12  # twice: rotors, then the body
LIFT_TIME_S = 0.15
YAW_GAIN_PER_S = 1.5
YAW_TIME_S = 0.25
YAW_FROM_MPS = 2.0  # slower than this the course says nothing about where to look
GROUND_S = 10.0  # stands still before the take-off: an autopilot calibrates


@dataclass(frozen=True)
class CopterLimits:
    """Of a 1 to 3 kg quadcopter; ArduCopter's defaults where it has one (WPNAV_SPEED, WPNAV_SPEED_UP, _DN)."""

    cruise_mps: float = 10.0
    accel_mps2: float = 2.5
    climb_mps: float = 2.5
    sink_mps: float = 1.5
    tilt_rad: float = math.radians(30.0)
    yaw_rate_radps: float = math.radians(45.0)


class Copter:
    """``height(e_m, n_m) -> ground AMSL``. The mission is checked by ``mission.check`` before."""

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
        self._guidance = Guidance(mission, frame, height, limits.cruise_mps, limits.accel_mps2)
        e_m, n_m, self._yaw_rad = self._guidance.start()
        ground_m = height(e_m, n_m)
        self._on_ground, self._landed = mission.starts_on_ground(), False
        self._airborne = not self._on_ground
        self.crashed = False  # it met the ground where it was not to land
        up_m = ground_m if self._on_ground else self._guidance.first_height_m(ground_m)
        self._motion = Motion(height, e_m=e_m, n_m=n_m, up_m=up_m, yaw_rad=self._yaw_rad)
        # Commanded and real push of the rotors beyond hover: east, north, up [m/s^2].
        self._half = [0.0, 0.0, 0.0]
        self._push = [0.0, 0.0, 0.0]
        if not self._on_ground:  # it hovers against the wind
            self._half = [-DRAG_PER_S * wind.east_mps, -DRAG_PER_S * wind.north_mps, 0.0]
            self._push = list(self._half)
        self._yaw_rate_radps = 0.0

    @property
    def state(self) -> State:
        return self._motion.state

    @property
    def finished(self) -> bool:
        """Nothing is left to fly: landed, or hovering after the last item."""
        return self._landed or self._guidance.finished

    def step(self, dt_s: float, navigation: Navigation | None) -> State:
        """``navigation`` None: it flies on the truth."""
        if self._on_ground:
            return self._stand(dt_s)
        motion, truth, limits = self._motion, self._motion.state, self._limits
        seen = navigation or navigation_of(truth)
        wish = self._guidance.step(dt_s, seen, motion.agl_m)
        self._follow(dt_s, wish, seen)
        gust = self._gusts.step(dt_s, motion.agl_m, truth.airspeed_mps, self._yaw_rad)
        velocity = [motion.ve_mps, motion.vn_mps, motion.vu_mps]
        air = [
            v - w - g for v, w, g in zip(velocity, (self._wind.east_mps, self._wind.north_mps, 0.0), gust, strict=True)
        ]
        for i in range(3):
            velocity[i] += (self._push[i] - DRAG_PER_S * air[i]) * dt_s
        if not self._airborne:
            velocity[2] = max(0.0, velocity[2])
        airspeed_mps = math.sqrt(air[0] ** 2 + air[1] ** 2 + air[2] ** 2)
        self._turn(dt_s, wish, seen, limits)
        state = motion.move(dt_s, (velocity[0], velocity[1], velocity[2]), self._attitude(), airspeed_mps)
        self._airborne = self._airborne or state.agl_m > AIRBORNE_M
        if self._airborne and state.agl_m <= 0.0:
            self._on_ground = self._landed = True
            self.crashed = not self._guidance.landing
        return state

    def _follow(self, dt_s: float, wish: tuple[float, float, float], seen: Navigation) -> None:
        """Rotors and body follow the wished velocity, as far as tilt and thrust allow."""
        limits = self._limits
        want = []
        for i, fastest in enumerate((2.0 * limits.accel_mps2,) * 2 + (limits.accel_mps2,)):
            error = SPEED_GAIN_PER_S * (wish[i] - float(seen.velocity_enu_mps[i]))
            # Drag of the believed airspeed is fed forward, as an integrator would find it.
            drag = DRAG_PER_S * (wish[i] - (self._wind.east_mps, self._wind.north_mps, 0.0)[i])
            want.append(min(max(error, -fastest), fastest) + drag)
        level = math.hypot(want[0], want[1])
        most = math.tan(limits.tilt_rad) * (GRAVITY_MPS2 + want[2])
        if level > most:
            want[0], want[1] = want[0] * most / level, want[1] * most / level
        for i in range(3):
            time_s = LIFT_TIME_S if i == 2 else TILT_TIME_S
            self._half[i] += (want[i] - self._half[i]) * dt_s / time_s
            self._push[i] += (self._half[i] - self._push[i]) * dt_s / time_s

    def _turn(self, dt_s: float, wish: tuple[float, float, float], seen: Navigation, limits: CopterLimits) -> None:
        """The nose goes for the course."""
        rate = 0.0
        if math.hypot(wish[0], wish[1]) > YAW_FROM_MPS:
            error = math.remainder(math.atan2(wish[0], wish[1]) - seen.yaw_rad, math.tau)
            rate = min(max(YAW_GAIN_PER_S * error, -limits.yaw_rate_radps), limits.yaw_rate_radps)
        self._yaw_rate_radps += (rate - self._yaw_rate_radps) * dt_s / YAW_TIME_S
        self._yaw_rad += self._yaw_rate_radps * dt_s

    def _attitude(self) -> tuple[float, float, float]:
        """Yaw, pitch, roll whose up axis lies along the thrust."""
        east, north, up = self._push
        up += GRAVITY_MPS2
        s, c = math.sin(self._yaw_rad), math.cos(self._yaw_rad)
        forward, right = east * s + north * c, east * c - north * s
        pitch = math.atan2(-forward, up)
        return self._yaw_rad, pitch, math.atan2(right, math.hypot(forward, up))

    def _stand(self, dt_s: float) -> State:
        """Before the take-off, and after the landing."""
        motion = self._motion
        if not self._landed and motion.t_s >= GROUND_S:
            self._on_ground = False
        settle = 1.0 - dt_s / LIFT_TIME_S
        state = motion.state
        velocity = (motion.ve_mps * settle, motion.vn_mps * settle, motion.vu_mps * settle)
        angles = (state.yaw_rad, state.pitch_rad * settle, state.roll_rad * settle)
        return motion.move(dt_s, velocity, angles, self._wind.speed_mps())
