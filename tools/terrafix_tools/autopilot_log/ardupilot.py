"""An ArduPilot DataFlash log in the common structure.

Messages of EKF3 (XKF1, XKF3, XKF4, XKFS), else of EKF2 (NKF1, NKF3, NKF4), else of the first EKF (EKF1, EKF3, EKF4:
logs of 2015). Fields are those of AP_NavEKF3/LogStructure.h, AP_GPS/LogStructure.h, AP_AHRS/LogStructure.h and
AP_Logger/LogStructure.h."""

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.autopilot_log.dataflash import Table, attitude_of, read_dataflash
from terrafix.core.errors import SourceError
from terrafix.link.output.odometry import ARDUPILOT_M_PER_E7
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
    Steps,
    changes,
    steps,
    value_at,
)

_EKFS = {"XKF": "EKF3", "NKF": "EKF2", "EKF": "EKF1"}  # prefix of the messages -> filter, the preferred one first
_WANTED = (
    *("ATT", "IMU", "RATE", "POS", "ORGN", "GPS", "GPS2", "GPA", "GPA2", "XKFS", "PARM", "MODE", "EV", "ERR", "MSG"),
    *(f"{prefix}{number}" for prefix in _EKFS for number in (1, 3, 4)),
)
_EVENTS = {  # AP_Logger.h LogEvent
    10: "armed",
    11: "disarmed",
    15: "auto armed",
    17: "land complete maybe",
    18: "land complete",
    19: "lost GPS",
    25: "set home",
    28: "not landed",
}
ARMED, DISARMED = 10, 11
_SUBSYSTEMS = {  # AP_Logger.h LogErrorSubsystem
    2: "radio",
    3: "compass",
    5: "failsafe radio",
    6: "failsafe battery",
    8: "failsafe GCS",
    9: "failsafe fence",
    10: "flight mode",
    11: "GPS",
    12: "crash check",
    16: "EKF check",
    17: "failsafe EKF",
    18: "barometer",
    19: "CPU",
    22: "navigation",
    24: "EKF primary",
    29: "failsafe vibration",
    30: "internal error",
    31: "failsafe dead reckoning",
}
# Bits of XKF4.SS (AP_Nav_Common.h nav_filter_status)
_ABSOLUTE, _CONSTANT, _USING_GPS, _DEAD_RECKONING = 4, 7, 13, 18
_POSITION_TIMEOUT = 0  # bit of XKF4.TS
_EXTERNAL_NAVIGATION = 6  # EK3_SRCn_POSXY
_EKF_ORIGIN = 0  # ORGN.Type
_INNOVATIONS = {  # column of XKF3 -> name and factor; magnetometer in milligauss, yaw in degrees
    "IVN": ("velocity_n_mps", 1.0),
    "IVE": ("velocity_e_mps", 1.0),
    "IVD": ("velocity_d_mps", 1.0),
    "IPN": ("position_n_m", 1.0),
    "IPE": ("position_e_m", 1.0),
    "IPD": ("position_d_m", 1.0),
    "IMX": ("mag_x_gauss", 1e-3),
    "IMY": ("mag_y_gauss", 1e-3),
    "IMZ": ("mag_z_gauss", 1e-3),
    "IYAW": ("yaw_rad", np.pi / 180.0),
}
_RATIOS = {"SV": "velocity", "SP": "position", "SH": "height", "SM": "mag", "SVT": "airspeed"}


def read_ardupilot(path: Path) -> AutopilotLog:
    """Raises SourceError when the file cannot be read or has no attitude."""
    try:
        flash = read_dataflash(path, _WANTED)
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from None
    found = flash.tables
    attitude = attitude_of(found.get("ATT", _EMPTY))
    if not attitude.t_s.size:
        raise SourceError(f"{path}: holds no attitude (ATT); set LOG_BITMASK to record it, or give another log")
    firmware = _firmware(found.get("MSG", _EMPTY).texts("Message"))
    prefix = next((p for p in _EKFS if len(found.get(f"{p}1", _EMPTY))), "XKF")
    origin = _origin(found)
    ekf = _tracks(found.get(f"{prefix}1", _EMPTY))
    primary = _primary(found.get(f"{prefix}4", _EMPTY))
    source_set = _source_set(found.get("XKFS", _EMPTY))
    gps = _receivers(found)
    log = AutopilotLog(
        path=path,
        kind="ArduPilot DataFlash",
        attitude=attitude,
        firmware=firmware,
        rates=_rates(found),
        position=_position(found, ekf, primary, origin),
        origin=origin,
        ekf=ekf,
        innovations=_innovations(found.get(f"{prefix}3", _EMPTY)),
        ratios=_ratios(found.get(f"{prefix}4", _EMPTY)),
        primary=primary,
        source_set=source_set,
        gps=gps,
        fusion=_fusion(found, prefix, primary, source_set, gps),
        counts=flash.counts,
        skipped_bytes=flash.skipped_bytes,
    )
    log.events = sorted(
        [
            *_events(found, firmware),
            *changes("lane", "lane", primary),
            *changes("source set", "source set", source_set),
            *_used_changes(gps),
        ],
        key=lambda event: event.t_s,
    )
    return log


_EMPTY = Table({}, {}, np.zeros(0, int), np.zeros(0))


def _rates(found: dict[str, Table]) -> BodyRates | None:
    """Of the first IMU; else the rates of the rate controller, which are in degrees per second."""
    imu = found.get("IMU", _EMPTY).by_instance("I").get(0)
    if imu is not None:
        return BodyRates(imu.t_s, np.stack([imu.column(f"Gyr{axis}") for axis in "XYZ"], axis=1))
    rate = found.get("RATE")
    return None if rate is None else BodyRates(rate.t_s, np.radians(np.stack([rate.column(a) for a in "RPY"], axis=1)))


def _origin(found: dict[str, Table]) -> Origin | None:
    """The first origin of the EKF."""
    table = found.get("ORGN", _EMPTY).by_instance("Type").get(_EKF_ORIGIN)
    if table is None:
        return None
    return Origin(*(float(table.column(name)[0]) for name in ("Lat", "Lng", "Alt")))


def _tracks(table: Table) -> list[EkfTrack]:
    return [
        EkfTrack(
            core,
            of.t_s,
            np.stack([of.column(name) for name in ("PN", "PE", "PD")], axis=1),
            np.stack([of.column(name) for name in ("VN", "VE", "VD")], axis=1),
        )
        for core, of in table.by_instance("C").items()
    ]


def _position(
    found: dict[str, Table], ekf: list[EkfTrack], primary: Steps | None, origin: Origin | None
) -> GlobalTrack | None:
    """POS; else that of the primary core, on ArduPilot's plane about the origin."""
    pos = found.get("POS")
    if pos is not None:
        return GlobalTrack(pos.t_s, *(pos.column(name) for name in ("Lat", "Lng", "Alt")))
    if origin is None or not ekf:
        return None
    parts = []
    for track in ekf:
        core = np.zeros(len(track.t_s)) if primary is None else value_at(primary, track.t_s)
        parts.append(np.column_stack([track.t_s, track.position_ned_m])[core == track.core])
    t_s, north, east, down = np.vstack(parts)[np.argsort(np.concatenate([part[:, 0] for part in parts]))].T
    lat_deg = origin.lat_deg + north / ARDUPILOT_M_PER_E7 * 1e-7
    mean_rad = np.radians(0.5 * (origin.lat_deg + lat_deg))
    lon_deg = origin.lon_deg + east / (ARDUPILOT_M_PER_E7 * np.cos(mean_rad)) * 1e-7
    return GlobalTrack(t_s, lat_deg, lon_deg, origin.alt_amsl_m - down)


def _innovations(table: Table) -> dict[int, Series]:
    return {
        core: Series(
            of.t_s,
            {name: factor * of.column(column) for column, (name, factor) in _INNOVATIONS.items() if of.has(column)},
        )
        for core, of in table.by_instance("C").items()
    }


def _ratios(table: Table) -> dict[int, Series]:
    """Old logs have three test ratios of the magnetometer: the largest is taken."""
    found = {}
    for core, of in table.by_instance("C").items():
        values = {name: of.hundredths(column) for column, name in _RATIOS.items() if of.has(column)}
        if of.has("SMX", "SMY", "SMZ"):
            values["mag"] = np.max([of.hundredths(column) for column in ("SMX", "SMY", "SMZ")], axis=0)
        found[core] = Series(of.t_s, values)
    return found


def _primary(table: Table) -> Steps | None:
    """Every core states the primary one; before the choice it is -1."""
    if not table.has("PI"):
        return None
    known = table.column("PI") >= 0
    return steps(table.t_s[known], table.column("PI")[known])


def _source_set(table: Table) -> Steps | None:
    first = table.by_instance("C").get(0)
    return steps(first.t_s, first.integers("SS") + 1) if first is not None and first.has("SS") else None


def _receivers(found: dict[str, Table]) -> list[GpsTrack]:
    """GPS and GPA state the instance in "I"; old logs have a message of its own for the second receiver."""
    tracks, accuracies = ({**_instances(found, name)} for name in ("GPS", "GPA"))
    receivers = []
    for instance, of in sorted(tracks.items()):
        accuracy = accuracies.get(instance)
        horizontal_m = np.full(len(of), np.nan)
        if accuracy is not None and accuracy.has("HAcc"):
            horizontal_m = np.interp(of.t_s, accuracy.t_s, accuracy.column("HAcc"), left=np.nan, right=np.nan)
        receivers.append(
            GpsTrack(
                instance=instance,
                t_s=of.t_s,
                fix_type=of.integers("Status"),
                lat_deg=of.column("Lat"),
                lon_deg=of.column("Lng"),
                alt_amsl_m=of.column("Alt"),
                horizontal_m=horizontal_m,
                satellites=of.integers("NSats"),
                used=of.column("U") > 0 if of.has("U") else None,
            )
        )
    return receivers


def _instances(found: dict[str, Table], name: str) -> dict[int, Table]:
    first = found.get(name, _EMPTY).by_instance("I")
    second = found.get(f"{name}2")
    return first if second is None else {**first, 1: second}


def _fusion(
    found: dict[str, Table], prefix: str, primary: Steps | None, source_set: Steps | None, gps: list[GpsTrack]
) -> list[Fusion]:
    """What the primary core takes its horizontal position from, by its solution status (XKF4.SS)."""
    table = found.get(f"{prefix}4", _EMPTY)
    if not table.has("SS"):
        return []
    core = table.column("C", 0.0)
    status = table if primary is None else table.of(core == value_at(primary, table.t_s))
    bits, timeouts = status.integers("SS"), status.integers("TS")
    absolute = _bit(bits, _ABSOLUTE)
    series = [Fusion("absolute position", status.t_s, absolute)]
    if prefix != "EKF":  # the first EKF has no such bit
        using_gps = _bit(bits, _USING_GPS)
        selected = _selected(found.get("XKFS", _EMPTY), primary, gps, status.t_s)
        series += [
            Fusion(f"GPS {track.instance + 1}", status.t_s, using_gps & (selected == track.instance)) for track in gps
        ]
    external = _external_sets(found.get("PARM", _EMPTY))
    if external and source_set is not None:
        chosen = np.isin(value_at(source_set, status.t_s), list(external))
        fused = chosen & absolute & ~_bit(timeouts, _POSITION_TIMEOUT)
        series.append(Fusion("external navigation", status.t_s, fused))
    if prefix == "XKF":
        series.append(Fusion("dead reckoning", status.t_s, _bit(bits, _DEAD_RECKONING)))
    series.append(Fusion("constant position", status.t_s, _bit(bits, _CONSTANT)))
    return series


def _bit(values: np.ndarray, bit: int) -> np.ndarray:
    return (values >> bit & 1).astype(bool)


def _selected(selection: Table, primary: Steps | None, gps: list[GpsTrack], at_s: np.ndarray) -> np.ndarray:
    """GPS instance of the primary core at the times: by XKFS, else by the receivers' own mark, else the first one."""
    if selection.has("GI") and len(selection):
        core = selection.column("C", 0.0)
        rows = selection if primary is None else selection.of(core == value_at(primary, selection.t_s))
        chosen = steps(rows.t_s, rows.integers("GI"))
        if chosen is not None:
            return value_at(chosen, at_s)
    selected = np.zeros(len(at_s))
    for track in gps:
        if track.used is not None and (used := steps(track.t_s, track.used.astype(float))) is not None:
            selected[value_at(used, at_s) > 0] = track.instance
    return selected


def _external_sets(parameters: Table) -> set[int]:
    """Source sets (from 1) whose horizontal position is external navigation."""
    if not parameters.has("Name", "Value"):
        return set()
    values = dict(zip(parameters.texts("Name"), parameters.column("Value"), strict=True))
    return {n for n in (1, 2, 3) if values.get(f"EK3_SRC{n}_POSXY") == _EXTERNAL_NAVIGATION}


def named_firmware(texts: Iterable[str]) -> str:
    """The first text that names a vehicle: "ArduCopter V4.6.3 (...)"; "" without one."""
    return next((text for text in texts if re.search(r"(Copter|Plane|Rover|Sub|Blimp|Tracker) V\d", text)), "")


def _firmware(texts: list[str]) -> str:
    """The banner; else the first text that has the name of a vehicle."""
    return named_firmware(texts) or next((t for t in texts if re.search(r"Copter|Plane|Rover|Sub|Blimp", t)), "")


# ArduPilot's Blimp/mode.h; MAVLink has no enumeration of them.
_BLIMP_MODES = {0: "land", 1: "manual", 2: "velocity", 3: "loiter", 4: "rtl"}


def mode_name(firmware: str, number: int) -> str:
    """Name of a flight mode, by the MAVLink enumeration of the vehicle; its number where the vehicle is not known."""
    if "Blimp" in firmware:
        return _BLIMP_MODES.get(number, f"mode {number}")
    for vehicle in ("Copter", "Plane", "Rover", "Sub", "Tracker"):
        if vehicle in firmware:
            known = mavlink.enums[f"{vehicle.upper()}_MODE"].get(number)
            if known is not None and not known.name.endswith("ENUM_END"):
                return str(known.name.split("_MODE_")[1].lower().replace("_", " "))
    return f"mode {number}"


def _modes(table: Table, firmware: str) -> list[str]:
    """Logs of 2013 have a column Mode alone: a number in binary ones, the name in text."""
    numbers = next((name for name in ("ModeNum", "Mode") if table.has(name)), "ModeNum")
    if numbers == "Mode" and table.columns[numbers].dtype == object:
        return [text.lower().replace("_", " ") for text in table.texts(numbers)]
    return [mode_name(firmware, int(number)) for number in table.integers(numbers)]


def _events(found: dict[str, Table], firmware: str) -> list[LogEvent]:
    events = []
    modes = found.get("MODE", _EMPTY)
    for t_s, mode in zip(modes.t_s, _modes(modes, firmware), strict=True):
        events.append(LogEvent(float(t_s), "mode", mode))
    noted = found.get("EV", _EMPTY)
    for t_s, number in zip(noted.t_s, noted.integers("Id"), strict=True):
        kind = "arming" if number in (ARMED, DISARMED) else "event"
        events.append(LogEvent(float(t_s), kind, _EVENTS.get(number, f"event {number}")))
    errors = found.get("ERR", _EMPTY)
    for t_s, system, code in zip(errors.t_s, errors.integers("Subsys"), errors.integers("ECode"), strict=True):
        name = _SUBSYSTEMS.get(int(system), f"subsystem {int(system)}")
        events.append(LogEvent(float(t_s), "error", f"{name}: " + (f"error {int(code)}" if code else "resolved")))
    texts = found.get("MSG", _EMPTY)
    for t_s, text in zip(texts.t_s, texts.texts("Message"), strict=True):
        events.append(LogEvent(float(t_s), "message", text))
    return events


def _used_changes(gps: list[GpsTrack]) -> list[LogEvent]:
    events = []
    for track in gps:
        used = None if track.used is None else steps(track.t_s, track.used.astype(float))
        for t_s, value in () if used is None else zip(used.t_s[1:], used.value[1:], strict=True):
            events.append(
                LogEvent(float(t_s), "gps", f"GPS {track.instance + 1} {'used' if value else 'no longer used'}")
            )
    return events
