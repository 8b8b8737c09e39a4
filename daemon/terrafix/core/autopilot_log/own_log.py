"""An autopilot's own log (ArduPilot's .bin and .log, PX4's .ulg) as telemetry of a flight: attitude, height, airspeed,
inertial readings and gimbal. Its GNSS positions are not read.

Times are those of the autopilot's clock, less the time of the flight's zero on it."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from terrafix.core.autopilot_log import dataflash, ulog
from terrafix.core.autopilot_log.alignment import align
from terrafix.core.autopilot_log.attitude import AttitudeSeries, cleaned
from terrafix.core.autopilot_log.dataflash import Table, is_dataflash, read_dataflash
from terrafix.core.autopilot_log.ulog import ULOG_MAGIC, Topic, columns, numbers, read_topics, sampled_s
from terrafix.core.errors import EvaluationError, SourceError
from terrafix.core.exposures import Matched, match_exposures
from terrafix.core.mavlink.gimbal import AT_A_LIMIT, quat_from_euler, yaw_is_from_north
from terrafix.core.mavlink.vehicles import HeardVehicle
from terrafix.messages import GimbalAttitude, Imu, ImuSample, VehicleState

ALIGNABLE_S = 10.0  # of attitude in frames.csv, from which it is aligned with the log [spec: MIN_ATTITUDE_S]
ANY_TIME_S = 86_400.0  # 1-sigma of the flight's zero on a log of which nothing is known [spec: a day]
MAX_IMU_HZ = 50.0  # faster readings are averaged: what a companion requests [spec: RATES_HZ of simulated logs]
IMU_BATCH = 3  # readings in one message [spec: IMU_BATCH_NS at 50 Hz]
ARMED, DISARMED = 10, 11  # EV.Id [spec: AP_Logger.h LogEvent]
PX4_ARMED = 2  # vehicle_status.arming_state [spec: PX4 msg/VehicleStatus.msg]
CAM, TRIG = "CAM", "TRIG"  # rows of ArduPilot: by the camera's signal where it has one; by the one that triggers it
_FLASH = ("ATT", "POS", "BARO", "ARSP", "IMU", "EV", "MNT", CAM, TRIG)
_TOPICS = (
    "vehicle_attitude",
    "vehicle_local_position",
    "vehicle_status",
    "sensor_combined",
    "gimbal_device_attitude_status",
    "camera_capture",
    "camera_trigger",
)


@dataclass(frozen=True)
class _Read:
    """All on the log's clock. ``heights``: times and metres above take-off; ``forces``: times, and specific force and
    angular velocity (N, 6), forward, right, down; ``gimbal``: times, attitudes; ``exposures``: times (N,) of each kind,
    the preferred one first."""

    attitude: AttitudeSeries
    heights: tuple[np.ndarray, np.ndarray]
    forces: tuple[np.ndarray, np.ndarray]
    armed: list[tuple[float, bool]]
    gimbal: list[tuple[float, GimbalAttitude]]
    airspeeds: tuple[np.ndarray, np.ndarray] = field(default_factory=lambda: (np.zeros(0), np.zeros(0)))
    skipped_bytes: int = 0
    exposures: dict[str, np.ndarray] = field(default_factory=dict)


class OwnLog:
    """The same as ``TelemetryLog`` of a ground station's log. ``zero_s``: of the flight on the log's clock; None: by
    the attitude of ``states``, those of the frames, else by the exposures of the frames, whose stamps are ``frames_s``,
    else the first attitude of the log.

    Raises SourceError: it cannot be read, has no attitude, or is of another flight than ``states``."""

    vehicles: Sequence[HeardVehicle] = ()

    def __init__(
        self,
        path: Path,
        zero_s: float | None = None,
        states: Sequence[VehicleState] = (),
        frames_s: Sequence[float] = (),
    ) -> None:
        self.path, read = path, _read(path)
        if not read.attitude.t_s.size:
            raise SourceError(f"{path}: holds no attitude of an autopilot; set the logging to record it, or remove it")
        self.skipped_bytes, self.clock = read.skipped_bytes, "the autopilot's clock"
        self.zero = "[telemetry] log_zero_s"
        self._rate = 1.0  # of the log's clock
        if zero_s is None:
            zero_s = self._aligned(read, states, np.array(frames_s))
        self._zero_s = zero_s
        self.states, self.imu = self._states(read), self._imu(read)
        self.exposures = {
            kind: [self._ns(float(t)) for t in np.unique(times)] for kind, times in read.exposures.items() if len(times)
        }
        self.gimbal = [msgspec.structs.replace(one, t_ns=self._ns(t_s)) for t_s, one in read.gimbal]

    def notes(self) -> list[str]:
        """Nothing of it was repaired."""
        return []

    def _aligned(self, read: _Read, states: Sequence[VehicleState], frames_s: np.ndarray) -> float:
        """-> time of the flight's zero on the log's clock, and sets its rate."""
        attitude = read.attitude
        frames = np.array(
            [
                (state.t_ns * 1e-9, state.roll_rad, state.pitch_rad, state.yaw_rad)
                for state in states
                if state.roll_rad is not None and state.pitch_rad is not None and state.yaw_rad is not None
            ]
        ).reshape(-1, 4)
        if len(frames) < 2 or frames[-1, 0] - frames[0, 0] < ALIGNABLE_S:
            refused = "frames.csv has no attitude"
            for kind, times_s in read.exposures.items():
                matched = match_exposures(frames_s, np.unique(times_s), ANY_TIME_S, complete=True)
                if isinstance(matched, Matched):
                    self.zero = f"by the rows {kind}, of {int(matched.seen.sum())} of {len(frames_s)} frames"
                    return -matched.latency_s
                refused += f"; {kind}: {matched}" if len(times_s) else ""
            self.zero = f"its first attitude: {refused}; [telemetry] log_zero_s states it"
            return float(attitude.t_s[0])
        try:
            found = align(cleaned(AttitudeSeries(*frames.T)), attitude)
        except EvaluationError as error:
            raise SourceError(
                f"{self.path}: does not fit the attitude of frames.csv: {error}; or state [telemetry] log_zero_s"
            ) from None
        self._rate = 1.0 + found.drift
        self.zero = f"by the attitude of frames.csv, to {1e3 * found.offset_sigma_s:.0f} ms"
        return float(found.to_log(np.zeros(1))[0])

    def _ns(self, log_s: float) -> int:
        return round((log_s - self._zero_s) / self._rate * 1e9)

    def _states(self, read: _Read) -> list[VehicleState]:
        def state(t_s: float, **fields: float) -> VehicleState:
            armed = next((value for at_s, value in reversed(read.armed) if at_s <= t_s), None)
            return VehicleState(t_ns=self._ns(t_s), source="log", armed=armed, **fields)  # type: ignore[arg-type]

        a = read.attitude
        found = [
            state(float(t), yaw_rad=float(yaw), pitch_rad=float(pitch), roll_rad=float(roll))
            for t, yaw, pitch, roll in zip(a.t_s, a.yaw_rad, a.pitch_rad, a.roll_rad, strict=True)
        ]
        found += [state(float(t), agl_m=float(m)) for t, m in zip(*read.heights, strict=True) if math.isfinite(m)]
        found += [state(float(t), airspeed_mps=float(v)) for t, v in zip(*read.airspeeds, strict=True)]
        return sorted(found, key=lambda one: one.t_ns)

    def _imu(self, read: _Read) -> list[Imu]:
        return imu_batches(*read.forces, self._ns, "log")


def imu_batches(t_s: np.ndarray, values: np.ndarray, ns_of: Callable[[float], int], source: str) -> list[Imu]:
    """``values`` (N, 6): specific force and angular velocity, forward, right, down, at ``t_s``; means of faster ones
    than MAX_IMU_HZ. ``ns_of``: time of the flight of a ``t_s``."""
    keep = np.isfinite(values).all(axis=1) & np.isfinite(t_s)
    keep[1:] &= np.diff(t_s) > 0
    t_s, values = t_s[keep], values[keep]
    if len(t_s) < 2:
        return []
    mean_of = max(1, round(1.0 / (MAX_IMU_HZ * float(np.median(np.diff(t_s))))))
    groups = len(t_s) // mean_of
    times = t_s[: groups * mean_of].reshape(groups, mean_of).mean(axis=1)
    means = values[: groups * mean_of].reshape(groups, mean_of, 6).mean(axis=1)
    found = []
    for first in range(0, groups, IMU_BATCH):
        ns = [ns_of(float(t)) for t in times[first : first + IMU_BATCH]]
        samples: list[ImuSample] = [
            (ns[-1] - t_ns, *map(float, row))  # type: ignore[misc]
            for t_ns, row in zip(ns, means[first : first + IMU_BATCH], strict=True)
        ]
        found.append(Imu(t_ns=ns[-1], source=source, samples=samples))
    return found


def _read(path: Path) -> _Read:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from None
    if data.startswith(ULOG_MAGIC):
        return _of_px4(read_topics(path, data, _TOPICS).topics)
    if is_dataflash(data):
        return _of_ardupilot(path)
    raise SourceError(f"{path}: is no log of an autopilot; give ArduPilot's .bin or .log, or PX4's .ulg")


def _of_ardupilot(path: Path) -> _Read:
    flash = read_dataflash(path, _FLASH)
    empty = Table({}, {}, np.zeros(0, int), np.zeros(0))
    tables = {name: flash.tables.get(name, empty) for name in _FLASH}
    pos = tables["POS"]
    baro, imu, speeds = (tables[name].by_instance("I").get(0, empty) for name in ("BARO", "IMU", "ARSP"))
    heights = (pos.t_s, pos.column("RelHomeAlt")) if pos.has("RelHomeAlt") else (baro.t_s, baro.column("Alt"))
    healthy = (speeds.column("H", 1.0) > 0) & np.isfinite(speeds.column("Airspeed"))
    events = tables["EV"]
    return _Read(
        attitude=dataflash.attitude_of(tables["ATT"]),
        heights=heights,
        forces=(imu.t_s, np.stack([imu.column(f"{kind}{axis}") for kind in ("Acc", "Gyr") for axis in "XYZ"], axis=1)),
        armed=[
            (float(t), bool(number == ARMED))
            for t, number in zip(events.t_s, events.integers("Id"), strict=True)
            if number in (ARMED, DISARMED)
        ],
        gimbal=list(_mount(tables["MNT"])),
        airspeeds=(speeds.t_s[healthy], speeds.column("Airspeed")[healthy]),
        skipped_bytes=flash.skipped_bytes,
        exposures={kind: tables[kind].t_s for kind in (CAM, TRIG)},
    )


def _mount(table: Table) -> Iterator[tuple[float, GimbalAttitude]]:
    """MNT: roll and pitch against the horizon, yaw in the body (YawB). The columns of before 4.3 are targets only."""
    for number, of in table.by_instance("I").items():
        angles = np.radians(np.stack([of.column(name) for name in ("YawB", "Pitch", "Roll")], axis=1))
        for t_s, row in zip(of.t_s, angles, strict=True):
            if np.isfinite(row).all():
                q = quat_from_euler(*map(float, row))
                yield float(t_s), GimbalAttitude(t_ns=0, q=q, from_north=False, device=number + 1)


def _of_px4(topics: dict[str, dict[int, Topic]]) -> _Read:
    def first(name: str) -> Topic:
        instances = topics.get(name) or {0: {"timestamp": np.zeros(0)}}
        return instances[min(instances)]

    turned, moved, status, sensors = (first(name) for name in _TOPICS[:4])
    is_armed = numbers(status, "arming_state") == PX4_ARMED
    armed = [(float(t), bool(on)) for t, on in zip(sampled_s(status), is_armed, strict=True)]
    up_s, up_m = sampled_s(moved), -numbers(moved, "z")
    began_s = next((t for t, on in armed if on), -math.inf)
    known = np.flatnonzero(np.isfinite(up_m) & (up_s >= began_s))
    zero_m = float(up_m[known[0]]) if len(known) else 0.0
    accel, gyro = ([f"{name}[{i}]" for i in range(3)] for name in ("accelerometer_m_s2", "gyro_rad"))
    return _Read(
        attitude=ulog.attitude_of(turned),
        heights=(up_s, up_m - zero_m),
        forces=(sampled_s(sensors), columns(sensors, *accel, *gyro)),
        armed=armed,
        exposures={name: sampled_s(first(name)) for name in _TOPICS[5:]},
        gimbal=[one for number, topic in topics.get(_TOPICS[4], {}).items() for one in _device(number, topic)],
    )


def _device(instance: int, topic: Topic) -> Iterator[tuple[float, GimbalAttitude]]:
    q, flags = columns(topic, *(f"q[{i}]" for i in range(4))), np.nan_to_num(numbers(topic, "device_flags"))
    failed, t_s = np.nan_to_num(numbers(topic, "failure_flags")), sampled_s(topic)
    for at_s, one, flag, failure in zip(t_s, q, flags.astype(int), failed.astype(int), strict=True):
        norm = float(np.linalg.norm(one))
        if abs(norm - 1.0) < 0.01 and not failure & ~AT_A_LIMIT:
            w, x, y, z = (float(value) / norm for value in one)
            from_north = yaw_is_from_north(int(flag))
            yield float(at_s), GimbalAttitude(t_ns=0, q=(w, x, y, z), from_north=from_north, device=instance + 1)
