"""Telemetry logs (.tlog) of a ground station: MAVLink packets with their arrival times.

Format: a record is 8 bytes, big endian, microseconds since 1970, followed by one packet (MAVLink 1 or 2), as Mission
Planner, QGroundControl and MAVProxy write it. Attitude, height, airspeed and IMU are read. GNSS position and velocity
are not read."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from terrafix.core.errors import SourceError
from terrafix.core.mavlink.airspeed import AirspeedReader
from terrafix.core.mavlink.home_altitude import TakeOffHeight
from terrafix.core.mavlink.imu import ImuStreamSelector, boot_ns, imu_readings
from terrafix.messages import Imu, ImuSample, VehicleState

AUTOPILOT_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1; a tlog also holds messages of the ground station and the gimbal
MAX_STEP_US = 24 * 3600 * 1_000_000  # a record more than a day after or before the last one is corrupt data
MIN_TIME_US = 946_684_800_000_000  # 2000-01-01; an earlier time stamp is invalid
IMU_BATCH_NS = 100_000_000  # duration of the samples in one Imu message
_STAMP = 8  # bytes of the time stamp
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
# In order of preference. VFR_HUD.alt is above sea level, so it is used relative to the first record, taken as ground.
_HEIGHTS = ("GLOBAL_POSITION_INT", "ALTITUDE", "VFR_HUD")

_TimedReadings = tuple[int, int, tuple[float, ...]]  # arrival time [ns], boot time [ns], readings (imu_readings)


def read_tlog(path: Path, t0_us: int | None = None) -> list[VehicleState]:
    """States in time order. ``t_ns`` is relative to ``t0_us`` (UNIX microseconds), or to the first record.

    One state for each ATTITUDE (yaw, pitch, roll), each AIRSPEED, and each height message of the preferred type in the
    log. Truncated and corrupt records are skipped. Raises SourceError when the file cannot be read or holds no
    record."""
    t0_us, messages = read_messages(path, _STATES, t0_us)
    heights: dict[str, list[VehicleState]] = {kind: [] for kind in _HEIGHTS}
    attitudes: list[VehicleState] = []
    headings: list[VehicleState] = []
    airspeeds: list[VehicleState] = []
    airspeed_of = AirspeedReader()
    hud_ground_m: float | None = None
    armed: bool | None = None
    takeoff_heights = {kind: TakeOffHeight() for kind in _HEIGHTS}
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
    height = next((heights[kind] for kind in _HEIGHTS if heights[kind]), [])
    return sorted([*(attitudes or headings), *height, *airspeeds], key=lambda state: state.t_ns)


def read_imu(path: Path, t0_us: int | None = None) -> list[Imu]:
    """IMU samples in time order, in batches; times as in ``read_tlog``. Empty when the log has none.

    The time stamp of a record is its arrival time. Integration needs the intervals of the autopilot's own clock, so the
    samples keep their boot time plus a constant offset: the least difference between arrival and boot time in the log,
    that of the packet with the least latency. Raises SourceError as ``read_tlog``."""
    t0_us, messages = read_messages(path, _INERTIAL, t0_us)
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


def record(t_us: int, packets: bytes) -> bytes:
    """Encodes complete packets that arrived together at ``t_us`` (UNIX microseconds) as records."""
    records, offset = [], 0
    while offset < len(packets):
        length = _packet_length(packets, offset)
        records.append(t_us.to_bytes(_STAMP, "big") + packets[offset : offset + length])
        offset += length
    return b"".join(records)


def is_tlog(head: bytes) -> bool:
    """Whether a file that begins with these bytes begins with a record."""
    return len(head) > _STAMP + 2 and _packet_length(head, _STAMP) > 0 and _time_us(head, 0) > MIN_TIME_US


def read_messages(
    path: Path, wanted: set[int], t0_us: int | None = None, dialect: Any = mavlink
) -> tuple[int, Iterator[tuple[int, Any]]]:
    """-> start time of the log [us], and (time [us], message) for all ``wanted`` message ids of the first autopilot
    that sends one of them. ``dialect``: module of pymavlink that decodes them. Raises SourceError."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from None
    first = next(_records(data), None)
    if first is None:
        raise SourceError(f"{path}: holds no MAVLink record; is it a telemetry log (.tlog)?")
    return first[0] if t0_us is None else t0_us, _decoded(data, wanted, dialect)


def _decoded(data: bytes, wanted: set[int], dialect: Any) -> Iterator[tuple[int, Any]]:
    parser, vehicle = dialect.MAVLink(None), None
    for t_us, packet in _records(data):
        sysid, compid, msgid = _address(packet)
        if compid != AUTOPILOT_COMPONENT or msgid not in wanted or vehicle not in (None, sysid):
            continue
        try:
            message = parser.decode(bytearray(packet))
        except dialect.MAVError:
            continue
        vehicle = sysid
        yield t_us, message


def _records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(time [us], packet) of each record. Skips corrupt data byte by byte until a valid record begins."""
    offset, last_us = 0, None
    while offset + _STAMP + 8 <= len(data):
        length = _packet_length(data, offset + _STAMP)
        t_us = _time_us(data, offset)
        plausible = t_us > MIN_TIME_US and (last_us is None or abs(t_us - last_us) < MAX_STEP_US)
        if length == 0 or not plausible or offset + _STAMP + length > len(data):
            offset += 1
            continue
        yield t_us, data[offset + _STAMP : offset + _STAMP + length]
        last_us = t_us
        offset += _STAMP + length


def _time_us(data: bytes, offset: int) -> int:
    return int.from_bytes(data[offset : offset + _STAMP], "big")


def _packet_length(data: bytes, offset: int) -> int:
    """Length of the packet at ``offset`` in bytes; 0: no packet begins there. From the MAVLink serialisation guide."""
    if data[offset] == 0xFD:
        signature = 13 if data[offset + 2] & 1 else 0
        return 12 + data[offset + 1] + signature
    return 8 + data[offset + 1] if data[offset] == 0xFE else 0


def _address(packet: bytes) -> tuple[int, int, int]:
    """(sysid, compid, message id)"""
    if packet[0] == 0xFD:
        return packet[5], packet[6], int.from_bytes(packet[7:10], "little")
    return packet[3], packet[4], packet[5]


def _finite(*values: float) -> bool:
    return all(math.isfinite(value) for value in values)
