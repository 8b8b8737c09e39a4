"""Airspeed of a real sensor, out of MAVLink's AIRSPEED. Live link and recorded logs share it.

ArduPilot sends it from 4.6 on, for a sensor that is there, and for nothing else (GCS_Common.cpp, send_airspeed).
VFR_HUD.airspeed is no measurement: without a sensor it is what the autopilot's filter makes of wind and of our own
position (ArduPlane/GCS_Mavlink.cpp, vfr_hud_airspeed)."""

import math
from typing import Any

UNHEALTHY = 1  # AIRSPEED_SENSOR_UNHEALTHY: the driver has no reading, and the value is the last that it had
USED = 2  # AIRSPEED_SENSOR_USING: by the autopilot's filter; a tube that is blocked is healthy, but not used any more
MAX_MPS = 200.0  # what an airspeed beyond any drone is, garbage


class AirspeedReader:
    """One sensor of those that report: they differ by scale."""

    def __init__(self) -> None:
        self._id: int | None = None
        self._used: set[int] = set()  # those that the autopilot has used

    def take(self, message: Any) -> float | None:
        """Indicated airspeed [m/s]; None: of another sensor, or no reading."""
        if self._id not in (None, message.id):
            return None
        plausible = math.isfinite(message.airspeed) and 0.0 <= message.airspeed <= MAX_MPS
        if message.flags & USED:
            self._used.add(message.id)
        given_up = message.id in self._used and not message.flags & USED
        self._id = message.id if plausible and not given_up and not message.flags & UNHEALTHY else None
        return None if self._id is None else float(message.airspeed)
