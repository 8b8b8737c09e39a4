"""Guidance of the multicopter: velocity command along the mission, from the navigation solution."""

import math

from terrafix.core.geodesy import LocalFrame
from terrafix_lab.sim.interfaces import Navigation
from terrafix_lab.sim.vehicle.guided import MissionGuidance
from terrafix_tools.mission.items import Do, HeightOf, Mission, Target

GAIN_PER_S = 0.8  # velocity per metre of cross-track or height error
CLIMB_MPS, SINK_MPS, SLOW_SINK_MPS = 2.5, 1.5, 0.5  # WPNAV_SPEED_UP, WPNAV_SPEED_DN, LAND_SPEED
SLOW_BELOW_M = 10.0  # LAND_ALT_LOW
CORNER_MPS = 3.0  # speed in the corner between two legs
REACHED_M = 4.0
HOVER_REACHED_M = 2.0  # radius of a stop (WPNAV_RADIUS)
LOITER_RADIUS_M = 20.0
RETURN_HEIGHT_M = 15.0  # RTL_ALT: least height above home


class CopterGuidance(MissionGuidance):
    """Guidance of the multicopter; see MissionGuidance."""

    return_height_m = RETURN_HEIGHT_M

    def __init__(
        self, mission: Mission, frame: LocalFrame, height: HeightOf, cruise_mps: float, brake_mps2: float
    ) -> None:
        super().__init__(mission, frame, height, cruise_mps)
        self._brake_mps2 = brake_mps2
        self._arrived_s: float | None = None
        self._bearing_rad = self._turned_rad = 0.0

    @property
    def finished(self) -> bool:
        """True when the last item is complete, or the vehicle hovers at its final position."""
        return self._complete or (self._targets[self._index].do is Do.LOITER and self._arrived_s is not None)

    @property
    def landing(self) -> bool:
        return not self._complete and self._targets[self._index].do in (Do.LAND, Do.RETURN)

    def step(self, dt_s: float, navigated: Navigation, agl_m: float) -> tuple[float, float, float]:
        """Returns the velocity command east, north, up [m/s]. ``agl_m`` (of a rangefinder) is used for the landing
        only.
        """
        e, n, up = navigated.p_b_in_w_m.tolist()
        self._pass_time(dt_s, e, n)
        while not self._complete and self._done(self._targets[self._index], e, n, up):
            self._next(e, n)
        if self._complete:
            return *self._toward(self._from, e, n, True), self._climb(up)
        target = self._targets[self._index]
        place = self._place(target)
        if target.do is Do.RETURN and math.dist(place, (e, n)) < HOVER_REACHED_M:
            self._from = place
            return *self._toward(place, e, n, True), self._sink(agl_m)
        if target.do is Do.LAND:
            arrived = math.dist(place, (e, n)) < HOVER_REACHED_M
            return *self._toward(place, e, n, True), self._sink(agl_m) if arrived else self._climb(up)
        if target.do is Do.LOITER_TURNS:
            return *self._circle(target, e, n), self._climb(up)
        stop = target.do is not Do.WAYPOINT or target.amount > 0.0 or self._index + 1 == len(self._targets)
        return *self._toward(place, e, n, stop), self._climb(up)

    # --- velocity ---

    def _toward(self, place: tuple[float, float], e: float, n: float, stop: bool) -> tuple[float, float]:
        """Along the leg to ``place``, with braking and cross-track correction."""
        east, north = place[0] - self._from[0], place[1] - self._from[1]
        length = math.hypot(east, north)
        if length < 1.0:
            gap = math.hypot(place[0] - e, place[1] - n)
            rate = min(self._speed_mps, GAIN_PER_S * gap) / max(gap, 1e-6)
            return rate * (place[0] - e), rate * (place[1] - n)
        east, north = east / length, north / length
        distance_left = (place[0] - e) * east + (place[1] - n) * north
        cross_track = (place[0] - e) * north - (place[1] - n) * east
        last_mps = 0.0 if stop else CORNER_MPS
        along = min(self._speed_mps, math.sqrt(last_mps**2 + self._brake_mps2 * abs(distance_left)))
        if stop:
            along = min(along, GAIN_PER_S * abs(distance_left))
        along = math.copysign(along, distance_left)
        lateral = min(max(GAIN_PER_S * cross_track, -self._speed_mps / 2), self._speed_mps / 2)
        return along * east + lateral * north, along * north - lateral * east

    def _circle(self, target: Target, e: float, n: float) -> tuple[float, float]:
        radius_m, sense = abs(target.radius_m) or LOITER_RADIUS_M, math.copysign(1.0, target.radius_m)
        east, north = e - target.e_m, n - target.n_m
        gap = max(0.1, math.hypot(east, north))
        if abs(gap - radius_m) > 0.5 * radius_m:
            rate = min(self._speed_mps, abs(gap - radius_m)) * (1.0 if gap < radius_m else -1.0) / gap
            return rate * east, rate * north
        bearing = math.atan2(east, north)
        if self._arrived_s is None:
            self._arrived_s, self._turned_rad = self._t_s, 0.0
        else:
            self._turned_rad += sense * math.remainder(bearing - self._bearing_rad, math.tau)
        self._bearing_rad = bearing
        speed = min(self._speed_mps, math.sqrt(self._brake_mps2 * radius_m))
        back = GAIN_PER_S * (radius_m - gap)
        return (
            sense * speed * north / gap + back * east / gap,
            -sense * speed * east / gap + back * north / gap,
        )

    def _climb(self, up: float) -> float:
        goal_m = self._goal_up_m
        return 0.0 if math.isnan(goal_m) else min(max(GAIN_PER_S * (goal_m - up), -SINK_MPS), CLIMB_MPS)

    @staticmethod
    def _sink(agl_m: float) -> float:
        return -SLOW_SINK_MPS if agl_m < SLOW_BELOW_M else -SINK_MPS

    # --- mission progress ---

    def _done(self, target: Target, e: float, n: float, up: float) -> bool:
        if target.do is not Do.LAND:
            self._set_height(target)
        goal_m = self._goal_up_m
        match target.do:
            case Do.SPEED:
                self._speed_mps = target.amount
                return True
            case Do.TAKE_OFF | Do.ALTITUDE:
                return math.isnan(goal_m) or abs(up - goal_m) < HOVER_REACHED_M
            case Do.WAYPOINT if target.amount == 0.0 and self._index + 1 < len(self._targets):
                return math.dist((e, n), (target.e_m, target.n_m)) < REACHED_M
            case Do.WAYPOINT | Do.LOITER_TIME:
                return self._waited(target, e, n)
            case Do.LOITER:
                self._waited(target, e, n)
            case Do.LOITER_TURNS:
                return self._turned_rad >= math.tau * target.amount
            case Do.RETURN:
                self._over_ground = False
                self._target_height_m = max(self._target_height_m, self._home_amsl_m + RETURN_HEIGHT_M)
        return False

    def _waited(self, target: Target, e: float, n: float) -> bool:
        if self._arrived_s is None and math.dist((e, n), (target.e_m, target.n_m)) < HOVER_REACHED_M:
            self._arrived_s = self._t_s
        return self._arrived_s is not None and self._t_s - self._arrived_s >= target.amount

    def _next(self, e: float, n: float) -> None:
        self._from = self._place(self._targets[self._index]) if self._targets[self._index].do is Do.WAYPOINT else (e, n)
        self._arrived_s, self._turned_rad = None, 0.0
        self._index += 1
        self._complete = self._index >= len(self._targets)

    def _place(self, target: Target) -> tuple[float, float]:
        return self._from if math.isnan(target.e_m) else (target.e_m, target.n_m)
