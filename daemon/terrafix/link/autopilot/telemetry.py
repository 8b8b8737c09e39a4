"""What the autopilot says about itself, put together: who it is, attitude, height, IMU, its idea of wall time.

Its position and velocity are not read here. They come out of the filter that hears us (or a spoofed receiver), so they
are never truth and never an independent measurement; resume.py makes a hint of the position."""

import math
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.mavlink.airspeed import AirspeedReader
from terrafix.core.mavlink.home_altitude import TakeOffHeight
from terrafix.core.mavlink.imu import KINDS, Chooser, boot_ns, readings_of
from terrafix.link.admission.boot_clock import NS_PER_MS, WRAP_MS
from terrafix.link.admission.served_autopilot import AUTOPILOT_COMPONENT, is_autopilot_heartbeat
from terrafix.link.autopilot.checkpoint import ArmedAutopilot, LinkCheckpoint
from terrafix.link.autopilot.pressure_height import PressureHeight
from terrafix.link.mavlink.diagnosis import NAMES
from terrafix.link.mavlink.timesync import TimeSync
from terrafix.messages import Imu, ImuSample, VehicleState

HEARTBEAT_TIMEOUT_NS = 3_000_000_000  # three of its heartbeats
FRESH_NS = 1_000_000_000  # an older height, or airspeed, is not that of this attitude
MAX_TRANSPORT_NS = 500_000_000  # a mapped time further from its arrival than this is a wrong mapping
BOOT_WRAP_NS = WRAP_MS * NS_PER_MS
ATTITUDE_MAX_RAD = 4 * math.pi  # roll, pitch and yaw beyond any convention are garbage
HEIGHT_MAX_M = 20_000.0
# Readings are said in batches: at 33 Hz one or two a message. A frame's estimate waits for none of them, so that a
# batch is not longer than the way of a picture through vision.
IMU_BATCH_NS = 40_000_000


class Telemetry:
    """``take`` each decoded message of the autopilot that is served (served_autopilot.py); a VehicleState comes out
    with each ATTITUDE, an Imu with every few readings."""

    def __init__(self, timesync: TimeSync) -> None:
        self._timesync = timesync
        self._heartbeat_ns: int | None = None
        self._height: tuple[int, float] | None = None  # (arrival, metres above take-off)
        self._above = TakeOffHeight()
        self._pressure = PressureHeight()
        self._airspeed: tuple[int, float] | None = None  # (arrival, m/s)
        self._airspeed_of = AirspeedReader()
        self._armed: bool | None = None
        self._serves: ArmedAutopilot | None = None
        self._unix_minus_monotonic_ns: int | None = None
        self.autopilot = "none"
        self.sysid = 0
        self.vehicle_type = int(mavlink.MAV_TYPE_GENERIC)
        self._imu_of = Chooser()
        self._imu: list[tuple[int, tuple[float, ...]]] = []  # (t_ns, readings) not said yet

    def connected(self, now_ns: int) -> bool:
        return self._heartbeat_ns is not None and now_ns - self._heartbeat_ns < HEARTBEAT_TIMEOUT_NS

    def unix_ns(self, now_ns: int) -> int | None:
        """Wall time by the autopilot; it has one only after a GNSS fix or a ground station told it."""
        return None if self._unix_minus_monotonic_ns is None else now_ns + self._unix_minus_monotonic_ns

    def take(self, message: Any, now_ns: int) -> VehicleState | Imu | None:
        kind = message.get_type()
        if kind == "HEARTBEAT":
            self._take_heartbeat(message, now_ns)
            return None
        if message.get_srcSystem() != self.sysid or message.get_srcComponent() != AUTOPILOT_COMPONENT:
            return None
        if kind == "ATTITUDE":
            return self._vehicle_state(message, now_ns)
        if kind in KINDS:
            return self._take_imu(message, kind, now_ns)
        if kind == "GLOBAL_POSITION_INT":
            self._take_height(message.relative_alt / 1000.0, message.alt / 1000.0, now_ns)
        elif kind == "ALTITUDE":
            self._take_height(message.altitude_relative, message.altitude_amsl, now_ns)
        elif kind == "SCALED_PRESSURE":
            self._pressure.read(message.press_abs, now_ns)
        elif kind == "AIRSPEED":
            if (airspeed_mps := self._airspeed_of.take(message)) is not None:
                self._airspeed = (now_ns, airspeed_mps)
        elif kind == "SYSTEM_TIME" and message.time_unix_usec > 0:
            self._unix_minus_monotonic_ns = message.time_unix_usec * 1000 - now_ns
        return None

    def served(self, kept: LinkCheckpoint, now_ns: int) -> None:
        """By the link before this one, until a moment ago: as if its heartbeat had come now."""
        self._is_there(kept.autopilot, now_ns, armed=True)
        self._above = TakeOffHeight(kept.home_moved_m)
        self._pressure = PressureHeight(kept.pressure_zero_m)

    def rebooted(self) -> None:
        """Heights were those of another boot."""
        self._height, self._above, self._pressure = None, TakeOffHeight(), PressureHeight()

    @property
    def home_moved_m(self) -> float:
        """By how much home has risen since take-off."""
        return self._above.moved_m

    @property
    def pressure_zero_m(self) -> float | None:
        """See PressureHeight."""
        return self._pressure.zero_m

    @property
    def armed_autopilot(self) -> ArmedAutopilot | None:
        return self._serves if self._armed else None

    def _is_there(self, autopilot: ArmedAutopilot, now_ns: int, *, armed: bool) -> None:
        self._serves, self._armed, self._heartbeat_ns = autopilot, armed, now_ns
        self.autopilot = NAMES.get(autopilot.firmware, f"autopilot {autopilot.firmware}")
        self.sysid, self.vehicle_type = autopilot.sysid, autopilot.vehicle

    def _take_heartbeat(self, message: Any, now_ns: int) -> None:
        if not is_autopilot_heartbeat(message):
            return
        heard = ArmedAutopilot(message.get_srcSystem(), int(message.autopilot), int(message.type))
        self._is_there(heard, now_ns, armed=bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED))

    def _take_height(self, relative_m: float, amsl_m: float, now_ns: int) -> None:
        """Above home, by the autopilot's filter."""
        if math.isfinite(relative_m) and abs(relative_m) < HEIGHT_MAX_M:
            above_m = self._above.above(relative_m, amsl_m, self._armed)
            self._height = (now_ns, above_m)
            self._pressure.align(above_m, self._armed, now_ns)

    def _height_m(self, now_ns: int) -> float | None:
        """Above take-off: without a sensor nobody knows the height above the ground beneath. By pressure; by the filter
        where that is not told."""
        by_pressure_m = self._pressure.height_m(now_ns)
        return _fresh(self._height, now_ns) if by_pressure_m is None else by_pressure_m

    def _vehicle_state(self, message: Any, now_ns: int) -> VehicleState | None:
        angles = (message.yaw, message.pitch, message.roll)
        if not all(math.isfinite(a) and abs(a) <= ATTITUDE_MAX_RAD for a in angles):
            return None
        return VehicleState(
            t_ns=self.measured_ns(message.time_boot_ms * 1_000_000, now_ns),
            source="mavlink",
            yaw_rad=math.remainder(message.yaw, math.tau),
            pitch_rad=message.pitch,
            roll_rad=message.roll,
            agl_m=self._height_m(now_ns),
            armed=self._armed if self.connected(now_ns) else None,
            airspeed_mps=_fresh(self._airspeed, now_ns),
        )

    def _take_imu(self, message: Any, kind: str, now_ns: int) -> Imu | None:
        readings = readings_of(message)
        if readings is None or not self._imu_of.takes(kind):
            return None
        since_boot_ns = boot_ns(message)
        t_ns = now_ns if since_boot_ns is None else self.measured_ns(since_boot_ns, now_ns)
        if self._imu and t_ns <= self._imu[-1][0]:
            return None  # repeated, or the mapping of the clocks has just moved
        self._imu.append((t_ns, readings))
        if t_ns - self._imu[0][0] < IMU_BATCH_NS:
            return None
        samples: list[ImuSample] = [(t_ns - at_ns, *said) for at_ns, said in self._imu]  # type: ignore[misc]
        self._imu.clear()
        return Imu(t_ns=t_ns, source="mavlink", samples=samples)

    def measured_ns(self, since_boot_ns: int, now_ns: int) -> int:
        """When it was measured, on our clock; the time of arrival while the clocks are not in step."""
        ours_ns = self._timesync.to_ours(since_boot_ns)
        if ours_ns is None:
            return now_ns
        ours_ns += round((now_ns - ours_ns) / BOOT_WRAP_NS) * BOOT_WRAP_NS
        if abs(now_ns - ours_ns) > MAX_TRANSPORT_NS:
            return now_ns
        return min(ours_ns, now_ns)


def _fresh(said: tuple[int, float] | None, now_ns: int) -> float | None:
    """``said``: (arrival, value)"""
    return said[1] if said is not None and now_ns - said[0] < FRESH_NS else None
