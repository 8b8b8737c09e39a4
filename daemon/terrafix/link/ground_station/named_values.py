"""NAMED_VALUE_FLOAT once a second for the ground station: state that the autopilot's GPS_RAW_INT does not contain.

QGroundControl lists the values in its MAVLink inspector, Mission Planner under Quick as MAV_TFX_..."""

import math
from collections.abc import Iterator

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.messages import GpsInput

VALUE_PERIOD_NS = 1_000_000_000  # ns between values [tuned]


class NamedValues:
    def __init__(self) -> None:
        self._next_ns: int | None = None

    def messages(self, gps: GpsInput) -> Iterator[mavlink.MAVLink_named_value_float_message]:
        """Names have 10 characters at most (MAVLink). A value that is not known is NaN."""
        waiting = self._next_ns is None or gps.t_ns < self._next_ns
        if self._next_ns is None or not waiting:
            self._next_ns = gps.t_ns + VALUE_PERIOD_NS
        if waiting:
            return
        has_fix = gps.fix_type >= 3
        values = {
            "TFX_FIX": float(gps.fix_type),
            "TFX_ACC_M": gps.horiz_accuracy_m if has_fix else math.nan,
            "TFX_MAP_S": math.nan if gps.unanchored_s is None else gps.unanchored_s,  # since the last map fix
            "TFX_CAUT": float(gps.degradation),  # degradation level, 0 to 3
        }
        for name, value in values.items():
            boot_ms = gps.t_ns // 1_000_000 % 2**32
            yield mavlink.MAVLink_named_value_float_message(boot_ms, name.encode(), value)
