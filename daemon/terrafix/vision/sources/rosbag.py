"""Bag of ROS 1 (.bag) or ROS 2 (folder with metadata.yaml, .db3, .mcap), read by the library rosbags.

Axes of REP 103 and 145: inertial readings forward, left, up; orientation of these axes in east, north, up. Gimbals and
headings are as MAVLink has them: mavros passes them on. NavSatFix is read as truth only."""

import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from terrafix.core.autopilot_log.own_log import MAX_IMU_HZ, imu_batches
from terrafix.core.errors import SourceError
from terrafix.core.geodesy import euler_from_rot, rot_from_quat
from terrafix.core.mavlink.gimbal import AT_A_LIMIT, MAX_NORM_ERROR, yaw_is_from_north
from terrafix.core.mavlink.vehicles import HeardVehicle
from terrafix.messages import Camera, Fact, Frame, GimbalAttitude, Imu, Quat, VehicleState
from terrafix.vision.sources.bag_reader import BagReader
from terrafix.vision.sources.bag_topics import COMPRESSED, choose_topics
from terrafix.vision.sources.camera_info import camera_of_info
from terrafix.vision.sources.contract import Shot, SourceBase, TelemetryCursor
from terrafix.vision.sources.description import Description, camera_of, origin_of, read_description, with_mount
from terrafix.vision.sources.facts import camera_facts, log_facts, mount_fact, rate_facts, start_fact, telemetry_facts
from terrafix.vision.sources.images import WRONG_SIZE, decode_image, downscale_factor, downscaled_camera
from terrafix.vision.sources.plausible import check_heights
from terrafix.vision.sources.positions import positions_at

MAX_CLOCKS_APART_NS = 10_000_000_000  # stamps farther from the time of recording are of another clock
FLU_TO_FRD = np.diag([1.0, -1.0, -1.0])
CODES = {  # encoding -> channels, bytes of one, conversion to BGR [spec: sensor_msgs/image_encodings.h]
    "bgr8": (3, 1, None), "8UC3": (3, 1, None), "rgb8": (3, 1, cv2.COLOR_RGB2BGR), "bgra8": (4, 1, cv2.COLOR_BGRA2BGR),
    "8UC4": (4, 1, cv2.COLOR_BGRA2BGR), "rgba8": (4, 1, cv2.COLOR_RGBA2BGR), "mono8": (1, 1, cv2.COLOR_GRAY2BGR),
    "8UC1": (1, 1, cv2.COLOR_GRAY2BGR), "mono16": (1, 2, cv2.COLOR_GRAY2BGR), "16UC1": (1, 2, cv2.COLOR_GRAY2BGR),
    # OpenCV names a pattern by its second row
    "bayer_rggb8": (1, 1, cv2.COLOR_BayerBG2BGR), "bayer_bggr8": (1, 1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg8": (1, 1, cv2.COLOR_BayerGR2BGR), "bayer_grbg8": (1, 1, cv2.COLOR_BayerGB2BGR),
    "yuv422": (2, 1, cv2.COLOR_YUV2BGR_UYVY), "uyvy": (2, 1, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (2, 1, cv2.COLOR_YUV2BGR_YUY2), "yuyv": (2, 1, cv2.COLOR_YUV2BGR_YUY2),
}  # fmt: skip


@dataclass
class BagTelemetry:
    """The same as ``TelemetryLog`` of a ground station's log."""

    path: Path
    clock: str
    zero: str = "the first image"
    states: list[VehicleState] = field(default_factory=list)
    imu: list[Imu] = field(default_factory=list)
    gimbal: list[GimbalAttitude] = field(default_factory=list)
    skipped_bytes: int = 0
    vehicles: tuple[HeardVehicle, ...] = ()
    said: list[str] = field(default_factory=list)

    def notes(self) -> list[str]:
        return self.said


class RosBag(SourceBase):
    """Takes ``rate_hz`` images per second. ``topics``: by kind (``bag_topics``). Camera: [camera] of BAG.toml or
    flight.toml beside the bag, or of ``camera``; else CameraInfo. Raises SourceError."""

    def __init__(
        self,
        path: Path,
        start: tuple[float, float] | None = None,
        camera: Path | None = None,
        rate_hz: float = 2.0,
        topics: Mapping[str, str] | None = None,
    ) -> None:
        self.path, self._start_given, self._period_ns = path, start is not None, round(1e9 / rate_hz)
        beside = (camera, path.with_suffix(".toml"), path.with_name("flight.toml"))
        self._where = next((one for one in beside if one is not None and one.is_file()), None)
        self._description = Description() if self._where is None else read_description(self._where)
        with BagReader(self.path) as reader:
            self._topics = choose_topics(path, reader.types(), topics or {})
            self._times_ns, self._by_stamp = self._image_times(reader)
            self._stored, self._camera_from, notes = self._camera(reader)
            self._log = self._telemetry(reader)
        self._log.said += notes
        check_heights(path, [s.agl_m for s in self._log.states if s.agl_m is not None], self._topics.get("height", ""))
        self._origin = origin_of(self._description, downscaled_camera(self._stored), start)

    def length(self) -> int | None:
        return len(self._taken())

    def name(self) -> str:
        return self._description.name or self.path.stem

    def map_hint(self) -> Path | None:
        named = self._description.map
        return (self._where.parent / named).resolve() if named and self._where is not None else None

    def facts(self) -> list[Fact]:
        described = "the default" if self._where is None else self._where.name
        times_s = sorted((t_ns - self._times_ns[0]) / 1e9 for t_ns in self._times_ns)
        used = ", ".join(f"{kind} {topic}" for kind, topic in self._topics.items() if kind != "truth")
        found = [
            *camera_facts(self._stored, self._camera_from),
            mount_fact(self._stored, f"[mount] of {described}" if self._where is not None else described),
            start_fact(self._origin, "--start" if self._start_given else f"[start] of {described}"),
            Fact("topics", used),
            *rate_facts(times_s, "images"),
            Fact("rate", f"{1e9 / self._period_ns:g} images a second are taken ([source] rate_hz)"),
            *telemetry_facts(self._log.states, self.path.name, self._origin),
            *log_facts(self._log),
        ]
        if "truth" in self._topics:
            found.append(Fact("left out", f"{self._topics['truth']} is truth: terrafix source truth writes it"))
        return found

    def shots(self, from_s: float = 0.0) -> Iterator[Shot]:
        from_ns, camera = round(from_s * 1e9), self._origin.camera
        log, taken = self._log, self._taken()
        states_of, imu_of = TelemetryCursor(log.states, from_ns), TelemetryCursor(log.imu, from_ns)
        gimbal_of = TelemetryCursor(log.gimbal, from_ns)
        with BagReader(self.path) as reader:
            for number, (_, message_type, raw) in enumerate(reader.raw(self._topics["image"])):
                frame_id = taken.get(number)
                if frame_id is None:
                    continue
                t_ns = self._times_ns[number] - self._times_ns[0]
                states, imu, held = states_of(t_ns), imu_of(t_ns), gimbal_of(t_ns)
                if t_ns < from_ns:
                    continue
                image, error = self._decoded(reader.decoded(raw, message_type), message_type)
                frame = Frame(
                    t_ns=t_ns,
                    frame_id=frame_id,
                    file=self._file(number),
                    width=camera.width,
                    height=camera.height,
                    error=error,
                )
                yield Shot(frame, states, image, imu, held)

    def truth(self) -> list[tuple[str, float, float]]:
        """(file, latitude, longitude) of the images between two fixes."""
        if "truth" not in self._topics:
            raise SourceError(f"{self.path}: has no sensor_msgs/NavSatFix, which would be the truth")
        with BagReader(self.path) as reader:
            fixes = [
                (t_ns, fix.latitude, fix.longitude)
                for t_ns, fix in self._decoded_messages(reader, "truth")
                if fix.status.status >= 0 and np.isfinite([fix.latitude, fix.longitude]).all()
            ]
        return positions_at(((self._file(number), self._times_ns[number]) for number in self._taken()), fixes)

    def _file(self, number: int) -> str:
        return f"{self.path.name}@{(self._times_ns[number] - self._times_ns[0]) / 1e9:.3f}"

    def _taken(self) -> dict[int, int]:
        """Frame ids by the number of the image in the bag."""
        taken: dict[int, int] = {}
        due_ns, last_ns = 0, -1
        for number, stamp_ns in enumerate(self._times_ns):
            t_ns = stamp_ns - self._times_ns[0]
            if t_ns > last_ns and t_ns >= due_ns:
                taken[number] = len(taken)
                due_ns = max(due_ns + self._period_ns, t_ns + self._period_ns // 2)
                last_ns = t_ns
        return taken

    # --- the bag ----------------------------------------------------------------------------------

    def _decoded_messages(self, reader: BagReader, kind: str) -> Iterator[tuple[int, Any]]:
        """(time, message) of a kind: of its header where there is one and the images are timed by theirs."""
        for log_ns, message_type, raw in reader.raw(self._topics.get(kind, "")):
            message = reader.decoded(raw, message_type)
            stamp = getattr(getattr(message, "header", None), "stamp", None)
            stamp_ns = 0 if stamp is None else stamp.sec * 1_000_000_000 + stamp.nanosec
            near = abs(stamp_ns - log_ns) <= MAX_CLOCKS_APART_NS
            yield (stamp_ns if self._by_stamp and near else log_ns), message

    def _image_times(self, reader: BagReader) -> tuple[list[int], bool]:
        """-> times of the images, and whether they are those of their headers, else of recording."""
        log_ns, stamps_ns = [], []
        for recorded_ns, _, raw in reader.raw(self._topics["image"]):
            # A header begins with its time: after the number of ROS 1, or the encapsulation of ROS 2.
            seconds, nanoseconds = struct.unpack_from("<II", raw.ljust(12, b"\0"), 4)
            log_ns.append(recorded_ns)
            stamps_ns.append(seconds * 1_000_000_000 + nanoseconds)
        if not log_ns:
            raise SourceError(f"{self.path}: {self._topics['image']} has no message")
        apart_ns = np.median(np.abs(np.array(stamps_ns) - np.array(log_ns)))
        return (stamps_ns, True) if apart_ns <= MAX_CLOCKS_APART_NS else (log_ns, False)

    def _camera(self, reader: BagReader) -> tuple[Camera, str, list[str]]:
        if self._where is not None and self._description.camera is not None:
            return camera_of(self._where, self._description), f"[camera] of {self._where.name}", []
        for _, info in self._decoded_messages(reader, "camera_info"):
            try:
                camera, notes = camera_of_info(self.path, _info_table(info))
            except (KeyError, ValueError) as error:
                raise SourceError(
                    f"{self.path}: {self._topics['camera_info']} has {error}; write {self.path.stem}.toml beside it "
                    "with [camera]"
                ) from None
            return (
                with_mount(self.path, camera, self._description.mount),
                f"CameraInfo of {self._topics['camera_info']}",
                notes,
            )
        raise SourceError(
            f"{self.path}: has no sensor_msgs/CameraInfo; write {self.path.stem}.toml beside it with [camera]"
        )

    def _telemetry(self, reader: BagReader) -> BagTelemetry:
        clock = "stamps of the headers" if self._by_stamp else "times of recording: the stamps are of another clock"
        log = BagTelemetry(self.path, clock)
        armed: bool | None = None
        states: list[VehicleState] = []
        switches = [(t_ns, bool(state.armed)) for t_ns, state in self._decoded_messages(reader, "state")]
        states += self._inertial(reader, log)
        states += [
            self._state(t_ns, yaw_rad=math.remainder(math.radians(message.data), math.tau))
            for t_ns, message in self._decoded_messages(reader, "heading")
            if np.isfinite(message.data)
        ]
        for t_ns, message in self._decoded_messages(reader, "height"):
            height_m = float(message.relative if hasattr(message, "relative") else message.data)
            if np.isfinite(height_m):
                states.append(self._state(t_ns, agl_m=height_m))
        for one in sorted(states, key=lambda state: state.t_ns):
            while switches and switches[0][0] - self._times_ns[0] <= one.t_ns:
                armed = switches.pop(0)[1]
            log.states.append(_replaced(one, armed))
        log.gimbal = list(self._gimbals(reader))
        return log

    def _state(self, t_ns: int, **fields: float) -> VehicleState:
        return VehicleState(t_ns=t_ns - self._times_ns[0], source="rosbag", **fields)  # type: ignore[arg-type]

    def _inertial(self, reader: BagReader, log: BagTelemetry) -> list[VehicleState]:
        """Attitudes, thinned to MAX_IMU_HZ; sets the inertial readings of ``log``."""
        times_s: list[float] = []
        readings: list[list[float]] = []
        attitudes: list[tuple[int, Quat]] = []
        for t_ns, imu in self._decoded_messages(reader, "imu"):
            times_s.append((t_ns - self._times_ns[0]) / 1e9)
            force, rate = imu.linear_acceleration, imu.angular_velocity
            readings.append([force.x, -force.y, -force.z, rate.x, -rate.y, -rate.z])
            q = imu.orientation
            if imu.orientation_covariance[0] != -1.0 and abs(q.w**2 + q.x**2 + q.y**2 + q.z**2 - 1.0) < MAX_NORM_ERROR:
                attitudes.append((t_ns, (q.w, q.x, q.y, q.z)))
        if readings:
            log.imu = imu_batches(np.array(times_s), np.array(readings), lambda t_s: round(t_s * 1e9), "rosbag")
        if len({q for _, q in attitudes}) <= 1:
            if attitudes:
                log.said.append(f"orientation of {self._topics['imu']} never changes: not reported")
            return []
        found: list[VehicleState] = []
        for t_ns, q in attitudes:
            yaw, pitch, roll = euler_from_rot(rot_from_quat(q) @ FLU_TO_FRD)
            state = self._state(t_ns, yaw_rad=yaw, pitch_rad=pitch, roll_rad=roll)
            if not found or state.t_ns - found[-1].t_ns >= 0.999e9 / MAX_IMU_HZ:
                found.append(state)
        log.said.append(f"attitude of {self._topics['imu']}: taken as east, north, up (REP 145), with a true heading")
        return found

    def _gimbals(self, reader: BagReader) -> Iterator[GimbalAttitude]:
        for t_ns, message in self._decoded_messages(reader, "gimbal"):
            plain = not hasattr(message, "q")
            q = message if plain else message.q
            norm = float(np.sqrt(q.w**2 + q.x**2 + q.y**2 + q.z**2))
            if not abs(norm - 1.0) <= MAX_NORM_ERROR or (not plain and message.failure_flags & ~AT_A_LIMIT):
                continue
            yield GimbalAttitude(
                t_ns=t_ns - self._times_ns[0],
                q=(q.w / norm, q.x / norm, q.y / norm, q.z / norm),
                from_north=not plain and yaw_is_from_north(message.flags),
                device=0 if plain else message.target_component,
            )

    def _decoded(self, message: Any, message_type: str) -> tuple[np.ndarray | None, str]:
        width, height = self._stored.width, self._stored.height
        by = downscale_factor(width)
        if message_type == COMPRESSED:
            return decode_image(message.data.tobytes(), width, height, by)
        if (message.width, message.height) != (width, height):
            return None, f"{WRONG_SIZE}: {message.width}x{message.height}, the camera says {width}x{height}"
        try:
            image = raw_image(message)
        except (ValueError, cv2.error):
            return None, f"cannot be decoded: {message.encoding}, {len(message.data)} bytes"
        if by > 1:
            image = cv2.resize(image, (-(-width // by), -(-height // by)), interpolation=cv2.INTER_AREA)
        return image, ""


def raw_image(message: Any) -> np.ndarray:
    """sensor_msgs/Image -> (H, W, 3) uint8 BGR. Raises ValueError: an encoding that is not known, too few bytes."""
    if message.encoding not in CODES:
        raise ValueError(message.encoding)
    channels, size, code = CODES[message.encoding]
    rows = np.frombuffer(message.data, np.uint8)[: message.step * message.height].reshape(message.height, message.step)
    pixels = np.ascontiguousarray(rows[:, : message.width * channels * size])
    if size == 2:
        words = pixels.view(">u2" if message.is_bigendian else "<u2").reshape(message.height, message.width)
        pixels = (words >> 8).astype(np.uint8)
    image = pixels.reshape(message.height, message.width, channels)
    return image if code is None else cv2.cvtColor(image, code)


def _info_table(info: Any) -> dict[str, Any]:
    """CameraInfo as camera_info files have it: K and D of ROS 1, k and d of ROS 2."""
    table = {name: getattr(info, name) for name in ("height", "width", "distortion_model", "binning_x", "binning_y")}
    table["K"], table["D"] = (getattr(info, name, getattr(info, name.lower(), None)) for name in ("K", "D"))
    roi = info.roi
    return table | {"roi": {name: getattr(roi, name) for name in ("x_offset", "y_offset", "width", "height")}}


def _replaced(state: VehicleState, armed: bool | None) -> VehicleState:
    return VehicleState(
        t_ns=state.t_ns, source=state.source, yaw_rad=state.yaw_rad, pitch_rad=state.pitch_rad,
        roll_rad=state.roll_rad, agl_m=state.agl_m, armed=armed,
    )  # fmt: skip
