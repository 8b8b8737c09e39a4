"""NAMED_VALUE_FLOAT once a second, for the ground station: what GPS_RAW_INT of the autopilot does not show of us.

QGroundControl lists them in its MAVLink inspector, Mission Planner under Quick as MAV_TFX_..."""

import math
from collections.abc import Iterator

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.messages import GpsInput

PERIOD_NS = 1_000_000_000


class NamedValues:
    def __init__(self) -> None:
        self._next_ns: int | None = None

    def messages(self, gps: GpsInput) -> Iterator[mavlink.MAVLink_named_value_float_message]:
        """Names have at most 10 characters. A value that is not known is nan."""
        waiting = self._next_ns is None or gps.t_ns < self._next_ns
        if self._next_ns is None or not waiting:
            self._next_ns = gps.t_ns + PERIOD_NS
        if waiting:
            return
        good = gps.fix_type >= 3
        values = {
            "TFX_FIX": float(gps.fix_type),
            "TFX_ACC_M": gps.horiz_accuracy_m if good else math.nan,
            "TFX_MAP_S": math.nan if gps.unanchored_s is None else gps.unanchored_s,  # since the last map fix
            "TFX_CAUT": float(gps.caution),  # rung of the caution ladder, 0 to 3
        }
        for name, value in values.items():
            boot_ms = gps.t_ns // 1_000_000 % 2**32
            yield mavlink.MAVLink_named_value_float_message(boot_ms, name.encode(), value)
