"""Logs of an autopilot, of each format, and the record of the same flight: one made-up flight in both."""

import math
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from flight_records import gps_input, origin, write_record
from terrafix import messages as m
from terrafix.core.autopilot_log.alignment import interpolate
from terrafix.core.autopilot_log.attitude import AttitudeSeries, cleaned
from terrafix.core.mavlink.tlog import record as tlog_record

OFFSET_S, DRIFT = 3.0, 50e-6  # log less record in the middle of the flight; of the log's clock
PLACE = (48.0, 11.0, 500.0)  # latitude, longitude [degrees], height [m AMSL] of the origin
T0_US = 1_717_236_000_000_000  # UNIX time of the zero of a telemetry log


def flight(seed: int, duration_s: float = 120.0, rate_hz: float = 25.0, start_s: float = 20.0) -> AttitudeSeries:
    """Attitude on the clock of the log: swinging of 0.03 to 1 Hz, and gusts."""
    rng = np.random.default_rng(seed)
    t_s = start_s + np.arange(0.0, duration_s, 1.0 / rate_hz)
    angles = []
    for amplitude in (0.2, 0.1, 0.6):
        frequency_hz = np.exp(rng.uniform(math.log(0.03), math.log(1.0), 30))
        phase = rng.uniform(0.0, math.tau, 30)
        swing = np.sin(math.tau * frequency_hz * t_s[:, None] + phase) / (1.0 + (frequency_hz / 0.2) ** 2)
        gusts = np.convolve(rng.normal(0.0, 0.2, t_s.size), np.hanning(round(rate_hz)) / math.sqrt(rate_hz), "same")
        angles.append(amplitude * (swing.sum(axis=1) / math.sqrt(10.0) + gusts))
    return AttitudeSeries(t_s, angles[0], angles[1], np.mod(angles[2] + math.pi, math.tau) - math.pi)


def part(attitude: AttitudeSeries, from_s: float, to_s: float) -> AttitudeSeries:
    keep = (attitude.t_s >= from_s) & (attitude.t_s < to_s)
    columns = (attitude.t_s, attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad)
    return AttitudeSeries(*(column[keep] for column in columns))


def telemetry(
    log: AttitudeSeries, seed: int, rate_hz: float = 10.0, jitter_s: float = 0.005, gaps: int = 2
) -> tuple[AttitudeSeries, Callable[[np.ndarray], np.ndarray]]:
    """-> the attitude as the record has it, and the true time of the log of times of the record.

    The record's clock differs by OFFSET_S and DRIFT. Packets arrive late by an exponential time of mean ``jitter_s``; 2
    % are lost, and all in ``gaps`` of 1 to 6 s."""
    rng = np.random.default_rng(seed)
    at_s = np.arange(log.t_s[0], log.t_s[-1], 1.0 / rate_hz)
    angles, kept = interpolate(log, at_s)
    kept &= rng.random(at_s.size) > 0.02
    for _ in range(gaps):
        begin_s = rng.uniform(at_s[0] + 10.0, at_s[-1] - 16.0)
        kept &= (at_s < begin_s) | (at_s > begin_s + rng.uniform(1.0, 6.0))
    middle_s = 0.5 * (at_s[0] + at_s[-1])
    received_s = middle_s - OFFSET_S + (at_s - middle_s) / (1.0 + DRIFT) + rng.exponential(jitter_s, at_s.size)

    def true_s(record_s: np.ndarray) -> np.ndarray:
        return record_s + OFFSET_S + DRIFT * (record_s - (middle_s - OFFSET_S))

    return cleaned(AttitudeSeries(received_s[kept], *angles[kept].T)), true_s


def write_flight_record(path: Path, attitude: AttitudeSeries, sent: list[m.GpsInput] | None = None) -> Path:
    """Writes a record with the attitude as telemetry, and what was sent."""
    states: list[m.Message] = [
        m.VehicleState(
            t_ns=round(t_s * 1e9),
            source="mavlink",
            roll_rad=float(roll),
            pitch_rad=float(pitch),
            yaw_rad=float(yaw),
        )
        for t_s, roll, pitch, yaw in zip(
            attitude.t_s, attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad, strict=True
        )
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_record(path, [origin(), *sorted([*states, *(sent or [])], key=lambda message: message.t_ns)])
    return path


def sent_at(record_s: np.ndarray, north_m: float = 0.0) -> list[m.GpsInput]:
    """GPS_INPUT at the times, ``north_m`` north of PLACE."""
    lat_deg = PLACE[0] + north_m / 111_000.0
    messages = [gps_input(round(t_s * 1e9)) for t_s in record_s]
    changed = []
    for i, message in enumerate(messages):
        fields = {name: getattr(message, name) for name in message.__struct_fields__}
        changed.append(m.GpsInput(**{**fields, "lat_deg": lat_deg + 1e-7 * (i % 7), "lon_deg": PLACE[1]}))
    return changed


# --- ArduPilot DataFlash -------------------------------------------------------------------------

FORMATS = {  # as ArduPilot 4.6 writes them: characters, columns
    "FMT": ("BBnNZ", "Type,Length,Name,Format,Columns"),
    "PARM": ("QNff", "TimeUS,Name,Value,Default"),
    "MSG": ("QZ", "TimeUS,Message"),
    "MODE": ("QMBB", "TimeUS,Mode,ModeNum,Rsn"),
    "EV": ("QB", "TimeUS,Id"),
    "ERR": ("QBB", "TimeUS,Subsys,ECode"),
    "ORGN": ("QBLLe", "TimeUS,Type,Lat,Lng,Alt"),
    "ATT": ("QffffffB", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,AEKF"),
    "IMU": ("QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "RATE": ("Qffffff", "TimeUS,RDes,R,PDes,P,YDes,Y"),
    "POS": ("QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "GPS": ("QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"),
    "GPA": ("QBCCCCfBIH", "TimeUS,I,VDop,HAcc,VAcc,SAcc,YAcc,VV,SMS,Delta"),
    "XKF1": ("QBccCfffffffccce", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD,GX,GY,GZ,OH"),
    "XKF3": ("QBcccccchhhccff", "TimeUS,C,IVN,IVE,IVD,IPN,IPE,IPD,IMX,IMY,IMZ,IYAW,IVT,RErr,ErSc"),
    "XKF4": ("QBHHHHHfffHBIHb", "TimeUS,C,SV,SP,SH,SM,SVT,errRP,OFN,OFE,FS,TS,SS,GPS,PI"),
    "XKFS": ("QBBBBBBBB", "TimeUS,C,MI,BI,GI,AI,SS,GPS_GTA,GPS_CHK_WAIT"),
}
_STRUCT = {"c": "h", "C": "H", "e": "i", "L": "i", "M": "B", "n": "4s", "N": "16s", "Z": "64s"}
_FACTOR = {"c": 100.0, "C": 100.0, "e": 100.0, "L": 1e7}
Row = tuple[str, dict[str, float | str]]  # name of a message, its columns; a column that is missing is 0


def write_dataflash(path: Path, rows: list[Row], formats: dict[str, tuple[str, str]] = FORMATS) -> Path:
    """Writes a binary log."""
    numbers = {name: 128 + i for i, name in enumerate(formats)}
    chunks = []
    for name, (characters, columns) in formats.items():
        size = 3 + struct.calcsize("<" + "".join(_STRUCT.get(c, c) for c in characters))
        texts = (name.encode(), characters.encode(), columns.encode())
        chunks.append(b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", numbers[name], size, *texts))
    for name, fields in rows:
        characters, columns = formats[name]
        values = []
        for character, column in zip(characters, columns.split(","), strict=True):
            value = fields.get(column, "" if character in "nNZ" else 0)
            if isinstance(value, str):
                values.append(value.encode())
            else:
                values.append(float(value) if character in "fd" else round(value * _FACTOR.get(character, 1.0)))
        packed = struct.pack("<" + "".join(_STRUCT.get(c, c) for c in characters), *values)
        chunks.append(b"\xa3\x95" + bytes([numbers[name]]) + packed)
    path.write_bytes(b"".join(chunks))
    return path


def write_dataflash_text(path: Path, rows: list[Row], formats: dict[str, tuple[str, str]] = FORMATS) -> Path:
    """Writes the same as text."""
    lines = [f"FMT, {128 + i}, 89, {name}, {of[0]}, {of[1]}" for i, (name, of) in enumerate(formats.items())]
    for name, fields in rows:
        characters, columns = formats[name]
        cells = zip(characters, columns.split(","), strict=True)
        lines.append(", ".join([name, *(str(fields.get(c, "" if k in "nNZ" else 0)) for k, c in cells)]))
    path.write_text("\n".join(lines) + "\n")
    return path


def attitude_rows(attitude: AttitudeSeries) -> list[Row]:
    rows: list[Row] = []
    for t_s, *angles in zip(attitude.t_s, attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad, strict=True):
        roll, pitch, yaw = (math.degrees(angle) for angle in angles)
        rows.append(("ATT", {"TimeUS": round(t_s * 1e6), "Roll": roll, "Pitch": pitch, "Yaw": yaw % 360.0}))
    return rows


# --- telemetry and PX4 ---------------------------------------------------------------------------


def write_tlog(path: Path, timed: list[tuple[float, mavlink.MAVLink_message]]) -> Path:
    """Writes messages of autopilot 1 with their times of arrival [s]."""
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    path.write_bytes(b"".join(tlog_record(T0_US + round(t_s * 1e6), message.pack(sender)) for t_s, message in timed))
    return path


def attitude_messages(
    attitude: AttitudeSeries, boot_s: float = 0.0
) -> list[tuple[float, mavlink.MAVLink_attitude_message]]:
    """ATTITUDE without latency; ``boot_s``: time of the log at which the autopilot started."""
    return [
        (t_s, mavlink.MAVLink_attitude_message(round((t_s - boot_s) * 1e3), roll, pitch, yaw, 0.1, 0.2, 0.3))
        for t_s, roll, pitch, yaw in zip(
            attitude.t_s, attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad, strict=True
        )
    ]


Topic = tuple[str, int, str, list[tuple[float, ...]]]  # name, instance, fields "float q;...", rows (time [s], values)
_ULOG_STRUCT = {"float": "f", "double": "d", "uint8_t": "B", "uint32_t": "I", "int32_t": "i", "bool": "?"}


def write_ulog(path: Path, topics: list[Topic], texts: list[tuple[float, str]] | None = None) -> Path:
    """Writes a ULog (https://docs.px4.io/main/en/dev_log/ulog_file_format.html): formats, subscriptions, data."""
    chunks = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)]

    def add(kind: str, body: bytes) -> None:
        chunks.append(struct.pack("<HB", len(body), ord(kind)) + body)

    add("B", bytes(40))
    written = set()
    for name, _, fields, _ in topics:
        if name not in written:
            written.add(name)
            add("F", f"{name}:uint64_t timestamp;{fields}".encode())
    data = []
    for number, (name, instance, fields, rows) in enumerate(topics):
        add("A", struct.pack("<BH", instance, number) + name.encode())
        layout = "<HQ"
        for field in fields.strip(";").split(";"):
            kind, _, count = field.split(" ")[0].partition("[")
            layout += (count.rstrip("]") or "1") + _ULOG_STRUCT[kind]
        for t_s, *values in rows:
            data.append((t_s, "D", struct.pack(layout, number, round(t_s * 1e6), *values)))
    for t_s, text in texts or []:
        data.append((t_s, "L", struct.pack("<BQ", ord("6"), round(t_s * 1e6)) + text.encode()))
    for _, kind, body in sorted(data, key=lambda item: item[0]):
        add(kind, body)
    path.write_bytes(b"".join(chunks))
    return path


def attitude_topic(attitude: AttitudeSeries) -> Topic:
    rows = []
    for t_s, *angles in zip(attitude.t_s, attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad, strict=True):
        (cr, cp, cy), (sr, sp, sy) = (np.cos(np.array(angles) / 2), np.sin(np.array(angles) / 2))
        quaternion = (
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        )
        rows.append((float(t_s), *map(float, quaternion)))
    return ("vehicle_attitude", 0, "float[4] q;", rows)
