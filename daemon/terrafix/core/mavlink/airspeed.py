"""Airspeed of a sensor from MAVLink's AIRSPEED message, for the live link and for recorded logs.

ArduPilot sends AIRSPEED from 4.6 on, and only for an installed sensor (GCS_Common.cpp, send_airspeed).
VFR_HUD.airspeed is not used because it is not a measurement: without a sensor the autopilot's filter computes it from
its wind estimate and from our own position output (ArduPlane/GCS_Mavlink.cpp, vfr_hud_airspeed)."""

import math
from typing import Any

UNHEALTHY = 1  # AIRSPEED_SENSOR_UNHEALTHY: the driver has no reading; the value is the last one that it had
USED = 2  # AIRSPEED_SENSOR_USING: the autopilot's filter uses the sensor; a blocked tube is healthy but no longer used
MAX_MPS = 200.0  # m/s, faster than any drone; a greater value is invalid


class AirspeedReader:
    """Selects one of several airspeed sensors, because their scale factors differ."""

    def __init__(self) -> None:
        self._id: int | None = None  # the selected sensor
        self._used: set[int] = set()  # ids of sensors that the autopilot has used

    def take(self, message: Any) -> float | None:
        """AIRSPEED message -> indicated airspeed [m/s]; None: not the selected sensor, or no valid reading."""
        if self._id not in (None, message.id):
            return None
        plausible = math.isfinite(message.airspeed) and 0.0 <= message.airspeed <= MAX_MPS
        if message.flags & USED:
            self._used.add(message.id)
        deselected = message.id in self._used and not message.flags & USED
        self._id = message.id if plausible and not deselected and not message.flags & UNHEALTHY else None
        return None if self._id is None else float(message.airspeed)
