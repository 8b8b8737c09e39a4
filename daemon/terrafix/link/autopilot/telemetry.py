"""Telemetry of the served autopilot: identity, attitude, height, airspeed, IMU and wall clock.

Its position and velocity are not read here: they come from the EKF that fuses our GPS_INPUT (or a spoofed receiver), so
they are not independent measurements. autopilot_prior.py makes a position hint of the position."""

import math
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.clock import NS_PER_MS
from terrafix.core.mavlink.airspeed import AirspeedReader
from terrafix.core.mavlink.exposure import exposure_of
from terrafix.core.mavlink.gimbal import ATTITUDE_MESSAGES, GimbalReader
from terrafix.core.mavlink.home_altitude import TakeOffHeight
from terrafix.core.mavlink.imu import IMU_BATCH_NS, IMU_MESSAGES, ImuStreamSelector, boot_ns, imu_readings
from terrafix.core.mavlink.vehicles import AUTOPILOT_COMPONENT
from terrafix.link.admission.boot_clock import WRAP_MS
from terrafix.link.admission.served_autopilot import is_autopilot_heartbeat
from terrafix.link.autopilot.checkpoint import ArmedAutopilot, LinkCheckpoint
from terrafix.link.autopilot.pressure_height import PressureHeight
from terrafix.link.mavlink.diagnosis import FIRMWARE_NAMES
from terrafix.link.mavlink.timesync import TimeSync
from terrafix.messages import CandidateAttitude, Exposure, GimbalAttitude, Imu, ImuSample, VehicleState

HEARTBEAT_TIMEOUT_NS = 3_000_000_000  # three heartbeats [tuned]
SENSOR_TIMEOUT_NS = 1_000_000_000  # an older height or airspeed is not published with an attitude [tuned]
MAX_TRANSPORT_NS = 500_000_000  # a mapped time further from the time of arrival is a wrong mapping [tuned]
BOOT_WRAP_NS = WRAP_MS * NS_PER_MS
MAX_ATTITUDE_RAD = 4 * math.pi  # larger angles fit no convention: the message is invalid [tuned]
MAX_HEIGHT_M = 20_000.0  # larger heights are ignored [tuned]


class TelemetryDecoder:
    """Processes each decoded message of the served autopilot (served_autopilot.py): -> a VehicleState with each
    ATTITUDE, an Imu with each batch of readings."""

    def __init__(self, timesync: TimeSync) -> None:
        self._timesync = timesync
        self._heartbeat_ns: int | None = None
        self._ekf_height: tuple[int, float] | None = None  # (time received, m above take-off)
        self._takeoff_height = TakeOffHeight()
        self._pressure = PressureHeight()
        self._airspeed: tuple[int, float] | None = None  # (time received, m/s)
        self._airspeed_reader = AirspeedReader()
        self._gimbal = GimbalReader()
        self._armed: bool | None = None
        self._identity: ArmedAutopilot | None = None
        self._unix_minus_monotonic_ns: int | None = None
        self.firmware = "none"
        self.sysid = 0
        self.vehicle_type = int(mavlink.MAV_TYPE_GENERIC)
        self._imu_chooser = ImuStreamSelector()
        self._imu_batch: list[tuple[int, tuple[float, ...]]] = []  # (t_ns, readings) not published yet

    def connected(self, now_ns: int) -> bool:
        return self._heartbeat_ns is not None and now_ns - self._heartbeat_ns < HEARTBEAT_TIMEOUT_NS

    def unix_ns(self, now_ns: int) -> int | None:
        """-> Unix time by the autopilot's SYSTEM_TIME; None until it has one, from a GNSS fix or a ground station."""
        return None if self._unix_minus_monotonic_ns is None else now_ns + self._unix_minus_monotonic_ns

    def on_message(self, message: Any, now_ns: int) -> VehicleState | Imu | None:
        kind = message.get_type()
        if kind == "HEARTBEAT":
            self._on_heartbeat(message, now_ns)
            return None
        if message.get_srcSystem() != self.sysid or message.get_srcComponent() != AUTOPILOT_COMPONENT:
            return None
        if kind == "ATTITUDE":
            return self._vehicle_state(message, now_ns)
        if kind in IMU_MESSAGES:
            return self._on_imu(message, kind, now_ns)
        if kind == "GLOBAL_POSITION_INT":
            self._on_ekf_height(message.relative_alt / 1000.0, message.alt / 1000.0, now_ns)
        elif kind == "ALTITUDE":
            self._on_ekf_height(message.altitude_relative, message.altitude_amsl, now_ns)
        elif kind == "SCALED_PRESSURE":
            self._pressure.on_pressure(message.press_abs, now_ns)
        elif kind == "AIRSPEED":
            if (airspeed_mps := self._airspeed_reader.take(message)) is not None:
                self._airspeed = (now_ns, airspeed_mps)
        elif kind == "SYSTEM_TIME" and message.time_unix_usec > 0:
            self._unix_minus_monotonic_ns = message.time_unix_usec * 1000 - now_ns
        return None

    def on_gimbal(self, message: Any, now_ns: int) -> GimbalAttitude | None:
        """A message of the autopilot, or of a gimbal of its vehicle, whose clock is another one: its time is that of
        arrival."""
        t_ns, kind = now_ns, message.get_type()
        by_autopilot = message.get_srcComponent() == AUTOPILOT_COMPONENT
        if by_autopilot and kind in ATTITUDE_MESSAGES and kind != "MOUNT_STATUS":
            t_ns = self.measured_ns(message.time_boot_ms * NS_PER_MS, now_ns)
        return self._gimbal.take(message, t_ns)

    def on_exposure(self, message: Any, now_ns: int) -> Exposure | None:
        """A message of the autopilot; None: it reports no exposure."""
        read = exposure_of(message)
        if read is None:
            return None
        kind, number, since_boot_ns = read
        t_ns = now_ns if since_boot_ns is None else self.measured_ns(since_boot_ns, now_ns)
        return Exposure(t_ns=t_ns, kind=kind, number=number)

    def restore(self, checkpoint: LinkCheckpoint, now_ns: int) -> None:
        """Restores the state from the checkpoint of the previous link process, as if a heartbeat had arrived now."""
        self._set_autopilot(checkpoint.autopilot, now_ns, armed=True)
        self._takeoff_height = TakeOffHeight(checkpoint.home_moved_m)
        self._pressure = PressureHeight(checkpoint.pressure_zero_m)

    def on_reboot(self) -> None:
        """Drops the heights: their zero belongs to the previous boot."""
        self._ekf_height, self._takeoff_height, self._pressure = None, TakeOffHeight(), PressureHeight()

    @property
    def home_moved_m(self) -> float:
        """Height of home above the take-off point; not 0 if home was moved in flight."""
        return self._takeoff_height.home_rise_m

    @property
    def pressure_zero_m(self) -> float | None:
        """See ``PressureHeight``."""
        return self._pressure.zero_m

    @property
    def armed_autopilot(self) -> ArmedAutopilot | None:
        return self._identity if self._armed else None

    def _set_autopilot(self, autopilot: ArmedAutopilot, now_ns: int, *, armed: bool) -> None:
        self._identity, self._armed, self._heartbeat_ns = autopilot, armed, now_ns
        self.firmware = FIRMWARE_NAMES.get(autopilot.firmware, f"autopilot {autopilot.firmware}")
        self.sysid, self.vehicle_type = autopilot.sysid, autopilot.vehicle

    def _on_heartbeat(self, message: Any, now_ns: int) -> None:
        if not is_autopilot_heartbeat(message):
            return
        identity = ArmedAutopilot(message.get_srcSystem(), int(message.autopilot), int(message.type))
        self._set_autopilot(identity, now_ns, armed=bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED))

    def _on_ekf_height(self, relative_m: float, amsl_m: float, now_ns: int) -> None:
        """Processes the EKF's height above home and above mean sea level."""
        if math.isfinite(relative_m) and abs(relative_m) < MAX_HEIGHT_M:
            ekf_height_m = self._takeoff_height.update(relative_m, amsl_m, self._armed)
            self._ekf_height = (now_ns, ekf_height_m)
            self._pressure.align_zero(ekf_height_m, self._armed, now_ns)

    def _height_m(self, now_ns: int) -> float | None:
        """-> height above take-off, used as height above ground because there is no sensor for it. By pressure; by the
        EKF if no pressure is received."""
        by_pressure_m = self._pressure.height_m(now_ns)
        return _if_fresh(self._ekf_height, now_ns) if by_pressure_m is None else by_pressure_m

    def _vehicle_state(self, message: Any, now_ns: int) -> VehicleState | None:
        if not _has_angles(message):
            return None
        return VehicleState(
            t_ns=self.measured_ns(message.time_boot_ms * 1_000_000, now_ns),
            source="mavlink",
            yaw_rad=math.remainder(message.yaw, math.tau),
            pitch_rad=message.pitch,
            roll_rad=message.roll,
            agl_m=self._height_m(now_ns),
            armed=self._armed if self.connected(now_ns) else None,
            airspeed_mps=_if_fresh(self._airspeed, now_ns),
        )

    def _on_imu(self, message: Any, kind: str, now_ns: int) -> Imu | None:
        readings = imu_readings(message)
        if readings is None or not self._imu_chooser.accepts(kind):
            return None
        since_boot_ns = boot_ns(message)
        t_ns = now_ns if since_boot_ns is None else self.measured_ns(since_boot_ns, now_ns)
        if self._imu_batch and t_ns <= self._imu_batch[-1][0]:
            return None  # repeated, or the mapping of the clocks has just moved
        self._imu_batch.append((t_ns, readings))
        if t_ns - self._imu_batch[0][0] < IMU_BATCH_NS:
            return None
        samples: list[ImuSample] = [(t_ns - at_ns, *values) for at_ns, values in self._imu_batch]  # type: ignore[misc]
        self._imu_batch.clear()
        return Imu(t_ns=t_ns, source="mavlink", samples=samples)

    def measured_ns(self, since_boot_ns: int, now_ns: int) -> int:
        """-> local time of a measurement from its time since boot; the time of arrival while TIMESYNC has no offset."""
        local_ns = self._timesync.to_local_ns(since_boot_ns)
        if local_ns is None:
            return now_ns
        local_ns += round((now_ns - local_ns) / BOOT_WRAP_NS) * BOOT_WRAP_NS
        if abs(now_ns - local_ns) > MAX_TRANSPORT_NS:
            return now_ns
        return min(local_ns, now_ns)


def candidate_attitude(message: Any, now_ns: int) -> CandidateAttitude | None:
    """-> the attitude in an ATTITUDE message of any vehicle, at its arrival: the clock of one alone is known; None if
    it is invalid."""
    if not _has_angles(message):
        return None
    return CandidateAttitude(
        t_ns=now_ns,
        sysid=message.get_srcSystem(),
        yaw_rad=math.remainder(message.yaw, math.tau),
        pitch_rad=message.pitch,
        roll_rad=message.roll,
    )


def _has_angles(message: Any) -> bool:
    """True if the angles of an ATTITUDE message are valid."""
    return all(math.isfinite(a) and abs(a) <= MAX_ATTITUDE_RAD for a in (message.yaw, message.pitch, message.roll))


def _if_fresh(reading: tuple[int, float] | None, now_ns: int) -> float | None:
    """``reading``: (time received, value). -> the value; None if it is too old."""
    return reading[1] if reading is not None and now_ns - reading[0] < SENSOR_TIMEOUT_NS else None
