"""Publishes the autopilot's position as a position hint after a restart in flight, so that the map search begins there.

The start coordinate is where the flight began. Meanwhile the autopilot has dead reckoned with its inertial sensors and,
in a plane, its airspeed; a spoofed receiver may also have displaced it. Its position is therefore treated like an
operator's hint (position_prior.py): it sets where a search begins, and is not fused."""

from typing import Any

from terrafix.core.limits import MIN_MATCHING_AGL_M
from terrafix.link.ground_station.position_prior import is_valid_position
from terrafix.link.integrity.fix_type import STARTED_IN_FLIGHT
from terrafix.messages import GpsInput, PositionHint

RADIUS_M = 300.0  # a plane without airspeed drifts 170 m in two minutes without any position [tuned]
HINT_PERIOD_NS = 20_000_000_000  # [tuned]
MAX_HINTS = 3  # per restart [tuned]


class AutopilotPrior:
    """Reads our GPS_INPUT and the autopilot's messages."""

    def __init__(self) -> None:
        self._started_in_flight = False
        self._published = 0
        self._published_ns = 0

    def on_gps_input(self, gps: GpsInput) -> None:
        """The reason STARTED_IN_FLIGHT means that there is an estimate from the start coordinate alone: vision,
        estimator and anchor are running."""
        self._started_in_flight = gps.no_fix_reason == STARTED_IN_FLIGHT.text

    def on_message(self, message: Any, now_ns: int) -> PositionHint | None:
        """-> a hint from GLOBAL_POSITION_INT if one is due and the vehicle is high enough for the map search."""
        if not self._started_in_flight or self._published == MAX_HINTS or message.get_type() != "GLOBAL_POSITION_INT":
            return None
        if self._published and now_ns - self._published_ns < HINT_PERIOD_NS:
            return None
        lat_deg, lon_deg = message.lat / 1e7, message.lon / 1e7
        if not is_valid_position(lat_deg, lon_deg) or message.relative_alt < MIN_MATCHING_AGL_M * 1e3:
            return None
        self._published, self._published_ns = self._published + 1, now_ns
        return PositionHint(t_ns=now_ns, lat_deg=lat_deg, lon_deg=lon_deg, radius_m=RADIUS_M, source="autopilot")
