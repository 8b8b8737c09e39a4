"""A short flight as bags of ROS 1 and ROS 2, written by the library rosbags."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2.enums import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from source_folders import picture
from terrafix.core.geodesy import quat_from_rot, rot_w_b
from terrafix.vision.sources.bag_reader import MAVROS

KINDS = ("ros1", "sqlite3", "mcap")
SIZE, FOCAL_PX = (320, 240), 280.0
BEGAN_NS = 1_700_000_000_000_000_000
S = 1_000_000_000
IMAGES, IMAGE_HZ = 9, 4.0
YAW_RAD, PITCH_RAD, ROLL_RAD = 0.7, 0.05, -0.1  # of the body (forward, right, down), plus 0.01 rad/s in yaw
LAT_DEG, LON_DEG = 48.0, 11.0  # at the first image; north by 1e-5 degrees a second


class _Bag:
    """Messages by name and fields, of both versions of ROS."""

    def __init__(self, path: Path, kind: str) -> None:
        self.ros1 = kind == "ros1"
        self.store: Any = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        for name, text in MAVROS.items():
            self.store.register(get_types_from_msg(text, name))
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        self.writer: Any = rosbag1.Writer(path) if self.ros1 else rosbag2.Writer(path, version=9, storage_plugin=plugin)
        self._connections: dict[str, Any] = {}

    def make(self, name: str, **fields: Any) -> Any:
        kind = self.store.types[name]
        known = kind.__dataclass_fields__
        if "header" in known:
            fields["header"] = self.header(fields.pop("at_ns"))
        for short, long in (("k", "K"), ("d", "D"), ("r", "R"), ("p", "P")):
            if long in known and short in fields:
                fields[long] = fields.pop(short)
        return kind(**fields)

    def header(self, at_ns: int) -> Any:
        stamp = self.store.types["builtin_interfaces/msg/Time"](sec=at_ns // S, nanosec=at_ns % S)
        number = {"seq": 0} if self.ros1 else {}
        return self.store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="", **number)

    def write(self, topic: str, name: str, t_ns: int, message: Any) -> None:
        if topic not in self._connections:
            self._connections[topic] = self.writer.add_connection(topic, name, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.writer.write(self._connections[topic], t_ns, serialize(message, name))


def write_bag(path: Path, kind: str, *, stamps_from_ns: int = BEGAN_NS, **options: Any) -> Path:
    """``stamps_from_ns``: time of the headers at the beginning; that of recording is BEGAN_NS. Options: encoding (of
    the images; "jpeg": compressed), cameras (number of them), k (focal length in CameraInfo), still (the orientation
    never changes), without (topics that are left out)."""
    bag = _Bag(path, kind)
    with bag.writer:
        for tick in range(round(50 * IMAGES / IMAGE_HZ)):
            _telemetry(bag, tick, stamps_from_ns, options)
        for i in range(IMAGES):
            for number in range(options.get("cameras", 1)):
                _image(bag, i, f"/cam{number}", stamps_from_ns, options)
    return path


def _telemetry(bag: _Bag, tick: int, from_ns: int, options: dict[str, Any]) -> None:
    after_s, t_ns, at_ns = tick / 50, BEGAN_NS + tick * S // 50, from_ns + tick * S // 50
    vector, quaternion = (bag.store.types[f"geometry_msgs/msg/{name}"] for name in ("Vector3", "Quaternion"))
    yaw_rad = YAW_RAD if options.get("still") else YAW_RAD + 0.01 * after_s
    w, x, y, z = quat_from_rot(rot_w_b(yaw_rad, PITCH_RAD, ROLL_RAD) @ np.diag([1.0, -1.0, -1.0]))
    covariance = np.zeros(9)
    messages = {
        "/mavros/imu/data": ("sensor_msgs/msg/Imu", {
            "orientation": quaternion(x=x, y=y, z=z, w=w), "orientation_covariance": covariance,
            "angular_velocity": vector(x=0.1, y=0.2, z=0.3), "angular_velocity_covariance": covariance,
            "linear_acceleration": vector(x=1.0, y=2.0, z=9.8), "linear_acceleration_covariance": covariance,
        }),
        "/mavros/imu/data_raw": ("sensor_msgs/msg/Imu", {
            "orientation": quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
            "orientation_covariance": np.array([-1.0, *[0.0] * 8]),
            "angular_velocity": vector(x=9.0, y=9.0, z=9.0), "angular_velocity_covariance": covariance,
            "linear_acceleration": vector(x=9.0, y=9.0, z=9.0), "linear_acceleration_covariance": covariance,
        }),
        "/mavros/global_position/compass_hdg": ("std_msgs/msg/Float64", {"data": 271.5}),
        "/mavros/global_position/rel_alt": ("std_msgs/msg/Float64", {"data": 80.0 + after_s}),
        "/mavros/battery_hint": ("std_msgs/msg/Float64", {"data": 12.6}),
        "/mavros/state": ("mavros_msgs/msg/State", {
            "connected": True, "armed": after_s >= 1.0, "guided": False, "manual_input": False, "mode": "AUTO",
            "system_status": 4,
        }),
        "/mavros/gimbal_control/device/attitude_status": ("mavros_msgs/msg/GimbalDeviceAttitudeStatus", {
            "target_system": 1, "target_component": 154, "flags": 64,
            "q": quaternion(x=0.0, y=-np.sqrt(0.5), z=0.0, w=np.sqrt(0.5)),
            "angular_velocity_x": 0.0, "angular_velocity_y": 0.0, "angular_velocity_z": 0.0, "failure_flags": 0,
        }),
        "/mavros/global_position/global": ("sensor_msgs/msg/NavSatFix", {
            "status": bag.store.types["sensor_msgs/msg/NavSatStatus"](status=0, service=1),
            "latitude": LAT_DEG + 1e-5 * after_s, "longitude": LON_DEG, "altitude": 500.0,
            "position_covariance": covariance, "position_covariance_type": 0,
        }),
    }  # fmt: skip
    for topic, (name, fields) in messages.items():
        if topic not in options.get("without", ()):
            stamped = {} if name.startswith("std_msgs") else {"at_ns": at_ns}
            bag.write(topic, name, t_ns, bag.make(name, **fields, **stamped))


def _image(bag: _Bag, i: int, camera: str, from_ns: int, options: dict[str, Any]) -> None:
    encoding = options.get("encoding", "bgr8")
    at_ns, (width, height) = round(i / IMAGE_HZ * S), SIZE
    bgr = picture(i, *SIZE)
    if encoding == "jpeg":
        data = np.frombuffer(cv2.imencode(".jpg", bgr)[1].tobytes(), np.uint8)
        name, topic = "sensor_msgs/msg/CompressedImage", f"{camera}/image_raw/compressed"
        message = bag.make(name, at_ns=from_ns + at_ns, format="bgr8; jpeg compressed bgr8", data=data)
    else:
        pixels = encoded(bgr, encoding)
        rows = np.zeros((height, pixels.shape[1] + 32), np.uint8)  # a step that is longer than the row
        rows[:, : pixels.shape[1]] = pixels
        name, topic = "sensor_msgs/msg/Image", f"{camera}/image_raw"
        message = bag.make(
            name, at_ns=from_ns + at_ns, height=height, width=width, encoding=encoding, is_bigendian=0,
            step=rows.shape[1], data=rows.reshape(-1),
        )  # fmt: skip
    bag.write(topic, name, BEGAN_NS + at_ns + 30_000_000, message)
    focal = options.get("k", FOCAL_PX)
    region = bag.store.types["sensor_msgs/msg/RegionOfInterest"](
        x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    info = bag.make(
        "sensor_msgs/msg/CameraInfo", at_ns=from_ns + at_ns, height=height, width=width, distortion_model="plumb_bob",
        d=np.array([0.01, -0.02, 0.0, 0.0, 0.0]), k=np.array([focal, 0, 161.0, 0, focal, 119.0, 0, 0, 1.0]),
        r=np.eye(3).reshape(-1), p=np.zeros(12), binning_x=0, binning_y=0, roi=region,
    )  # fmt: skip
    bag.write(f"{camera}/camera_info", "sensor_msgs/msg/CameraInfo", BEGAN_NS + at_ns + 30_000_000, info)


def encoded(bgr: np.ndarray, encoding: str) -> np.ndarray:
    """(H, W, 3) BGR -> rows of bytes as sensor_msgs/Image has them."""
    height = len(bgr)
    if encoding == "rgb8":
        bgr = bgr[:, :, ::-1]
    elif encoding == "bgra8":
        bgr = np.dstack([bgr, np.full(bgr.shape[:2], 255, np.uint8)])
    elif encoding == "mono8":
        bgr = bgr[:, :, 1]
    elif encoding == "mono16":
        bgr = (bgr[:, :, 1].astype("<u2") << 8).view(np.uint8)
    elif encoding == "bayer_rggb8":  # the first row is red, green; the second green, blue
        blue, green, red = (bgr[:, :, i] for i in range(3))
        mosaic = green.copy()
        mosaic[0::2, 0::2], mosaic[1::2, 1::2] = red[0::2, 0::2], blue[1::2, 1::2]
        bgr = mosaic
    return np.ascontiguousarray(bgr).reshape(height, -1)
