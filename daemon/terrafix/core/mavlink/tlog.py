"""Telemetry logs (.tlog) of a ground station: MAVLink packets with their arrival times (``log_records``).

Attitude, height, airspeed and IMU of one vehicle are read. GNSS position and velocity are not read. Jumps of the
logging computer's clock are repaired (``log_clock``)."""

import math
from collections import defaultdict
from collections.abc import Iterator, Set
from functools import cached_property
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink  # common has no CAMERA_FEEDBACK

from terrafix.core.errors import SourceError
from terrafix.core.exposures import EXPOSURE_KINDS
from terrafix.core.mavlink import exposure, gimbal
from terrafix.core.mavlink.airspeed import AirspeedReader
from terrafix.core.mavlink.gimbal import GimbalReader
from terrafix.core.mavlink.home_altitude import TakeOffHeight
from terrafix.core.mavlink.imu import IMU_BATCH_NS, MAX_BOOT_US, ImuStreamSelector, boot_ns, imu_readings
from terrafix.core.mavlink.log_clock import Jump, repaired
from terrafix.core.mavlink.log_records import address, payload, read_records, record, sequence
from terrafix.core.mavlink.vehicles import ARMED_FLAG, AUTOPILOT_COMPONENT, HeardVehicle, choose_vehicle, firmware_of
from terrafix.messages import GimbalAttitude, Imu, ImuSample, VehicleState

__all__ = ["TelemetryLog", "is_tlog", "read_imu", "read_tlog", "record"]

CRC_EXTRA = {number: int(kind.crc_extra) for number, kind in mavlink.mavlink_map.items()}
_STATES = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT,
    mavlink.MAVLINK_MSG_ID_ATTITUDE,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
    mavlink.MAVLINK_MSG_ID_ALTITUDE,
    mavlink.MAVLINK_MSG_ID_VFR_HUD,
    mavlink.MAVLINK_MSG_ID_AIRSPEED,
}
_INERTIAL = {
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU,
    mavlink.MAVLINK_MSG_ID_RAW_IMU,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU2,
}
# Bytes of the payload with the time since the start of the autopilot, and its unit in microseconds.
_BOOT_TIMES: dict[int, tuple[int, int, int]] = {
    **dict.fromkeys(
        (
            mavlink.MAVLINK_MSG_ID_ATTITUDE,
            mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
            mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
            mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
            mavlink.MAVLINK_MSG_ID_SCALED_IMU,
            mavlink.MAVLINK_MSG_ID_SCALED_IMU2,
            mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE,
            mavlink.MAVLINK_MSG_ID_RC_CHANNELS,
        ),
        (0, 4, 1000),
    ),
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: (8, 12, 1000),
    mavlink.MAVLINK_MSG_ID_RAW_IMU: (0, 8, 1),
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: (0, 8, 1),
}
# In order of preference. VFR_HUD.alt is above sea level, so it is used relative to the first record, taken as ground.
_HEIGHT_MESSAGES = ("GLOBAL_POSITION_INT", "ALTITUDE", "VFR_HUD")

_TimedReadings = tuple[int, int, tuple[float, ...]]  # arrival time [ns], boot time [ns], readings (imu_readings)


class TelemetryLog:
    """A log, read once. ``t0_us``: UNIX time of its zero in microseconds; default: the first record. ``system_id``: the
    vehicle to read; 0: the only one, or the only one that moves.

    Damaged and cut off records are left out. Raises SourceError when the file cannot be read, holds no record, does not
    have the vehicle, or has several that could be meant."""

    def __init__(self, path: Path, t0_us: int | None = None, system_id: int = 0, dialect: Any = mavlink) -> None:
        try:
            data = path.read_bytes()
        except OSError as error:
            raise SourceError(f"{path}: cannot be read ({error.strerror})") from None
        crc_extra = CRC_EXTRA if dialect is mavlink else {n: int(k.crc_extra) for n, k in dialect.mavlink_map.items()}
        found = read_records(data, crc_extra)
        if not found.packets:
            raise SourceError(f"{path}: holds no MAVLink record; is it a telemetry log (.tlog)?")
        self.path, self._dialect = path, dialect
        self._packets, self.skipped_bytes = found.packets, found.skipped_bytes
        self._addresses = [address(packet) for packet in found.packets]
        self.vehicles = self._heard()
        self.choice = choose_vehicle(self.vehicles, system_id)
        self._check_choice(system_id)
        self.system_id = self.choice.vehicle.system_id if self.choice.vehicle else 0
        clock = repaired(found.stamps_us, self._boot_times_us(), self._numbers())
        self.jumps, self.damaged_stamps = clock.jumps, clock.damaged_stamps
        self._times_us = clock.times_us
        self.t0_us = clock.times_us[0] if t0_us is None else t0_us
        self.clock = "arrival times of its records"
        self.zero = "the first record of the log" if t0_us is None else "[telemetry] tlog_t0_us"

    def messages(self, wanted: Set[int]) -> Iterator[tuple[int, Any]]:
        """(time [us since 1970], message) for all ``wanted`` message ids of the vehicle's autopilot; those of gimbals
        also of its gimbals."""
        for t_us, packet, (system_id, component_id, message_id) in zip(
            self._times_us, self._packets, self._addresses, strict=True
        ):
            by_gimbal = component_id in gimbal.GIMBAL_COMPONENTS and message_id in gimbal.MESSAGE_IDS
            ours = system_id == self.system_id and (component_id == AUTOPILOT_COMPONENT or by_gimbal)
            if ours and message_id in wanted:
                message = self._decoded(packet)
                if message is not None:
                    yield t_us, message

    @cached_property
    def states(self) -> list[VehicleState]:
        """States in time order; ``t_ns`` from the zero of the log.

        One state for each ATTITUDE (yaw, pitch, roll), each AIRSPEED, and each height message of the preferred type in
        the log."""
        return _states(self.t0_us, self.messages(_STATES))

    @cached_property
    def imu(self) -> list[Imu]:
        """IMU samples in time order, in batches; times as in ``states``. Empty when the log has none.

        The time stamp of a record is its arrival time. Integration needs the intervals of the autopilot's own clock, so
        the samples keep their boot time plus a constant offset: the least difference between arrival and boot time in
        the log, that of the packet with the least latency."""
        return _inertial(self.t0_us, self.messages(_INERTIAL))

    @cached_property
    def gimbal(self) -> list[GimbalAttitude]:
        """Of the vehicle's gimbal, in time order; times, those of arrival, as in ``states``."""
        reader = GimbalReader()
        timed = ((message, (t_us - self.t0_us) * 1000) for t_us, message in self.messages(gimbal.MESSAGE_IDS))
        return [attitude for one in timed if (attitude := reader.take(*one)) is not None]

    @cached_property
    def exposures(self) -> dict[str, list[int]]:
        """Times of the exposures of each kind, the preferred one first, in order. With the time of the autopilot's
        clock they are as far apart as on it, and arrive as the fastest of them."""
        found: dict[str, list[tuple[int, int | None]]] = {kind: [] for kind in EXPOSURE_KINDS}
        for t_us, message in self.messages(exposure.EXPOSURE_MESSAGE_IDS):
            if (read := exposure.exposure_of(message)) is not None:
                found[read[0]].append(((t_us - self.t0_us) * 1000, read[2]))
        times: dict[str, list[int]] = {}
        for kind, of_kind in found.items():
            late_ns = min((arrived - boot for arrived, boot in of_kind if boot is not None), default=0)
            at_ns = {arrived if boot is None else boot + late_ns for arrived, boot in of_kind}
            if at_ns:
                times[kind] = sorted(at_ns)
        return times

    def notes(self) -> list[str]:
        """Which vehicle was chosen and what was repaired, in words."""
        found = []
        if len(self.vehicles) > 1:
            others = ", ".join(vehicle.text() for vehicle in self.vehicles)
            found.append(f"vehicles heard: {others}; vehicle {self.system_id} is read, {self.choice.why}")
        found += [jump_text(jump, (self._times_us[jump.index] - self.t0_us) * 1e-6) for jump in self.jumps]
        if self.damaged_stamps:
            found.append(f"{self.damaged_stamps} damaged time stamps of the log: repaired by the records beside them")
        return found

    def _decoded(self, packet: bytes) -> Any:
        try:
            return self._dialect.MAVLink(None).decode(bytearray(packet))
        except self._dialect.MAVError:
            return None

    def _heard(self) -> list[HeardVehicle]:
        """The autopilots, with what tells them apart where there are several."""
        heard: dict[int, HeardVehicle] = {}
        for system_id, component_id, _ in self._addresses:
            if component_id == AUTOPILOT_COMPONENT:
                heard.setdefault(system_id, HeardVehicle(system_id)).packets += 1
        if not heard:
            return []
        several = len(heard) > 1
        for packet, (system_id, component_id, message_id) in zip(self._packets, self._addresses, strict=True):
            vehicle = heard.get(system_id)
            if vehicle is None or component_id != AUTOPILOT_COMPONENT or message_id not in _STATES:
                continue
            is_heartbeat = message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT
            vehicle.readings += not is_heartbeat
            if not several and not (is_heartbeat and vehicle.vehicle_type is None):
                continue
            message = self._decoded(packet)
            if message is not None:
                _note(vehicle, message)
        return list(heard.values())

    def _check_choice(self, system_id: int) -> None:
        if self.choice.vehicle is not None or (not self.vehicles and not system_id):
            return
        heard = ", ".join(vehicle.text() for vehicle in self.vehicles) or "none"
        if system_id:
            raise SourceError(f"{self.path}: has no vehicle {system_id}; heard: {heard}")
        raise SourceError(
            f"{self.path}: several vehicles could be meant: {heard}; choose one: --system, or [telemetry] system_id of "
            "flight.toml"
        )

    def _boot_times_us(self) -> list[int | None]:
        """Of each record of the vehicle, from the messages whose time runs; those of inertial sensors alone only where
        no other says it, since theirs may be UNIX time."""
        by_kind: defaultdict[int, dict[int, int]] = defaultdict(dict)
        for i, (system_id, component_id, message_id) in enumerate(self._addresses):
            place = _BOOT_TIMES.get(message_id)
            if place is None or component_id != AUTOPILOT_COMPONENT or system_id != self.system_id:
                continue
            begin, end, unit_us = place
            value_us = int.from_bytes(payload(self._packets[i]).ljust(end, b"\0")[begin:end], "little") * unit_us
            if 0 < value_us < MAX_BOOT_US:
                by_kind[message_id][i] = value_us
        running = {kind: found for kind, found in by_kind.items() if len(set(found.values())) > len(found) // 2}
        times_us: list[int | None] = [None] * len(self._addresses)
        for milliseconds in (True, False):
            for kind, found in running.items():
                if (_BOOT_TIMES[kind][2] > 1) is milliseconds:
                    for i, value_us in found.items():
                        times_us[i] = value_us
            if any(value is not None for value in times_us):
                break
        return times_us

    def _numbers(self) -> list[int | None]:
        mine = (self.system_id, AUTOPILOT_COMPONENT)
        return [
            sequence(packet) if sender[:2] == mine else None
            for packet, sender in zip(self._packets, self._addresses, strict=True)
        ]


def jump_text(jump: Jump, at_s: float) -> str:
    """A jump of the log's clock in words; ``at_s``: when, from the zero of the log."""
    size_s = jump.size_us * 1e-6
    size = f"{size_s:+.1f} s" if abs(size_s) < 86_400 else f"{size_s / 86_400:+.2f} days"
    how = (
        "repaired by the autopilot's time" if jump.measured else "taken for no gap, since no packet says the true time"
    )
    return f"the clock of the log jumps by {size} at {at_s:.1f} s: {how}"


def is_tlog(head: bytes) -> bool:
    """Whether these first bytes of a file hold a record."""
    return bool(read_records(head, CRC_EXTRA).packets)


def read_tlog(path: Path, t0_us: int | None = None, system_id: int = 0) -> list[VehicleState]:
    """``TelemetryLog.states`` of a file. Raises SourceError."""
    return TelemetryLog(path, t0_us, system_id).states


def read_imu(path: Path, t0_us: int | None = None, system_id: int = 0) -> list[Imu]:
    """``TelemetryLog.imu`` of a file. Raises SourceError."""
    return TelemetryLog(path, t0_us, system_id).imu


def _note(vehicle: HeardVehicle, message: Any) -> None:
    kind = message.get_type()
    if kind == "HEARTBEAT":
        if vehicle.vehicle_type is None:
            vehicle.vehicle_type = message.type
            vehicle.firmware = firmware_of(message.autopilot, message.type)
        vehicle.armed |= bool(message.base_mode & ARMED_FLAG)
    elif kind == "ATTITUDE":
        vehicle.angles_rad.append((message.roll, message.pitch, message.yaw))
    elif kind == "GLOBAL_POSITION_INT":
        vehicle.speed_mps = max(vehicle.speed_mps, math.hypot(message.vx, message.vy) / 100.0)


def _states(t0_us: int, messages: Iterator[tuple[int, Any]]) -> list[VehicleState]:
    heights: dict[str, list[VehicleState]] = {kind: [] for kind in _HEIGHT_MESSAGES}
    attitudes: list[VehicleState] = []
    headings: list[VehicleState] = []
    airspeeds: list[VehicleState] = []
    airspeed_of = AirspeedReader()
    hud_ground_m: float | None = None
    armed: bool | None = None
    takeoff_heights = {kind: TakeOffHeight() for kind in _HEIGHT_MESSAGES}
    for t_us, message in messages:
        t_ns = (t_us - t0_us) * 1000
        kind = message.get_type()
        if kind == "HEARTBEAT":
            armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        elif kind == "ATTITUDE" and _finite(message.roll, message.pitch, message.yaw):
            attitudes.append(
                VehicleState(
                    t_ns=t_ns,
                    source="mavlink",
                    yaw_rad=message.yaw,
                    pitch_rad=message.pitch,
                    roll_rad=message.roll,
                    armed=armed,
                )
            )
        elif kind == "GLOBAL_POSITION_INT":
            agl_m = takeoff_heights[kind].update(message.relative_alt / 1000.0, message.alt / 1000.0, armed)
            heights[kind].append(VehicleState(t_ns=t_ns, source="mavlink", agl_m=agl_m))
        elif kind == "AIRSPEED" and (airspeed_mps := airspeed_of.take(message)) is not None:
            airspeeds.append(VehicleState(t_ns=t_ns, source="mavlink", airspeed_mps=airspeed_mps))
        elif kind == "ALTITUDE" and _finite(message.altitude_relative):
            agl_m = takeoff_heights[kind].update(message.altitude_relative, message.altitude_amsl, armed)
            heights[kind].append(VehicleState(t_ns=t_ns, source="mavlink", agl_m=agl_m))
        elif kind == "VFR_HUD" and _finite(message.alt):
            hud_ground_m = message.alt if hud_ground_m is None else hud_ground_m
            heights[kind].append(VehicleState(t_ns=t_ns, source="mavlink", agl_m=message.alt - hud_ground_m))
            yaw_rad = math.remainder(math.radians(message.heading), math.tau)
            headings.append(VehicleState(t_ns=t_ns, source="mavlink", yaw_rad=yaw_rad))
    height = next((heights[kind] for kind in _HEIGHT_MESSAGES if heights[kind]), [])
    return sorted([*(attitudes or headings), *height, *airspeeds], key=lambda state: state.t_ns)


def _inertial(t0_us: int, messages: Iterator[tuple[int, Any]]) -> list[Imu]:
    selector = ImuStreamSelector()
    samples_of_boot: list[_TimedReadings] = []
    boots = [samples_of_boot]
    for t_us, message in messages:
        arrived_ns = (t_us - t0_us) * 1000
        readings = imu_readings(message)
        if readings is None or not selector.accepts(message.get_type()):
            continue
        since_boot_ns = boot_ns(message)
        measured_ns = arrived_ns if since_boot_ns is None else since_boot_ns
        if samples_of_boot and measured_ns < samples_of_boot[-1][1]:  # the autopilot has rebooted
            samples_of_boot = []
            boots.append(samples_of_boot)
        if not samples_of_boot or measured_ns > samples_of_boot[-1][1]:
            samples_of_boot.append((arrived_ns, measured_ns, readings))
    return [batch for boot in boots if boot for batch in _batches(boot)]


def _batches(boot: list[_TimedReadings]) -> Iterator[Imu]:
    offset_ns = min(arrived_ns - measured_ns for arrived_ns, measured_ns, _ in boot)
    batch: list[tuple[int, tuple[float, ...]]] = []
    for i, (_, measured_ns, readings) in enumerate(boot):
        t_ns = measured_ns + offset_ns
        batch.append((t_ns, readings))
        if t_ns - batch[0][0] >= IMU_BATCH_NS or i == len(boot) - 1:
            samples: list[ImuSample] = [(t_ns - at_ns, *values) for at_ns, values in batch]  # type: ignore[misc]
            yield Imu(t_ns=t_ns, source="mavlink", samples=samples)
            batch = []


def _finite(*values: float) -> bool:
    return all(math.isfinite(value) for value in values)
