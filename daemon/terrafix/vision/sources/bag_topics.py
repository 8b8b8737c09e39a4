"""Which topics of a ROS bag are images, camera, inertial sensor, heading, height, gimbal and truth: by their type where
it is unique, else by the names of mavros, else as they are chosen."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from terrafix.core.errors import SourceError

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
QUATERNION, GIMBAL_DEVICE = "geometry_msgs/msg/Quaternion", "mavros_msgs/msg/GimbalDeviceAttitudeStatus"

MCAP_HEAD = b"\x89MCAP0\r\n\x01"  # magic, opcode of the header
PROFILE_AT = 17 + 4  # after the opcode: length of the header, length of the profile [spec: mcap.dev/spec]


class Kind(NamedTuple):
    """``types`` say what a topic is alone, ``named`` only with the end of its name; of several with one of ``types``
    the one whose name ends in ``preferred`` is meant."""

    types: tuple[str, ...]
    named: tuple[tuple[str, str], ...] = ()
    preferred: str = ""


# Names are those of mavros (mavros and mavros_extras, plugins imu, global_position, altitude, mount_control).
TOPIC_KINDS: dict[str, Kind] = {
    "image": Kind((IMAGE, COMPRESSED)),
    "camera_info": Kind(("sensor_msgs/msg/CameraInfo",)),
    "imu": Kind(("sensor_msgs/msg/Imu",), preferred="/imu/data"),
    "heading": Kind((), (("std_msgs/msg/Float64", "/compass_hdg"),)),
    "height": Kind(("mavros_msgs/msg/Altitude",), (("std_msgs/msg/Float64", "/rel_alt"),)),
    "state": Kind(("mavros_msgs/msg/State",)),
    "gimbal": Kind((GIMBAL_DEVICE,), ((QUATERNION, "/mount_control/orientation"),)),
    "truth": Kind(("sensor_msgs/msg/NavSatFix",), preferred="/global_position/global"),
}


def is_bag(path: Path) -> bool:
    """By name, or, of an MCAP file, by the profile in its header."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    if path.suffix == ".mcap" and path.is_file():
        with path.open("rb") as file:
            head = file.read(64)
        return head.startswith(MCAP_HEAD) and head[PROFILE_AT:].startswith(b"ros")
    return path.suffix in (".bag", ".db3")


def choose_topics(path: Path, types: Mapping[str, str], chosen: Mapping[str, str]) -> dict[str, str]:
    """``types``: of each topic of the bag. ``chosen``: topics by kind, as the user states them; "": none of it. -> the
    topic of each kind that there is. Raises SourceError: a topic or kind that is not there, several that could be
    meant, no images."""
    for kind in chosen:
        if kind not in TOPIC_KINDS:
            raise SourceError(f"{path}: [source] topics has '{kind}'; known are {', '.join(TOPIC_KINDS)}")
    found: dict[str, str] = {}
    for kind, of in TOPIC_KINDS.items():
        topic = chosen[kind] if kind in chosen else _only(path, kind, _candidates(of, types), found)
        if topic and topic not in types:
            raise SourceError(f"{path}: has no topic {topic}; it has {', '.join(sorted(types))}")
        if topic and types[topic] not in (*of.types, *(name for name, _ in of.named)):
            raise SourceError(f"{path}: {topic} is {types[topic]}, which is no {kind}")
        if topic:
            found[kind] = topic
    if "image" not in found:
        raise SourceError(f"{path}: has no images (sensor_msgs/Image or CompressedImage); it has {_listed(types)}")
    return found


def _candidates(of: Kind, types: Mapping[str, str]) -> list[str]:
    by_type = [topic for topic, name in types.items() if name in of.types]
    if of.preferred and len(by_type) > 1:
        by_type = [topic for topic in by_type if topic.endswith(of.preferred)] or by_type
    by_name = [
        topic
        for topic, name in types.items()
        if any(name == kind and topic.endswith(ending) for kind, ending in of.named)
    ]
    return by_name or by_type


def _only(path: Path, kind: str, candidates: list[str], found: Mapping[str, str]) -> str:
    if kind == "image":  # image_transport publishes the same pictures below the name of the raw ones
        candidates = [one for one in candidates if not any(one.startswith(f"{other}/") for other in candidates)]
    if kind == "camera_info" and len(candidates) > 1:
        beside = found.get("image", "").removesuffix("/compressed").rpartition("/")[0]
        candidates = [one for one in candidates if one.rpartition("/")[0] == beside] or candidates
    if len(candidates) > 1:
        raise SourceError(
            f"{path}: several topics could be the {kind}: {', '.join(sorted(candidates))}; choose with --topic "
            f"{kind}=TOPIC, or [source] topics"
        )
    return candidates[0] if candidates else ""


def _listed(types: Mapping[str, str]) -> str:
    return ", ".join(f"{topic} ({name})" for topic, name in sorted(types.items())) or "no topic"
