"""A PX4 ULog (.ulg) in the common structure.

Topics and fields are those of PX4's msg/ folder: vehicle_attitude, vehicle_angular_velocity, vehicle_local_position,
vehicle_global_position, estimator_innovations, estimator_innovation_test_ratios, estimator_aid_src_*,
estimator_selector_status, estimator_status_flags, sensor_gps, vehicle_gps_position, vehicle_status. A topic that a
version does not have, or that was not logged, is missing in the result."""

import contextlib
import io
import struct
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from pyulog import ULog
from pyulog.exceptions import ULogException

from terrafix.core.errors import SourceError
from terrafix_tools.autopilot_log.structure import (
    Attitude,
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
    cleaned,
    steps,
    value_at,
)

_AID = "estimator_aid_src_"
_FUSED = {  # topic after _AID -> name of the source
    "gnss_pos": "GPS position",
    "gnss_vel": "GPS velocity",
    "ev_pos": "external navigation",
    "ev_vel": "external velocity",
    "aux_global_position": "auxiliary position",
    "airspeed": "airspeed",
    "fake_pos": "constant position",
}
_DEAD_RECKONING = ("cs_inertial_dead_reckoning", "cs_wind_dead_reckoning")  # of estimator_status_flags
_MODES = {  # vehicle_status.nav_state
    0: "manual",
    1: "altitude",
    2: "position",
    3: "mission",
    4: "loiter",
    5: "return",
    10: "acro",
    12: "descend",
    13: "termination",
    14: "offboard",
    15: "stabilized",
    17: "takeoff",
    18: "land",
    19: "follow",
    20: "precision land",
    21: "orbit",
}
_ARMED = 2  # vehicle_status.arming_state
_INNOVATIONS = {  # of estimator_innovations -> name; a position or velocity of the first source that has one
    "velocity_n_mps": ("gps_hvel[0]", "ev_hvel[0]"),
    "velocity_e_mps": ("gps_hvel[1]", "ev_hvel[1]"),
    "velocity_d_mps": ("gps_vvel", "ev_vvel"),
    "position_n_m": ("gps_hpos[0]", "ev_hpos[0]"),
    "position_e_m": ("gps_hpos[1]", "ev_hpos[1]"),
    "position_d_m": ("baro_vpos", "gps_vpos", "ev_vpos"),
    "mag_x_gauss": ("mag_field[0]",),
    "mag_y_gauss": ("mag_field[1]",),
    "mag_z_gauss": ("mag_field[2]",),
    "yaw_rad": ("heading",),
}
_RATIOS = {  # of estimator_innovation_test_ratios: squares, that of a vector in its first component
    "velocity": ("gps_hvel[0]", "ev_hvel[0]"),
    "position": ("gps_hpos[0]", "ev_hpos[0]"),
    "height": ("baro_vpos", "gps_vpos", "ev_vpos"),
    "mag": ("mag_field[0]",),
    "yaw": ("heading",),
    "airspeed": ("airspeed",),
}
_WANTED = (
    "vehicle_attitude",
    "vehicle_angular_velocity",
    "vehicle_local_position",
    "vehicle_global_position",
    "estimator_local_position",
    "estimator_innovations",
    "estimator_innovation_test_ratios",
    "estimator_selector_status",
    "estimator_status_flags",
    "sensor_gps",
    "vehicle_gps_position",
    "vehicle_status",
    *(_AID + name for name in _FUSED),
)
# What pyulog raises on a damaged file beside its own exception.
_DAMAGE = (ULogException, struct.error, ValueError, KeyError, IndexError, TypeError, AttributeError)

# Bytes that pyulog may read of a file: it reads a damaged part again from each of its bytes.
READS_BYTES, READS_PER_BYTE = 8 * 1024 * 1024, 20

_Topic = dict[str, np.ndarray]  # fields of one instance of a topic


class _Stream(io.BytesIO):
    """A file that ends the search of pyulog for the next message in damaged definitions, which can be endless."""

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self._left = READS_BYTES + READS_PER_BYTE * len(data)

    def read(self, size: int | None = -1) -> bytes:
        data = super().read(size)
        self._left -= len(data)
        if self._left < 0:
            raise ULogException("no end of the damaged part")
        return data


def read_px4(path: Path) -> AutopilotLog:
    """Raises SourceError when the file cannot be read, is damaged from the start, or has no attitude."""
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # pyulog prints what it finds damaged
            ulog = ULog(_Stream(path.read_bytes()), list(_WANTED))
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from None
    except _DAMAGE as error:
        raise SourceError(f"{path}: is no readable ULog ({error}); give another log") from None
    topics: dict[str, dict[int, _Topic]] = {}
    for data in (one for one in ulog.data_list if "timestamp" in one.data):
        topics.setdefault(data.name, {})[data.multi_id] = data.data
    topic = _first(topics, "vehicle_attitude")
    attitude = None if topic is None else _attitude(topic)
    if attitude is None or not attitude.t_s.size:
        raise SourceError(f"{path}: holds no attitude (vehicle_attitude); give another log")
    selector = _first(topics, "estimator_selector_status")
    primary = None if selector is None else steps(_t_s(selector), _integers(selector, "primary_instance"))
    gps = _receivers(topics)
    status = _first(topics, "vehicle_status")
    return AutopilotLog(
        path=path,
        kind="PX4 ULog",
        attitude=attitude,
        firmware=f"PX4 {ulog.get_version_info_str() or ''}".strip(),
        rates=_rates(_first(topics, "vehicle_angular_velocity")),
        position=_position(_first(topics, "vehicle_global_position")),
        origin=_origin(_first(topics, "vehicle_local_position")),
        ekf=_tracks(topics.get("estimator_local_position") or topics.get("vehicle_local_position") or {}),
        innovations=_series(topics.get("estimator_innovations", {}), _INNOVATIONS, squared=False),
        ratios=_series(topics.get("estimator_innovation_test_ratios", {}), _RATIOS, squared=True),
        primary=primary,
        gps=gps,
        fusion=_fusion(topics, primary),
        events=sorted(
            [*_states(status), *changes("lane", "lane", primary), *_texts(ulog)], key=lambda event: event.t_s
        ),
        counts=Counter({name: sum(map(_size, instances.values())) for name, instances in topics.items()}),
    )


def _first(topics: dict[str, dict[int, _Topic]], name: str) -> _Topic | None:
    """The first instance with a sample."""
    found = topics.get(name, {})
    return next((found[i] for i in sorted(found) if len(found[i]["timestamp"])), None)


def _t_s(topic: _Topic, field: str = "timestamp") -> np.ndarray:
    return topic[field].astype(np.float64) * 1e-6


def _measured_s(topic: _Topic) -> np.ndarray:
    """Time of the measurement, where the version logs it beside the time of publication."""
    sampled = topic.get("timestamp_sample")
    return _t_s(topic, "timestamp_sample") if sampled is not None and np.all(sampled > 0) else _t_s(topic)


def _numbers(topic: _Topic, field: str) -> np.ndarray:
    found = topic.get(field)
    return np.full(len(topic["timestamp"]), np.nan) if found is None else found.astype(np.float64)


def _integers(topic: _Topic, field: str) -> np.ndarray:
    """0 where a version does not log the field."""
    return np.nan_to_num(_numbers(topic, field)).astype(np.int64)


def _columns(topic: _Topic, *fields: str) -> np.ndarray:
    return np.stack([_numbers(topic, field) for field in fields], axis=1)


def _attitude(topic: _Topic) -> Attitude:
    """From the quaternion (w, x, y, z) that rotates the body (FRD) into north, east, down."""
    w, x, y, z = _columns(topic, "q[0]", "q[1]", "q[2]", "q[3]").T
    roll_rad = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch_rad = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw_rad = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return cleaned(Attitude(_measured_s(topic), roll_rad, pitch_rad, yaw_rad))


def _rates(topic: _Topic | None) -> BodyRates | None:
    return None if topic is None else BodyRates(_measured_s(topic), _columns(topic, "xyz[0]", "xyz[1]", "xyz[2]"))


def _position(topic: _Topic | None) -> GlobalTrack | None:
    return None if topic is None else GlobalTrack(_measured_s(topic), *_columns(topic, "lat", "lon", "alt").T)


def _origin(topic: _Topic | None) -> Origin | None:
    if topic is None:
        return None
    known = np.flatnonzero(_numbers(topic, "xy_global") > 0)
    return Origin(*map(float, _columns(topic, "ref_lat", "ref_lon", "ref_alt")[known[0]])) if known.size else None


def _tracks(instances: dict[int, _Topic]) -> list[EkfTrack]:
    return [
        EkfTrack(core, _measured_s(topic), _columns(topic, "x", "y", "z"), _columns(topic, "vx", "vy", "vz"))
        for core, topic in sorted(instances.items())
    ]


def _series(instances: dict[int, _Topic], wanted: dict[str, tuple[str, ...]], *, squared: bool) -> dict[int, Series]:
    """Of the fields for one quantity the first that is ever other than 0 is taken; none: the quantity is left out."""
    found = {}
    for core, topic in instances.items():
        values = {}
        for name, fields in wanted.items():
            known = (_numbers(topic, field) for field in fields if field in topic)
            moving = next((value for value in known if np.any(np.nan_to_num(value) != 0.0)), None)
            if moving is not None:
                values[name] = np.sqrt(np.maximum(moving, 0.0)) if squared else moving
        found[core] = Series(_t_s(topic), values)
    return found


def _receivers(topics: dict[str, dict[int, _Topic]]) -> list[GpsTrack]:
    """sensor_gps has the receivers, vehicle_gps_position the one that is used (or their blend): by its device."""
    chosen = _first(topics, "vehicle_gps_position")
    device = None if chosen is None else steps(_t_s(chosen), _integers(chosen, "device_id"))
    instances = topics.get("sensor_gps") or ({} if chosen is None else {0: chosen})
    receivers = []
    for instance, topic in sorted(instances.items()):
        t_s, own = _t_s(topic), _integers(topic, "device_id")
        known = device is not None and np.all(own > 0)
        degrees = "latitude_deg" in topic  # integers until 2023
        receivers.append(
            GpsTrack(
                instance=instance,
                t_s=t_s,
                fix_type=_integers(topic, "fix_type"),
                lat_deg=_numbers(topic, "latitude_deg") if degrees else _numbers(topic, "lat") * 1e-7,
                lon_deg=_numbers(topic, "longitude_deg") if degrees else _numbers(topic, "lon") * 1e-7,
                alt_amsl_m=_numbers(topic, "altitude_msl_m") if degrees else _numbers(topic, "alt") * 1e-3,
                horizontal_m=_numbers(topic, "eph"),
                satellites=_integers(topic, "satellites_used"),
                used=value_at(device, t_s) == own if device is not None and known else None,
            )
        )
    return receivers


def _fusion(topics: dict[str, dict[int, _Topic]], primary: Steps | None) -> list[Fusion]:
    """What the primary core fused."""
    series = []
    for name, source in _FUSED.items():
        topic = _of_primary(topics.get(_AID + name, {}), primary)
        if topic is not None:
            series.append(Fusion(source, _t_s(topic), _numbers(topic, "fused") > 0))
    flags = _of_primary(topics.get("estimator_status_flags", {}), primary)
    if flags is not None:
        fused = np.any([_numbers(flags, field) > 0 for field in _DEAD_RECKONING], axis=0)
        series.append(Fusion("dead reckoning", _t_s(flags), fused))
    return series


def _of_primary(instances: dict[int, _Topic], primary: Steps | None) -> _Topic | None:
    """The samples of all instances that are of the primary core at their time; None: there are none."""
    parts = []
    for number, topic in instances.items():
        core = _numbers(topic, "estimator_instance") if "estimator_instance" in topic else np.full(_size(topic), number)
        wanted = np.zeros(_size(topic)) if primary is None else value_at(primary, _t_s(topic))
        parts.append({field: values[core == wanted] for field, values in topic.items()})
    if not parts:
        return None
    joined = {field: np.concatenate([part[field] for part in parts]) for field in parts[0]}
    order = np.argsort(joined["timestamp"], kind="stable")
    return {field: values[order] for field, values in joined.items()} if len(order) else None


def _size(topic: _Topic) -> int:
    return len(topic["timestamp"])


def _states(status: _Topic | None) -> list[LogEvent]:
    if status is None:
        return []
    events = []
    modes = steps(_t_s(status), _integers(status, "nav_state"))
    if modes is not None:
        events += [
            LogEvent(float(t), "mode", _MODES.get(int(n), f"mode {int(n)}"))
            for t, n in zip(modes.t_s, modes.value, strict=True)
        ]
    armed = steps(_t_s(status), (_integers(status, "arming_state") == _ARMED).astype(float))
    if armed is not None:
        changed = zip(armed.t_s, armed.value, strict=True)
        events += [
            LogEvent(float(t), "arming", "armed" if n else "disarmed") for t, n in changed if n or t > armed.t_s[0]
        ]
    return events


def _texts(ulog: Any) -> list[LogEvent]:
    return [LogEvent(text.timestamp * 1e-6, "message", text.message) for text in ulog.logged_messages]
