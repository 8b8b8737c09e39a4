"""Messages of the schemas that Foxglove displays without a plugin, derived from ours and recorded beside them.

Schemas: https://docs.foxglove.dev/docs/visualization/message-schemas, JSON form. A derived message has the time of the
message from which it follows. Reading a record ignores them."""

from collections.abc import Iterator
from dataclasses import replace
from enum import IntEnum
from typing import Any

import msgspec
import numpy as np

from terrafix.core.camera import CameraCalibration
from terrafix.core.clock import NS_PER_S
from terrafix.core.geodesy import LocalFrame
from terrafix.core.log_lines import MessageLog
from terrafix.messages import MapMatch, Message, NavEstimate, Origin, Verdict

LOCATION_TOPIC, POSE_TOPIC, LOG_TOPIC, MATCHES_TOPIC = "/location", "/pose", "/log", "/matches"
THUMBNAIL_TOPIC, IMAGE_TOPIC = "/thumbnail", "/image"
LOCAL_FRAME = "local"  # frame of poses: east, north, up about the origin of the flight; up is AMSL
BODY_FRAME = "body"
KNOWN = 3  # position_covariance_type of foxglove.LocationFix: all elements


class LogLevel(IntEnum):
    """Of foxglove.Log."""

    DEBUG = 1
    INFO = 2
    WARNING = 3
    ERROR = 4


class Time(msgspec.Struct, frozen=True):
    sec: int
    nsec: int

    @classmethod
    def of(cls, t_ns: int) -> "Time":
        """MCAP times are unsigned, so negative times are clamped."""
        return cls(*divmod(max(0, t_ns), NS_PER_S))


class Stamped(msgspec.Struct, frozen=True, kw_only=True):
    """Base class of these messages."""

    timestamp: Time


class CompressedImage(Stamped, frozen=True, kw_only=True):
    """``frame_id`` is the frame id as text; ``format``: "jpeg" or "png"; ``data`` is base64 in JSON."""

    frame_id: str
    data: bytes
    format: str = "jpeg"


class LocationFix(Stamped, frozen=True, kw_only=True):
    """``position_covariance``: 3x3, row-major, east, north, up [m^2]."""

    frame_id: str
    latitude: float
    longitude: float
    altitude: float
    position_covariance: tuple[float, ...]
    position_covariance_type: int = KNOWN


class Vector3(msgspec.Struct, frozen=True):
    x: float
    y: float
    z: float


class Quaternion(msgspec.Struct, frozen=True):
    x: float
    y: float
    z: float
    w: float


class Pose(msgspec.Struct, frozen=True):
    position: Vector3
    orientation: Quaternion


class PoseInFrame(Stamped, frozen=True, kw_only=True):
    frame_id: str
    pose: Pose


class Log(Stamped, frozen=True, kw_only=True):
    """``name``: the process or the part that speaks."""

    level: int
    message: str
    name: str
    file: str = ""
    line: int = 0


class Point2(msgspec.Struct, frozen=True):
    x: float
    y: float


class Color(msgspec.Struct, frozen=True):
    r: float
    g: float
    b: float
    a: float = 1.0


class PointsAnnotation(Stamped, frozen=True, kw_only=True):
    """``type`` 1: points; ``points``: pixels of the image, ``thickness`` in them."""

    points: list[Point2]
    outline_color: Color
    type: int = 1
    thickness: float = 3.0


class ImageAnnotations(msgspec.Struct, frozen=True, kw_only=True):
    points: list[PointsAnnotation]


MATCH_USED, MATCH_NOT_USED = Color(0.2, 0.9, 0.4), Color(1.0, 0.7, 0.1)  # green, amber


# Channels: topic and type of message. The schema is named foxglove.<type>.
FOXGLOVE_CHANNELS: dict[str, type[Stamped | ImageAnnotations]] = {
    LOCATION_TOPIC: LocationFix,
    POSE_TOPIC: PoseInFrame,
    LOG_TOPIC: Log,
    MATCHES_TOPIC: ImageAnnotations,
    THUMBNAIL_TOPIC: CompressedImage,
    IMAGE_TOPIC: CompressedImage,
}

_LEVELS = {"debug": LogLevel.DEBUG, "info": LogLevel.INFO, "warning": LogLevel.WARNING, "error": LogLevel.ERROR}


class FoxgloveMessages:
    """Derives messages; keeps the origin of the flight, the camera and the states of the log. ``width_px``: of the
    thumbnails, in which matches are drawn."""

    def __init__(self, width_px: int) -> None:
        self._log, self._width_px = MessageLog(), width_px
        self._frame: LocalFrame | None = None
        self._camera: CameraCalibration | None = None

    def of(self, message: Message) -> Iterator[tuple[str, Stamped | ImageAnnotations]]:
        """Yields (topic, derived message)."""
        if isinstance(message, Origin):
            self._frame = LocalFrame(message.lat_deg, message.lon_deg)
            small = min(1.0, self._width_px / message.camera.width)
            self._camera = CameraCalibration.of(message.camera).scaled(small)
        elif isinstance(message, MapMatch) and message.matches and self._camera is not None:
            yield MATCHES_TOPIC, _matches(message, self._camera)
        elif isinstance(message, NavEstimate) and message.is_placed:
            yield LOCATION_TOPIC, _location(message)
            if self._frame is not None:
                yield POSE_TOPIC, _pose(message, self._frame)
        entry = self._log.entry(message)
        if entry is not None:
            at, level = Time.of(message.t_ns), _LEVELS[entry.level]
            yield LOG_TOPIC, Log(timestamp=at, level=level, name=entry.part, message=entry.text)


def _location(estimate: NavEstimate) -> LocationFix:
    return LocationFix(
        timestamp=Time.of(estimate.t_ns),
        frame_id=BODY_FRAME,
        latitude=estimate.lat_deg,
        longitude=estimate.lon_deg,
        altitude=estimate.alt_amsl_m,
        position_covariance=tuple(estimate.cov[6 * row + column] for row in range(3) for column in range(3)),
    )


def _pose(estimate: NavEstimate, frame: LocalFrame) -> PoseInFrame:
    e_m, n_m = frame.to_local(estimate.lat_deg, estimate.lon_deg)
    w, x, y, z = estimate.q_w_b
    return PoseInFrame(
        timestamp=Time.of(estimate.t_ns),
        frame_id=LOCAL_FRAME,
        pose=Pose(Vector3(e_m, n_m, estimate.alt_amsl_m), Quaternion(x, y, z, w)),
    )


def _matches(match: MapMatch, camera: CameraCalibration) -> ImageAnnotations:
    """The points of the frame that the map has, as the lens shows them."""
    xy = np.array(match.matches)[:, :2]
    pixels = replace(camera, radial_k1=match.radial_k1).project(np.column_stack([xy, np.ones(len(xy))]))
    drawn = PointsAnnotation(
        timestamp=Time.of(match.t_ns),
        points=[Point2(round(float(u), 1), round(float(v), 1)) for u, v in pixels],
        outline_color=MATCH_USED if match.verdict is Verdict.ACCEPTED else MATCH_NOT_USED,
    )
    return ImageAnnotations(points=[drawn])


def schema_name(topic: str) -> str:
    return f"foxglove.{FOXGLOVE_CHANNELS[topic].__name__}"


def schema_of(topic: str) -> bytes:
    """JSON schema of a channel, without references."""
    full = msgspec.json.schema(FOXGLOVE_CHANNELS[topic])
    return msgspec.json.encode(_resolved(full, full["$defs"]) | {"title": schema_name(topic)})


def _resolved(node: dict[str, Any], defs: dict[str, Any]) -> dict[str, Any]:
    if "$ref" in node:
        name = node["$ref"].rsplit("/", 1)[-1]
        title = "time" if name == "Time" else name  # the title by which Foxglove knows a time
        return _resolved(defs[name], defs) | {"title": title}
    if node["type"] == "object":
        return {"type": "object", "properties": {k: _resolved(v, defs) for k, v in node["properties"].items()}}
    if "items" in node:
        return {"type": "array", "items": _resolved(node["items"], defs)}
    return {key: node[key] for key in ("type", "contentEncoding") if key in node}
