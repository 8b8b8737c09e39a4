"""Guidance of the fixed wing: bank, climb and airspeed commands along the mission, from the navigation solution.

Legs and circles: Park, Deyst, How, "A New Nonlinear Guidance Logic for Trajectory Tracking", AIAA 2004-4900: bank
towards a look-ahead point on the path (ArduPlane's L1 controller belongs to this family).
"""

import math
from dataclasses import dataclass

from terrafix.core.geodesy import LocalFrame
from terrafix_lab.sim.interfaces import Navigation
from terrafix_lab.sim.vehicle.guided import MissionGuidance
from terrafix_lab.sim.vehicle.motion import GRAVITY_MPS2
from terrafix_tools.mission.items import Do, HeightOf, Mission, Target

LOOK_AHEAD_S = 4.2  # ArduPlane: NAVL1_PERIOD 17 s, damping 0.75 -> 0.75 * 17 / pi
MIN_LOOK_AHEAD_M = 50.0
CLIMB_GAIN_PER_S = 0.35
REACHED_M = 5.0  # height tolerance
LOITER_RADIUS_M = 120.0
RETURN_HEIGHT_M = 100.0  # above home (ArduPlane RTL_ALTITUDE)
GLIDE_SLOPE = 0.09  # glide slope: height lost per metre to the landing point
FLARE_DISTANCE_M = 8.0  # distance flown in the flare
TAKE_OFF_AHEAD_M = 3000.0  # length of the extended runway line, followed until the height is reached


@dataclass(frozen=True)
class GuidanceCommand:
    bank_rad: float
    climb_mps: float
    airspeed_mps: float
    landing: bool = False


class PlaneGuidance(MissionGuidance):
    """Guidance of the fixed wing; see MissionGuidance."""

    return_height_m = RETURN_HEIGHT_M

    def __init__(
        self, mission: Mission, frame: LocalFrame, height: HeightOf, cruise_mps: float, bank_rad: float
    ) -> None:
        super().__init__(mission, frame, height, cruise_mps)
        self._bank_rad = bank_rad
        self._since_s = self._turned_rad = 0.0
        self._bearing_rad: float | None = None  # bearing from the centre of the current circle
        self._course_rad = self.start()[2]
        if not self._on_ground:
            self._skip_first()

    @property
    def finished(self) -> bool:
        """True when the last item is complete, or the vehicle circles at its final position."""
        if self._complete:
            return True
        return self._targets[self._index].do in (Do.LOITER, Do.RETURN) and self._bearing_rad is not None

    def step(self, dt_s: float, navigated: Navigation) -> GuidanceCommand:
        e, n, up = navigated.p_b_in_w_m.tolist()
        ve, vn, _ = navigated.velocity_enu_mps.tolist()
        self._pass_time(dt_s, e, n)
        self._since_s += dt_s
        while not self._complete and self._done(self._targets[self._index], e, n, up):
            self._next()
        look_ahead = self._look_ahead_point(e, n, math.hypot(ve, vn))
        landing = not self._complete and self._targets[self._index].do is Do.LAND
        if landing:
            self._target_height_m, self._over_ground = self._glide_m(self._targets[self._index], e, n, up), False
        goal_m = self._goal_up_m
        climb_mps = 0.0 if math.isnan(goal_m) else (goal_m - up) * CLIMB_GAIN_PER_S
        if landing and goal_m < up:  # on the glide slope: descend with it
            climb_mps -= GLIDE_SLOPE * math.hypot(ve, vn)
        return GuidanceCommand(self._bank(look_ahead, e, n, ve, vn), climb_mps, self._speed_mps, landing)

    # --- path ---

    def _look_ahead_point(self, e: float, n: float, speed_mps: float) -> tuple[float, float]:
        """Returns the look-ahead point on the path."""
        ahead_m = max(MIN_LOOK_AHEAD_M, LOOK_AHEAD_S * speed_mps)
        if self._complete:
            return self._on_circle(e, n, self._from, LOITER_RADIUS_M, ahead_m)
        target = self._targets[self._index]
        if target.do in (Do.LOITER, Do.LOITER_TURNS, Do.LOITER_TIME, Do.RETURN):
            return self._on_circle(e, n, (target.e_m, target.n_m), target.radius_m or LOITER_RADIUS_M, ahead_m)
        if target.do is Do.WAYPOINT and self._bearing_rad is not None:
            return self._on_circle(e, n, (target.e_m, target.n_m), LOITER_RADIUS_M, ahead_m)
        (e0, n0), (e1, n1) = self._from, self._end(target)
        length = max(1.0, math.hypot(e1 - e0, n1 - n0))
        along = ((e - e0) * (e1 - e0) + (n - n0) * (n1 - n0)) / length
        share = (along + ahead_m) / length
        return e0 + (e1 - e0) * share, n0 + (n1 - n0) * share

    def _end(self, target: Target) -> tuple[float, float]:
        """End of the leg; for an item without position the extension of the course."""
        if not math.isnan(target.e_m):
            return target.e_m, target.n_m
        e0, n0 = self._from
        return e0 + TAKE_OFF_AHEAD_M * math.sin(self._course_rad), n0 + TAKE_OFF_AHEAD_M * math.cos(self._course_rad)

    def _on_circle(
        self, e: float, n: float, centre: tuple[float, float], radius_m: float, ahead_m: float
    ) -> tuple[float, float]:
        """Look-ahead point on a circle; also accumulates the flown angle when near the circle."""
        size_m, sense = abs(radius_m), math.copysign(1.0, radius_m)
        bearing = math.atan2(e - centre[0], n - centre[1])
        if abs(math.hypot(e - centre[0], n - centre[1]) - size_m) < 0.5 * size_m:
            if self._bearing_rad is not None:
                self._turned_rad += sense * math.remainder(bearing - self._bearing_rad, math.tau)
            else:
                self._since_s = self._turned_rad = 0.0
            self._bearing_rad = bearing
        point_bearing = bearing + sense * min(1.0, 0.6 * ahead_m / size_m)
        return centre[0] + size_m * math.sin(point_bearing), centre[1] + size_m * math.cos(point_bearing)

    def _bank(self, look_ahead: tuple[float, float], e: float, n: float, ve: float, vn: float) -> float:
        east, north = look_ahead[0] - e, look_ahead[1] - n
        eta = math.remainder(math.atan2(east, north) - math.atan2(ve, vn), math.tau)
        ahead_m = max(1.0, math.hypot(east, north))
        sideways = 2.0 * (ve * ve + vn * vn) / ahead_m * math.sin(min(max(eta, -math.pi / 2), math.pi / 2))
        return min(max(math.atan(sideways / GRAVITY_MPS2), -self._bank_rad), self._bank_rad)

    def _glide_m(self, target: Target, e: float, n: float, up: float) -> float:
        """Height AMSL on the glide slope to the end of the leg and beyond it; at most the current height."""
        (e0, n0), (e1, n1) = self._from, self._end(target)
        length = max(1.0, math.hypot(e1 - e0, n1 - n0))
        to_go_m = ((e1 - e) * (e1 - e0) + (n1 - n) * (n1 - n0)) / length
        return min(up, self._height(e1, n1) + GLIDE_SLOPE * (to_go_m - FLARE_DISTANCE_M))

    # --- mission progress ---

    def _done(self, target: Target, e: float, n: float, up: float) -> bool:
        match target.do:
            case Do.SPEED:
                self._speed_mps = target.amount
                return True
            case Do.TAKE_OFF | Do.ALTITUDE:
                self._set_height(target)
                goal = self._goal_up_m
                return math.isnan(goal) or (
                    up > goal - REACHED_M and (target.do is Do.TAKE_OFF or up < goal + REACHED_M)
                )
            case Do.WAYPOINT:
                self._set_height(target)
                if target.amount > 0.0:  # hold: circle at the waypoint
                    return self._hold_complete(target, e, n)
                return self._passed(target, e, n)
            case Do.LOITER_TURNS:
                self._set_height(target)
                return self._turned_rad >= math.tau * target.amount
            case Do.LOITER_TIME:
                self._set_height(target)
                return self._bearing_rad is not None and self._since_s >= target.amount
            case Do.LOITER:
                self._set_height(target)
            case Do.RETURN:
                self._target_height_m, self._over_ground = self._home_amsl_m + RETURN_HEIGHT_M, False
                if not math.isnan(target.height_m):
                    self._set_height(target)
        return False

    def _hold_complete(self, target: Target, e: float, n: float) -> bool:
        if self._bearing_rad is None and self._passed(target, e, n):
            self._bearing_rad, self._since_s = math.atan2(e - target.e_m, n - target.n_m), 0.0
        return self._bearing_rad is not None and self._since_s >= target.amount

    def _passed(self, target: Target, e: float, n: float) -> bool:
        """True when near enough to turn, or when the waypoint was passed."""
        near_m = max(MIN_LOOK_AHEAD_M, LOOK_AHEAD_S * self._speed_mps)
        east, north = target.e_m - self._from[0], target.n_m - self._from[1]
        passed_end = (e - target.e_m) * east + (n - target.n_m) * north > 0.0
        return passed_end or math.hypot(e - target.e_m, n - target.n_m) < near_m

    def _next(self) -> None:
        target = self._targets[self._index]
        if not math.isnan(target.e_m):
            e1, n1 = target.e_m, target.n_m
            self._course_rad = math.atan2(e1 - self._from[0], n1 - self._from[1])
            self._from = e1, n1
        self._since_s = self._turned_rad = 0.0
        self._bearing_rad = None
        self._index += 1
        self._complete = self._index >= len(self._targets)

    def _skip_first(self) -> None:
        """Starts at the first position: speed and height items before it, and that waypoint, count as complete."""
        for i, target in enumerate(self._targets):
            if target.do is Do.SPEED:
                self._speed_mps = target.amount
            self._set_height(target)
            if not math.isnan(target.e_m):
                passed = target.do is Do.WAYPOINT and target.amount == 0.0 and i + 1 < len(self._targets)
                self._index = i + passed
                return
