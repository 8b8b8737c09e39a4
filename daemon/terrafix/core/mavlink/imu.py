"""Inertial messages of MAVLink in SI units. Knows the fields, not the wire: live link and recorded logs share it."""

from collections import Counter
from typing import Any

GRAVITY_MPS2 = 9.80665  # of a milli-g in MAVLink's scaled messages
# First IMU before the others; HIGHRES_IMU is the only one in floats. RAW_IMU has these units from ArduPilot alone.
KINDS = ("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU", "SCALED_IMU2")
MAX_FORCE_MPS2 = 32.0 * GRAVITY_MPS2  # of the 16 bits that milli-g travel in: there, a reading is saturated ...
MAX_RATE_RADPS = 32.0  # ... and so are milliradians per second
MAX_BOOT_US = 10**14  # three years; more is a UNIX time

Readings = tuple[float, float, float, float, float, float]


def readings_of(message: Any) -> Readings | None:
    """Specific force forward, right, down [m/s^2] and angular velocity [rad/s]; None: not a number, or saturated."""
    scale = (1.0, 1.0) if message.get_type() == "HIGHRES_IMU" else (GRAVITY_MPS2 * 1e-3, 1e-3)
    force = tuple(scale[0] * v for v in (message.xacc, message.yacc, message.zacc))
    rate = tuple(scale[1] * v for v in (message.xgyro, message.ygyro, message.zgyro))
    # Written so that a NaN fails, too.
    if not (all(abs(f) < MAX_FORCE_MPS2 for f in force) and all(abs(w) < MAX_RATE_RADPS for w in rate)):
        return None
    return (force[0], force[1], force[2], rate[0], rate[1], rate[2])


def boot_ns(message: Any) -> int | None:
    """Time since the autopilot's boot; None when the message has another clock."""
    if hasattr(message, "time_boot_ms"):
        return int(message.time_boot_ms) * 1_000_000
    boot_us = int(message.time_usec)
    return boot_us * 1000 if 0 < boot_us < MAX_BOOT_US else None


class Chooser:
    """One inertial stream of those that come: the first that is heard, until another comes that much more often.

    ArduPilot sends its other IMUs at 1 Hz unless somebody asks for more. One of them may be the first that is heard,
    and with one reading a second a whole flight has no IMU."""

    AHEAD = 3  # readings of another stream between two of the chosen one, which is slower then, or gone

    def __init__(self) -> None:
        self._kind = ""
        self._since: Counter[str] = Counter()  # of the others, since the chosen one was heard

    def takes(self, kind: str) -> bool:
        if kind not in KINDS:
            return False
        self._since[kind] += 1
        if self._kind and kind != self._kind and self._since[kind] < self.AHEAD:
            return False
        self._kind = kind
        self._since.clear()
        return True
