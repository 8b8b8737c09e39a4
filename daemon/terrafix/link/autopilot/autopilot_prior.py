"""Started again in flight: the map is searched first where the autopilot believes to be.

The start coordinate is where the flight began. The autopilot has flown on, by its inertial sensors and, a plane, by
its airspeed; it may also have been led astray by a receiver. So its position is a hint like that of a person
(position_prior.py): where a search begins, believed by nobody."""

from typing import Any

from terrafix.core.limits import LEAST_LOOK_AGL_M
from terrafix.link.ground_station.position_prior import is_place
from terrafix.link.integrity.fix_type import STARTED_IN_FLIGHT
from terrafix.messages import GpsInput, PositionHint

RADIUS_M = 300.0  # what a plane without airspeed loses in two minutes without any position is 170 m

AGAIN_NS = 20_000_000_000
TIMES = 3


class AutopilotPrior:
    """``said`` everything that goes to the autopilot as GPS_INPUT, ``take`` what it says."""

    def __init__(self) -> None:
        self._wanted = False
        self._given = 0
        self._given_ns = 0

    def said(self, gps: GpsInput) -> None:
        """An estimate is there that only the start coordinate holds: so vision, estimator and anchor are up."""
        self._wanted = gps.reason == STARTED_IN_FLIGHT.text

    def take(self, message: Any, now_ns: int) -> PositionHint | None:
        if not self._wanted or self._given == TIMES or message.get_type() != "GLOBAL_POSITION_INT":
            return None
        if self._given and now_ns - self._given_ns < AGAIN_NS:
            return None
        lat_deg, lon_deg = message.lat / 1e7, message.lon / 1e7
        if not is_place(lat_deg, lon_deg) or message.relative_alt < LEAST_LOOK_AGL_M * 1e3:
            return None
        self._given, self._given_ns = self._given + 1, now_ns
        return PositionHint(t_ns=now_ns, lat_deg=lat_deg, lon_deg=lon_deg, radius_m=RADIUS_M, source="autopilot")
