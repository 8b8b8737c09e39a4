"""A ROS 2 bag (MCAP) by the library rosbags: positions and poses, which rviz2, PlotJuggler and robot_localization take.

Messages of sensor_msgs and geometry_msgs (REP 103: east, north, up; REP 105: frames). Heights are above mean sea
level, where NavSatFix states ellipsoidal ones: the geoid is not subtracted."""

from pathlib import Path
from typing import Any, Final

import numpy as np

from terrafix.core.geodesy import quat_from_rot
from terrafix_tools.estimates import NS
from terrafix_tools.export.track import Track, TrackPose

FIX_TOPIC, POSE_TOPIC = "/terrafix/fix", "/terrafix/pose"
MAP_FRAME, CAMERA_FRAME = "map", "camera_optical_frame"
VERSION: Final = 9  # of bags since ROS 2 Iron; Humble reads it, too
STATUS_FIX, SERVICE_UNKNOWN, KNOWN = 0, 0, 3  # sensor_msgs/NavSatStatus, NavSatFix


def write_bag(track: Track, out: Path, _photos: Path | None) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    out.parent.mkdir(parents=True, exist_ok=True)
    if out.is_dir():
        out.rmdir()  # empty; the writer makes it
    with Writer(out, version=VERSION, storage_plugin=StoragePlugin.MCAP) as writer:
        fixes = writer.add_connection(FIX_TOPIC, "sensor_msgs/msg/NavSatFix", typestore=store)
        poses = writer.add_connection(POSE_TOPIC, "geometry_msgs/msg/PoseWithCovarianceStamped", typestore=store)
        for pose in track.poses:
            t_ns = round((pose.row.t_s if pose.unix_s is None else pose.unix_s) * NS)
            for connection, message in ((fixes, _fix(store, pose, t_ns)), (poses, _pose(store, track, pose, t_ns))):
                if message is not None:
                    writer.write(connection, t_ns, store.serialize_cdr(message, connection.msgtype))


def _header(store: Any, t_ns: int, frame: str) -> Any:
    time = store.types["builtin_interfaces/msg/Time"](sec=t_ns // NS, nanosec=t_ns % NS)
    return store.types["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def _fix(store: Any, pose: TrackPose, t_ns: int) -> Any:
    """Height NaN: not known (as the message defines it)."""
    known = pose.cov is not None
    return store.types["sensor_msgs/msg/NavSatFix"](
        header=_header(store, t_ns, CAMERA_FRAME),
        status=store.types["sensor_msgs/msg/NavSatStatus"](status=STATUS_FIX, service=SERVICE_UNKNOWN),
        latitude=pose.lat_deg,
        longitude=pose.lon_deg,
        altitude=float("nan") if pose.row.alt_amsl_m is None else pose.row.alt_amsl_m,
        position_covariance=np.zeros(9) if pose.cov is None else pose.cov[:3, :3].ravel(),
        position_covariance_type=KNOWN if known else 0,
    )


def _pose(store: Any, track: Track, pose: TrackPose, t_ns: int) -> Any:
    """None: a position without orientation."""
    if pose.r_w_c is None or pose.cov is None:
        return None
    w, x, y, z = quat_from_rot(pose.r_w_c)
    e_m, n_m, u_m = (float(value) for value in track.position_m(pose))
    geometry = "geometry_msgs/msg/"
    return store.types[geometry + "PoseWithCovarianceStamped"](
        header=_header(store, t_ns, MAP_FRAME),
        pose=store.types[geometry + "PoseWithCovariance"](
            pose=store.types[geometry + "Pose"](
                position=store.types[geometry + "Point"](x=e_m, y=n_m, z=u_m),
                orientation=store.types[geometry + "Quaternion"](x=x, y=y, z=z, w=w),
            ),
            covariance=pose.cov.ravel(),
        ),
    )
