"""Base of all guidance: mission items, progress, and target height."""

import math

from terrafix.core.geodesy import LocalFrame
from terrafix_tools.mission.items import HeightOf, Mission, Target, targets

GROUND_INTERVAL_S = 0.2  # interval of ground height updates, for heights above ground


class MissionGuidance:
    """Mission guidance that depends only on the mission and the given navigation solution."""

    return_height_m: float  # above home, for a return without own height

    def __init__(self, mission: Mission, frame: LocalFrame, height: HeightOf, cruise_mps: float) -> None:
        self._targets = targets(mission, frame, height)
        self._height = height
        self._home = frame.to_local(mission.home_lat_deg, mission.home_lon_deg)
        self._home_amsl_m = height(*self._home)
        self._on_ground = mission.starts_on_ground()
        self._speed_mps = cruise_mps
        self._index = 0
        self._complete = False  # the last item is complete
        self._target_height_m, self._over_ground = math.nan, False
        self._ground_m, self._ground_at_s, self._t_s = self._home_amsl_m, -math.inf, 0.0
        e_m, n_m, _ = self.start()
        self._from = (e_m, n_m)

    def start(self) -> tuple[float, float, float]:
        """Returns east, north [m] and heading [rad] of the vehicle at time zero."""
        places = [(t.e_m, t.n_m) for t in self._targets if not math.isnan(t.e_m)]
        start_m = self._home if self._on_ground else places[0]
        next_m = next((p for p in places if math.dist(p, start_m) > 1.0), (start_m[0], start_m[1] + 1.0))
        return *start_m, math.atan2(next_m[0] - start_m[0], next_m[1] - start_m[1])

    def first_height_m(self, ground_m: float) -> float:
        """Initial height AMSL of a vehicle that starts in the air over ground of this height."""
        heights = (t.up_m(ground_m) for t in self._targets if not math.isnan(t.height_m))
        return next(heights, ground_m + self.return_height_m)

    def _pass_time(self, dt_s: float, e_m: float, n_m: float) -> None:
        self._t_s += dt_s
        if self._t_s - self._ground_at_s >= GROUND_INTERVAL_S:
            self._ground_m, self._ground_at_s = self._height(e_m, n_m), self._t_s

    def _set_height(self, target: Target) -> None:
        if not math.isnan(target.height_m):
            self._target_height_m, self._over_ground = target.height_m, target.over_ground

    @property
    def _goal_up_m(self) -> float:
        """Target height AMSL at the current position; nan: not set."""
        return self._target_height_m + (self._ground_m if self._over_ground else 0.0)
