"""Telemetry logs (.tlog) of a ground station: MAVLink packets, each after its time of arrival.

Format: a record is 8 bytes, big endian, microseconds since 1970, and one packet (MAVLink 1 or 2), as Mission
Planner, QGroundControl and MAVProxy write it. Attitude, height, airspeed and IMU are read; GNSS position and velocity
never."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from terrafix.core.errors import SourceError
from terrafix.core.mavlink.airspeed import AirspeedReader
from terrafix.core.mavlink.home_altitude import TakeOffHeight
from terrafix.core.mavlink.imu import Chooser, boot_ns, readings_of
from terrafix.messages import Imu, ImuSample, VehicleState

AUTOPILOT_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1; a tlog also holds the ground station's and the gimbal's words
MAX_STEP_US = 24 * 3600 * 1_000_000  # a record further than a day from the last one is garbage between packets
MIN_TIME_US = 946_684_800_000_000  # 2000-01-01; smaller numbers are not UNIX times
IMU_BATCH_NS = 100_000_000  # readings of so long are one message
_STAMP = 8  # bytes
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
# best first; VFR_HUD.alt is above sea level, so it only serves relative to the first record, which is the ground
_HEIGHTS = ("GLOBAL_POSITION_INT", "ALTITUDE", "VFR_HUD")


def read_tlog(path: Path, t0_us: int | None = None) -> list[VehicleState]:
    """States in time order. ``t_ns`` is relative to ``t0_us`` (UNIX microseconds), or to the first record.

    One state for each ATTITUDE (yaw, pitch, roll), each AIRSPEED, and each height message of the best kind in the log.
    A cut or damaged record is skipped. Raises SourceError when the file cannot be read or holds no record."""
    t0_us, messages = _messages(path, _STATES, t0_us)
    heights: dict[str, list[VehicleState]] = {kind: [] for kind in _HEIGHTS}
    attitudes: list[VehicleState] = []
    headings: list[VehicleState] = []
    airspeeds: list[VehicleState] = []
    airspeed_of = AirspeedReader()
    hud_ground_m: float | None = None
    armed: bool | None = None
    above = {kind: TakeOffHeight() for kind in _HEIGHTS}
    for t_us, said in messages:
        t_ns = (t_us - t0_us) * 1000
        kind = said.get_type()
        if kind == "HEARTBEAT":
            armed = bool(said.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        elif kind == "ATTITUDE" and _finite(said.roll, said.pitch, said.yaw):
            attitudes.append(
                VehicleState(
                    t_ns=t_ns,
                    source="mavlink",
                    yaw_rad=said.yaw,
                    pitch_rad=said.pitch,
                    roll_rad=said.roll,
                    armed=armed,
                )
            )
        elif kind == "GLOBAL_POSITION_INT":
            agl_m = above[kind].above(said.relative_alt / 1000.0, said.alt / 1000.0, armed)
            heights[kind].append(VehicleState(t_ns=t_ns, source="mavlink", agl_m=agl_m))
        elif kind == "AIRSPEED" and (airspeed_mps := airspeed_of.take(said)) is not None:
            airspeeds.append(VehicleState(t_ns=t_ns, source="mavlink", airspeed_mps=airspeed_mps))
        elif kind == "ALTITUDE" and _finite(said.altitude_relative):
            agl_m = above[kind].above(said.altitude_relative, said.altitude_amsl, armed)
            heights[kind].append(VehicleState(t_ns=t_ns, source="mavlink", agl_m=agl_m))
        elif kind == "VFR_HUD" and _finite(said.alt):
            hud_ground_m = said.alt if hud_ground_m is None else hud_ground_m
            heights[kind].append(VehicleState(t_ns=t_ns, source="mavlink", agl_m=said.alt - hud_ground_m))
            yaw_rad = math.remainder(math.radians(said.heading), math.tau)
            headings.append(VehicleState(t_ns=t_ns, source="mavlink", yaw_rad=yaw_rad))
    height = next((heights[kind] for kind in _HEIGHTS if heights[kind]), [])
    return sorted([*(attitudes or headings), *height, *airspeeds], key=lambda state: state.t_ns)


def read_imu(path: Path, t0_us: int | None = None) -> list[Imu]:
    """Inertial readings in time order, in batches; times as in ``read_tlog``. Empty when the log has none.

    A record's stamp is its arrival; what matters here is the spacing of the readings, and that is in the autopilot's
    own time. It is laid on the log's by the record that travelled fastest. Raises SourceError as ``read_tlog``."""
    t0_us, messages = _messages(path, _INERTIAL, t0_us)
    chooser, kept = Chooser(), list[tuple[int, int, tuple[float, ...]]]()  # arrival, boot time, readings
    boots: list[list[tuple[int, int, tuple[float, ...]]]] = [kept]
    for t_us, said in messages:
        arrived_ns = (t_us - t0_us) * 1000
        readings = readings_of(said)
        if readings is None or not chooser.takes(said.get_type()):
            continue
        since_boot_ns = boot_ns(said)
        measured_ns = arrived_ns if since_boot_ns is None else since_boot_ns
        if kept and measured_ns < kept[-1][1]:  # the autopilot was started again
            kept = []
            boots.append(kept)
        if not kept or measured_ns > kept[-1][1]:
            kept.append((arrived_ns, measured_ns, readings))
    return [batch for boot in boots if boot for batch in _batches(boot)]


def _batches(boot: list[tuple[int, int, tuple[float, ...]]]) -> Iterator[Imu]:
    offset_ns = min(arrived_ns - measured_ns for arrived_ns, measured_ns, _ in boot)
    batch: list[tuple[int, tuple[float, ...]]] = []
    for i, (_, measured_ns, readings) in enumerate(boot):
        t_ns = measured_ns + offset_ns
        batch.append((t_ns, readings))
        if t_ns - batch[0][0] >= IMU_BATCH_NS or i == len(boot) - 1:
            samples: list[ImuSample] = [(t_ns - at_ns, *said) for at_ns, said in batch]  # type: ignore[misc]
            yield Imu(t_ns=t_ns, source="mavlink", samples=samples)
            batch = []


def record(t_us: int, packets: bytes) -> bytes:
    """The records of whole packets that arrived together at ``t_us``, UNIX microseconds."""
    made, at = [], 0
    while at < len(packets):
        length = _packet_length(packets, at)
        made.append(t_us.to_bytes(_STAMP, "big") + packets[at : at + length])
        at += length
    return b"".join(made)


def _messages(path: Path, wanted: set[int], t0_us: int | None) -> tuple[int, Iterator[tuple[int, Any]]]:
    """-> the log's zero in us, and (time in us, message) of the first autopilot that says one of ``wanted``."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from None
    first = next(_records(data), None)
    if first is None:
        raise SourceError(f"{path}: holds no MAVLink record; is it a telemetry log (.tlog)?")
    return first[0] if t0_us is None else t0_us, _decoded(data, wanted)


def _decoded(data: bytes, wanted: set[int]) -> Iterator[tuple[int, Any]]:
    parser, vehicle = mavlink.MAVLink(None), None
    for t_us, packet in _records(data):
        sysid, compid, msgid = _address(packet)
        if compid != AUTOPILOT_COMPONENT or msgid not in wanted or vehicle not in (None, sysid):
            continue
        try:
            said = parser.decode(bytearray(packet))
        except mavlink.MAVError:
            continue
        vehicle = sysid
        yield t_us, said


def _records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(time in us, packet), walking over damage byte by byte until a record fits again."""
    at, last_us = 0, None
    while at + _STAMP + 8 <= len(data):
        length = _packet_length(data, at + _STAMP)
        t_us = int.from_bytes(data[at : at + _STAMP], "big")
        plausible = t_us > MIN_TIME_US and (last_us is None or abs(t_us - last_us) < MAX_STEP_US)
        if length == 0 or not plausible or at + _STAMP + length > len(data):
            at += 1
            continue
        yield t_us, data[at + _STAMP : at + _STAMP + length]
        last_us = t_us
        at += _STAMP + length


def _packet_length(data: bytes, at: int) -> int:
    """Bytes of the packet that begins at ``at``; 0: none begins there. MAVLink serialisation guide."""
    if data[at] == 0xFD:
        signature = 13 if data[at + 2] & 1 else 0
        return 12 + data[at + 1] + signature
    return 8 + data[at + 1] if data[at] == 0xFE else 0


def _address(packet: bytes) -> tuple[int, int, int]:
    """(sysid, compid, message id)"""
    if packet[0] == 0xFD:
        return packet[5], packet[6], int.from_bytes(packet[7:10], "little")
    return packet[3], packet[4], packet[5]


def _finite(*values: float) -> bool:
    return all(math.isfinite(value) for value in values)
