"""What the autopilot says about itself, put together: who it is, attitude, height, its idea of wall time.

Its position and velocity are not read. They come out of the filter that hears us (or a spoofed receiver), so they
are never truth and never an independent measurement."""

import math
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.link.timesync import TimeSync
from terrafix.messages import VehicleState

HEARTBEAT_TIMEOUT_NS = 3_000_000_000  # three of its heartbeats
HEIGHT_FRESH_NS = 1_000_000_000  # an older height is not the height of this attitude
MAX_TRANSPORT_NS = 500_000_000  # a mapped time further from its arrival than this is a wrong mapping
REBOOT_BACK_MS = 1_000  # boot time that steps back by more is a new boot
ATTITUDE_MAX_RAD = 4 * math.pi  # roll, pitch and yaw beyond any convention are garbage
HEIGHT_MAX_M = 20_000.0
NAMES = {mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot", mavlink.MAV_AUTOPILOT_PX4: "px4"}
# A ground station, a camera or another companion has a heartbeat too; an autopilot names its firmware.
AUTOPILOT_COMPONENT = mavlink.MAV_COMP_ID_AUTOPILOT1


class Telemetry:
    """``take`` each decoded message; a VehicleState comes out with each ATTITUDE."""

    def __init__(self, timesync: TimeSync) -> None:
        self._timesync = timesync
        self._heartbeat_ns: int | None = None
        self._height: tuple[int, float] | None = None  # (arrival, metres above take-off)
        self._boot_ms = 0
        self._armed: bool | None = None
        self._unix_minus_monotonic_ns: int | None = None
        self.autopilot = "none"
        self.sysid = 0
        self.seen_ns: dict[int, int] = {}  # message id -> arrival, of the streams asked for

    def connected(self, now_ns: int) -> bool:
        return self._heartbeat_ns is not None and now_ns - self._heartbeat_ns < HEARTBEAT_TIMEOUT_NS

    def unix_ns(self, now_ns: int) -> int | None:
        """Wall time by the autopilot; it has one only after a GNSS fix or a ground station told it."""
        return None if self._unix_minus_monotonic_ns is None else now_ns + self._unix_minus_monotonic_ns

    def take(self, message: Any, now_ns: int) -> VehicleState | None:
        kind = message.get_type()
        if kind == "HEARTBEAT":
            self._take_heartbeat(message, now_ns)
            return None
        if message.get_srcSystem() != self.sysid or message.get_srcComponent() != AUTOPILOT_COMPONENT:
            return None
        self.seen_ns[message.get_msgId()] = now_ns
        if kind == "ATTITUDE":
            return self._vehicle_state(message, now_ns)
        if kind == "GLOBAL_POSITION_INT":
            self._take_height(message.relative_alt / 1000.0, now_ns)
        elif kind == "ALTITUDE":
            self._take_height(message.altitude_relative, now_ns)
        elif kind == "SYSTEM_TIME" and message.time_unix_usec > 0:
            self._unix_minus_monotonic_ns = message.time_unix_usec * 1000 - now_ns
        return None

    def _take_heartbeat(self, message: Any, now_ns: int) -> None:
        if message.autopilot == mavlink.MAV_AUTOPILOT_INVALID or message.get_srcComponent() != AUTOPILOT_COMPONENT:
            return
        if self.connected(now_ns) and message.get_srcSystem() != self.sysid:
            return  # another vehicle on the same network
        self.autopilot = NAMES.get(message.autopilot, f"autopilot {message.autopilot}")
        self.sysid = message.get_srcSystem()
        self._armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        self._heartbeat_ns = now_ns

    def _take_height(self, height_m: float, now_ns: int) -> None:
        """Above take-off, by the barometer: without a sensor nobody knows the height above the ground beneath."""
        if math.isfinite(height_m) and abs(height_m) < HEIGHT_MAX_M:
            self._height = (now_ns, height_m)

    def _vehicle_state(self, message: Any, now_ns: int) -> VehicleState | None:
        angles = (message.yaw, message.pitch, message.roll)
        if not all(math.isfinite(a) and abs(a) <= ATTITUDE_MAX_RAD for a in angles):
            return None
        if message.time_boot_ms < self._boot_ms - REBOOT_BACK_MS:
            self._height = None  # take-off height of another boot
        self._boot_ms = message.time_boot_ms
        height = self._height
        return VehicleState(
            t_ns=self._measured_ns(message.time_boot_ms, now_ns),
            source="mavlink",
            yaw_rad=math.remainder(message.yaw, math.tau),
            pitch_rad=message.pitch,
            roll_rad=message.roll,
            agl_m=height[1] if height is not None and now_ns - height[0] < HEIGHT_FRESH_NS else None,
            armed=self._armed if self.connected(now_ns) else None,
        )

    def _measured_ns(self, boot_ms: int, now_ns: int) -> int:
        """When it was measured, on our clock; the time of arrival while the clocks are not in step."""
        ours_ns = self._timesync.to_ours(boot_ms * 1_000_000)
        if ours_ns is None or abs(now_ns - ours_ns) > MAX_TRANSPORT_NS:
            return now_ns
        return min(ours_ns, now_ns)
