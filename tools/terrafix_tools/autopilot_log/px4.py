"""A PX4 ULog (.ulg) in the common structure.

Topics and fields are those of PX4's msg/ folder: vehicle_attitude, vehicle_angular_velocity, vehicle_local_position,
vehicle_global_position, estimator_innovations, estimator_innovation_test_ratios, estimator_aid_src_*,
estimator_selector_status, estimator_status_flags, sensor_gps, vehicle_gps_position, vehicle_status. A topic that a
version does not have, or that was not logged, is missing in the result."""

from collections import Counter
from pathlib import Path

import numpy as np

from terrafix.core.autopilot_log.ulog import Topic, attitude_of, columns, numbers, read_topics, sampled_s
from terrafix.core.errors import SourceError
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


def read_px4(path: Path) -> AutopilotLog:
    """Raises SourceError when the file cannot be read, is damaged from the start, or has no attitude."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from None
    read = read_topics(path, data, _WANTED)
    topics = read.topics
    topic = _first(topics, "vehicle_attitude")
    attitude = None if topic is None else attitude_of(topic)
    if attitude is None or not attitude.t_s.size:
        raise SourceError(f"{path}: holds no attitude (vehicle_attitude); give another log")
    selector = _first(topics, "estimator_selector_status")
    primary = None if selector is None else steps(_t_s(selector), _integers(selector, "primary_instance"))
    gps = _receivers(topics)
    status = _first(topics, "vehicle_status")
    texts = [LogEvent(t_s, "message", text) for t_s, text in read.texts]
    return AutopilotLog(
        path=path,
        kind="PX4 ULog",
        attitude=attitude,
        firmware=f"PX4 {read.version}".strip(),
        rates=_rates(_first(topics, "vehicle_angular_velocity")),
        position=_position(_first(topics, "vehicle_global_position")),
        origin=_origin(_first(topics, "vehicle_local_position")),
        ekf=_tracks(topics.get("estimator_local_position") or topics.get("vehicle_local_position") or {}),
        innovations=_series(topics.get("estimator_innovations", {}), _INNOVATIONS, squared=False),
        ratios=_series(topics.get("estimator_innovation_test_ratios", {}), _RATIOS, squared=True),
        primary=primary,
        gps=gps,
        fusion=_fusion(topics, primary),
        events=sorted([*_states(status), *changes("lane", "lane", primary), *texts], key=lambda event: event.t_s),
        counts=Counter({name: sum(map(_size, instances.values())) for name, instances in topics.items()}),
    )


def _first(topics: dict[str, dict[int, Topic]], name: str) -> Topic | None:
    """The first instance with a sample."""
    found = topics.get(name, {})
    return next((found[i] for i in sorted(found) if len(found[i]["timestamp"])), None)


def _t_s(topic: Topic, field: str = "timestamp") -> np.ndarray:
    return topic[field].astype(np.float64) * 1e-6


def _integers(topic: Topic, field: str) -> np.ndarray:
    """0 where a version does not log the field."""
    return np.nan_to_num(numbers(topic, field)).astype(np.int64)


def _rates(topic: Topic | None) -> BodyRates | None:
    return None if topic is None else BodyRates(sampled_s(topic), columns(topic, "xyz[0]", "xyz[1]", "xyz[2]"))


def _position(topic: Topic | None) -> GlobalTrack | None:
    return None if topic is None else GlobalTrack(sampled_s(topic), *columns(topic, "lat", "lon", "alt").T)


def _origin(topic: Topic | None) -> Origin | None:
    if topic is None:
        return None
    known = np.flatnonzero(numbers(topic, "xy_global") > 0)
    return Origin(*map(float, columns(topic, "ref_lat", "ref_lon", "ref_alt")[known[0]])) if known.size else None


def _tracks(instances: dict[int, Topic]) -> list[EkfTrack]:
    return [
        EkfTrack(core, sampled_s(topic), columns(topic, "x", "y", "z"), columns(topic, "vx", "vy", "vz"))
        for core, topic in sorted(instances.items())
    ]


def _series(instances: dict[int, Topic], wanted: dict[str, tuple[str, ...]], *, squared: bool) -> dict[int, Series]:
    """Of the fields for one quantity the first that is ever other than 0 is taken; none: the quantity is left out."""
    found = {}
    for core, topic in instances.items():
        values = {}
        for name, fields in wanted.items():
            known = (numbers(topic, field) for field in fields if field in topic)
            moving = next((value for value in known if np.any(np.nan_to_num(value) != 0.0)), None)
            if moving is not None:
                values[name] = np.sqrt(np.maximum(moving, 0.0)) if squared else moving
        found[core] = Series(_t_s(topic), values)
    return found


def _receivers(topics: dict[str, dict[int, Topic]]) -> list[GpsTrack]:
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
                lat_deg=numbers(topic, "latitude_deg") if degrees else numbers(topic, "lat") * 1e-7,
                lon_deg=numbers(topic, "longitude_deg") if degrees else numbers(topic, "lon") * 1e-7,
                alt_amsl_m=numbers(topic, "altitude_msl_m") if degrees else numbers(topic, "alt") * 1e-3,
                horizontal_m=numbers(topic, "eph"),
                satellites=_integers(topic, "satellites_used"),
                used=value_at(device, t_s) == own if device is not None and known else None,
            )
        )
    return receivers


def _fusion(topics: dict[str, dict[int, Topic]], primary: Steps | None) -> list[Fusion]:
    """What the primary core fused."""
    series = []
    for name, source in _FUSED.items():
        topic = _of_primary(topics.get(_AID + name, {}), primary)
        if topic is not None:
            series.append(Fusion(source, _t_s(topic), numbers(topic, "fused") > 0))
    flags = _of_primary(topics.get("estimator_status_flags", {}), primary)
    if flags is not None:
        fused = np.any([numbers(flags, field) > 0 for field in _DEAD_RECKONING], axis=0)
        series.append(Fusion("dead reckoning", _t_s(flags), fused))
    return series


def _of_primary(instances: dict[int, Topic], primary: Steps | None) -> Topic | None:
    """The samples of all instances that are of the primary core at their time; None: there are none."""
    parts = []
    for number, topic in instances.items():
        core = numbers(topic, "estimator_instance") if "estimator_instance" in topic else np.full(_size(topic), number)
        wanted = np.zeros(_size(topic)) if primary is None else value_at(primary, _t_s(topic))
        parts.append({field: values[core == wanted] for field, values in topic.items()})
    if not parts:
        return None
    joined = {field: np.concatenate([part[field] for part in parts]) for field in parts[0]}
    order = np.argsort(joined["timestamp"], kind="stable")
    return {field: values[order] for field, values in joined.items()} if len(order) else None


def _size(topic: Topic) -> int:
    return len(topic["timestamp"])


def _states(status: Topic | None) -> list[LogEvent]:
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
