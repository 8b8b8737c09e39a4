"""Attitude of a gimbal in MAVLink messages: GIMBAL_DEVICE_ATTITUDE_STATUS, MOUNT_ORIENTATION, MOUNT_STATUS.

All three have roll and pitch against the horizon, and yaw from north or from the heading of the vehicle."""

import math
from collections.abc import Sequence
from typing import Any

from terrafix.messages import GimbalAttitude, Quat

# Of a gimbal that is a component of its own. [spec: MAV_COMP_ID_GIMBAL, MAV_COMP_ID_GIMBAL2 to 6]
GIMBAL_COMPONENTS = frozenset({154, 171, 172, 173, 174, 175})
# Message ids, the preferred one first: quaternions, floats, hundredths of a degree. [spec: MAVLink common.xml]
ATTITUDE_MESSAGES = {"GIMBAL_DEVICE_ATTITUDE_STATUS": 285, "MOUNT_ORIENTATION": 265, "MOUNT_STATUS": 158}
MANAGER_MESSAGE = 281  # GIMBAL_MANAGER_STATUS, which names the device [spec: MAVLink common.xml]
MESSAGE_IDS = frozenset({*ATTITUDE_MESSAGES.values(), MANAGER_MESSAGE})
YAW_LOCK, IN_VEHICLE, IN_EARTH = 16, 32, 64  # [spec: GIMBAL_DEVICE_FLAGS]
AT_A_LIMIT = 1 | 2 | 4  # failure flags with which the attitude still is right [spec: GIMBAL_DEVICE_ERROR_FLAGS]
MAX_NORM_ERROR = 0.01  # of a quaternion, rounded by its sender [spec: its floats have seven digits]


class GimbalReader:
    """``take`` each message of a vehicle and of its gimbals."""

    def __init__(self) -> None:
        self._kind = list(ATTITUDE_MESSAGES)[-1]  # the most preferred one so far
        self._heard: set[int] = set()  # devices
        self._managed = 0  # device that GIMBAL_MANAGER_STATUS names

    def take(self, message: Any, t_ns: int) -> GimbalAttitude | None:
        """-> the attitude in it, at ``t_ns``. None: there is none, or an invalid one, or one of a message that says
        less than another one of the vehicle, or of a device beside that of the gimbal manager."""
        kind, order = message.get_type(), list(ATTITUDE_MESSAGES)
        if kind == "GIMBAL_MANAGER_STATUS":
            self._managed = message.gimbal_device_id
        if kind not in ATTITUDE_MESSAGES or order.index(kind) > order.index(self._kind):
            return None
        device, from_north = 0, False
        if kind == "GIMBAL_DEVICE_ATTITUDE_STATUS":
            device = message.gimbal_device_id or message.get_srcComponent()
            self._heard.add(device)
            if message.failure_flags & ~AT_A_LIMIT or (self._managed in self._heard and device != self._managed):
                return None
            q, from_north = _unit(message.q), yaw_is_from_north(message.flags)
        elif kind == "MOUNT_ORIENTATION":
            q = _from_degrees(message.yaw, message.pitch, message.roll)
        else:
            hundredths = message.pointing_c, message.pointing_a, message.pointing_b
            q = _from_degrees(*(value / 100.0 for value in hundredths))
        if q is None:
            return None
        self._kind = kind
        return GimbalAttitude(t_ns=t_ns, q=q, from_north=from_north, device=device)


def yaw_is_from_north(flags: int) -> bool:
    """By the flags of a gimbal device: earth frame. Senders from before the frame flags mean it by the yaw lock."""
    return bool(flags & IN_EARTH) if flags & (IN_EARTH | IN_VEHICLE) else bool(flags & YAW_LOCK)


def quat_from_euler(yaw_rad: float, pitch_rad: float, roll_rad: float) -> Quat:
    """(w, x, y, z) of Z-Y-X angles, into north, east, down."""
    (cy, sy), (cp, sp), (cr, sr) = ((math.cos(a / 2), math.sin(a / 2)) for a in (yaw_rad, pitch_rad, roll_rad))
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def _from_degrees(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Quat | None:
    if not all(math.isfinite(angle) and abs(angle) <= 720.0 for angle in (yaw_deg, pitch_deg, roll_deg)):
        return None
    return quat_from_euler(math.radians(yaw_deg), math.radians(pitch_deg), math.radians(roll_deg))


def _unit(q: Sequence[float]) -> Quat | None:
    norm = math.sqrt(sum(value * value for value in q))
    if not abs(norm - 1.0) <= MAX_NORM_ERROR:  # also of NaN
        return None
    w, x, y, z = (value / norm for value in q)
    return w, x, y, z
