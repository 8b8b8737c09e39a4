"""A telemetry log of a ground station (.tlog) in the common structure.

Attitude, position and velocity carry the autopilot's time since its start. They keep it, plus a constant: the least
difference between arrival and that time, so that only the shortest latency is left. What carries no time (status texts,
modes, receivers, status of the EKF) has its time of arrival. Zero is the first record."""

import math
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.autopilot_log.attitude import AttitudeSeries, cleaned
from terrafix.core.errors import SourceError
from terrafix.core.mavlink.tlog import TelemetryLog
from terrafix.core.mavlink.vehicles import PX4, firmware_of
from terrafix_tools.autopilot_log.ardupilot import mode_name, named_firmware
from terrafix_tools.autopilot_log.structure import (
    AutopilotLog,
    BodyRates,
    EkfTrack,
    Fusion,
    GlobalTrack,
    GpsTrack,
    LogEvent,
    Origin,
    Series,
)

_WANTED = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT,
    mavlink.MAVLINK_MSG_ID_ATTITUDE,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,
    mavlink.MAVLINK_MSG_ID_GPS2_RAW,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS,
    mavlink.MAVLINK_MSG_ID_STATUSTEXT,
}
_REBOOT_S = 1.0  # a step back of the time since the start that is more than packets out of order
# Main mode of PX4's custom_mode, and its sub-modes of "auto" (px4_custom_mode.h)
_PX4_MODES = {1: "manual", 2: "altitude", 3: "position", 4: "auto", 5: "acro", 6: "offboard", 7: "stabilized"}
_PX4_AUTO = 4
_PX4_AUTO_MODES = {2: "takeoff", 3: "loiter", 4: "mission", 5: "return", 6: "land", 8: "follow"}
_RATIOS = {  # field of EKF_STATUS_REPORT, ESTIMATOR_STATUS -> test ratio; both are 1 at the limit of the gate
    "velocity_variance": "velocity",
    "pos_horiz_variance": "position",
    "pos_vert_variance": "height",
    "compass_variance": "mag",
    "airspeed_variance": "airspeed",
    "vel_ratio": "velocity",
    "pos_horiz_ratio": "position",
    "pos_vert_ratio": "height",
    "mag_ratio": "mag",
    "tas_ratio": "airspeed",
}

_Timed = list[tuple[float, Any]]  # arrival [s], message


def read_telemetry(path: Path, system_id: int = 0) -> AutopilotLog:
    """``system_id``: the vehicle to read; 0: the only one, or the only one that moves. Raises SourceError when the file
    cannot be read, is no telemetry log, has no such vehicle, or has no attitude of it."""
    records = TelemetryLog(path, system_id=system_id, dialect=mavlink)
    found: defaultdict[str, _Timed] = defaultdict(list)
    for t_us, message in records.messages(_WANTED):
        found[message.get_type()].append(((t_us - records.t0_us) * 1e-6, message))
    received = found["ATTITUDE"]
    t_s = _measured_s(received) if received else np.zeros(0)
    attitude = cleaned(AttitudeSeries(t_s, *_columns(received, "roll", "pitch", "yaw")))
    if not attitude.t_s.size:
        raise SourceError(f"{path}: holds no attitude of an autopilot (ATTITUDE); give another log")
    firmware = _firmware(found["HEARTBEAT"], found["STATUSTEXT"])
    return AutopilotLog(
        path=path,
        kind="MAVLink telemetry",
        attitude=attitude,
        firmware=firmware,
        rates=BodyRates(t_s, np.stack(_columns(received, "rollspeed", "pitchspeed", "yawspeed"), axis=1)),
        position=_position(found["GLOBAL_POSITION_INT"]),
        origin=_origin(found["GPS_GLOBAL_ORIGIN"]),
        ekf=_tracks(found["LOCAL_POSITION_NED"]),
        ratios=_ratios(found["EKF_STATUS_REPORT"] or found["ESTIMATOR_STATUS"]),
        gps=[
            track
            for instance, name in enumerate(("GPS_RAW_INT", "GPS2_RAW"))
            if (track := _receiver(instance, found[name])) is not None
        ],
        fusion=_fusion(found["EKF_STATUS_REPORT"]),
        events=sorted(
            [*_states(found["HEARTBEAT"], firmware), *_texts(found["STATUSTEXT"])], key=lambda event: event.t_s
        ),
        counts=Counter({name: len(of) for name, of in found.items() if of}),
        skipped_bytes=records.skipped_bytes,
        notes=records.notes(),
    )


def _columns(timed: _Timed, *fields: str) -> list[np.ndarray]:
    return [np.array([getattr(message, field) for _, message in timed], dtype=np.float64) for field in fields]


def _arrival_s(timed: _Timed) -> np.ndarray:
    return np.array([t_s for t_s, _ in timed])


def _measured_s(timed: _Timed) -> np.ndarray:
    """Times of messages that carry the time since the start of the autopilot, which may restart."""
    arrival_s, boot_s = _arrival_s(timed), 1e-3 * _columns(timed, "time_boot_ms")[0]
    boot = np.cumsum(np.concatenate([[False], np.diff(boot_s) < -_REBOOT_S]))
    offsets = np.array([np.min((arrival_s - boot_s)[boot == number]) for number in range(int(boot[-1]) + 1)])
    return boot_s + offsets[boot]


def _position(timed: _Timed) -> GlobalTrack | None:
    if not timed:
        return None
    lat, lon, alt = _columns(timed, "lat", "lon", "alt")
    return GlobalTrack(_measured_s(timed), lat * 1e-7, lon * 1e-7, alt * 1e-3)


def _origin(timed: _Timed) -> Origin | None:
    if not timed:
        return None
    message = timed[0][1]
    return Origin(message.latitude * 1e-7, message.longitude * 1e-7, message.altitude * 1e-3)


def _tracks(timed: _Timed) -> list[EkfTrack]:
    if not timed:
        return []
    columns = np.stack(_columns(timed, "x", "y", "z", "vx", "vy", "vz"), axis=1)
    return [EkfTrack(0, _measured_s(timed), columns[:, :3], columns[:, 3:])]


def _ratios(timed: _Timed) -> dict[int, Series]:
    if not timed:
        return {}
    names = {field: name for field, name in _RATIOS.items() if hasattr(timed[0][1], field)}
    values = dict(zip(names.values(), _columns(timed, *names), strict=True))
    return {0: Series(_arrival_s(timed), values)}


def _receiver(instance: int, timed: _Timed) -> GpsTrack | None:
    if not timed:
        return None
    fix_type, lat, lon, alt, accuracy, satellites = _columns(
        timed, "fix_type", "lat", "lon", "alt", "h_acc", "satellites_visible"
    )
    return GpsTrack(
        instance=instance,
        t_s=_arrival_s(timed),
        fix_type=fix_type,
        lat_deg=lat * 1e-7,
        lon_deg=lon * 1e-7,
        alt_amsl_m=alt * 1e-3,
        horizontal_m=np.where(accuracy > 0, accuracy * 1e-3, math.nan),
        satellites=satellites,
        used=None,
    )


def _fusion(timed: _Timed) -> list[Fusion]:
    """EKF_STATUS_REPORT does not say which receiver is used."""
    if not timed:
        return []
    t_s, flags = _arrival_s(timed), _columns(timed, "flags")[0].astype(int)
    names = {
        "absolute position": mavlink.EKF_POS_HORIZ_ABS,
        "constant position": mavlink.EKF_CONST_POS_MODE,
        "GPS glitch": mavlink.EKF_GPS_GLITCHING,
    }
    return [Fusion(name, t_s, (flags & bit) > 0) for name, bit in names.items()]


def _firmware(heartbeats: _Timed, texts: _Timed) -> str:
    """By the autopilot's own banner ("ArduPlane V4.5.7"), since a quadplane may state any type of vehicle; else by
    the type that its first heartbeat states."""
    banner = named_firmware([event.text for event in _texts(texts)])
    heartbeat = heartbeats[0][1] if heartbeats else None
    known = "" if heartbeat is None else firmware_of(heartbeat.autopilot, heartbeat.type)
    return known if known == "PX4" or not banner else banner


def _mode(heartbeat: Any, firmware: str) -> str:
    if heartbeat.autopilot != PX4:
        return mode_name(firmware, heartbeat.custom_mode)
    main, sub = heartbeat.custom_mode >> 16 & 0xFF, heartbeat.custom_mode >> 24 & 0xFF
    if main == _PX4_AUTO and sub in _PX4_AUTO_MODES:
        return _PX4_AUTO_MODES[sub]
    return _PX4_MODES.get(main, f"mode {main}.{sub}")


def _states(timed: _Timed, firmware: str) -> Iterator[LogEvent]:
    """Modes and arming, at each change."""
    mode, armed = "", False
    for t_s, heartbeat in timed:
        now_armed = bool(heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        if (now_mode := _mode(heartbeat, firmware)) != mode:
            yield LogEvent(t_s, "mode", now_mode)
        if now_armed != armed:
            yield LogEvent(t_s, "arming", "armed" if now_armed else "disarmed")
        mode, armed = now_mode, now_armed


def _texts(timed: _Timed) -> list[LogEvent]:
    """Texts of more than 50 characters come in pieces with one id."""
    events: list[LogEvent] = []
    for t_s, message in timed:
        text = message.text if isinstance(message.text, str) else message.text.decode("utf-8", "replace")
        text = text.split("\0")[0]
        if message.id and message.chunk_seq and events:
            events[-1] = LogEvent(events[-1].t_s, "message", events[-1].text + text)
        else:
            events.append(LogEvent(t_s, "message", text))
    return events
