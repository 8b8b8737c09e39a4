"""Fields of MAVLink's IMU messages in SI units, for the live link and for recorded logs."""

from collections import Counter
from typing import Any

STANDARD_GRAVITY_MPS2 = 9.80665  # standard gravity, the unit g of MAVLink's scaled messages
# The first IMU before the others; only HIGHRES_IMU carries floats. Only ArduPilot sends RAW_IMU in these units.
IMU_MESSAGES = ("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU", "SCALED_IMU2")
MAX_FORCE_MPS2 = 32.0 * STANDARD_GRAVITY_MPS2  # saturation of the 16-bit fields: milli-g ...
MAX_RATE_RADPS = 32.0  # ... and milliradians per second
MAX_BOOT_US = 10**14  # three years; a greater value is a UNIX time
# Length of a batch of readings, live and from a log: at 33 Hz one or two readings per message. The estimate of a frame
# does not wait for readings: a batch is shorter than the processing time of an image, and with the interval to the next
# reading shorter than MAX_READING_GAP_NS. [tuned]
IMU_BATCH_NS = 40_000_000

Readings = tuple[float, float, float, float, float, float]


def imu_readings(message: Any) -> Readings | None:
    """Specific force forward, right, down [m/s^2] and angular velocity [rad/s]; None: NaN or saturated."""
    scale = (1.0, 1.0) if message.get_type() == "HIGHRES_IMU" else (STANDARD_GRAVITY_MPS2 * 1e-3, 1e-3)
    force = tuple(scale[0] * v for v in (message.xacc, message.yacc, message.zacc))
    rate = tuple(scale[1] * v for v in (message.xgyro, message.ygyro, message.zgyro))
    # In this form the test also rejects NaN.
    if not (all(abs(f) < MAX_FORCE_MPS2 for f in force) and all(abs(w) < MAX_RATE_RADPS for w in rate)):
        return None
    return (force[0], force[1], force[2], rate[0], rate[1], rate[2])


def boot_ns(message: Any) -> int | None:
    """Time since boot of the autopilot; None when the message carries UNIX time."""
    if hasattr(message, "time_boot_ms"):
        return int(message.time_boot_ms) * 1_000_000
    boot_us = int(message.time_usec)
    return boot_us * 1000 if 0 < boot_us < MAX_BOOT_US else None


class ImuStreamSelector:
    """Selects one of several IMU streams: the first one received, until another one has a much higher rate.

    ArduPilot sends its secondary IMUs at 1 Hz unless a higher rate is requested. One of them may be received first, and
    one reading per second would leave the whole flight without usable IMU data."""

    # Number of messages of another stream between two messages of the selected stream that causes a switch.
    SWITCH_AFTER = 3

    def __init__(self) -> None:
        self._kind = ""  # the selected message type
        self._since: Counter[str] = Counter()  # messages of the other streams since the last selected one

    def accepts(self, kind: str) -> bool:
        """Whether a message of type ``kind``, just received, belongs to the selected stream."""
        if kind not in IMU_MESSAGES:
            return False
        self._since[kind] += 1
        if self._kind and kind != self._kind and self._since[kind] < self.SWITCH_AFTER:
            return False
        self._kind = kind
        self._since.clear()
        return True
