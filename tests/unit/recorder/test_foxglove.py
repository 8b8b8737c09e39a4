"""Messages in the schemas that Foxglove displays, against the published ones, as the reference reader opens them."""

import base64
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.json_format import ParseDict
from mcap.reader import make_reader

from flight_records import ORIGIN, PERIOD_NS, estimate, live_messages, origin, write_record
from terrafix import messages as m
from terrafix.core.log_lines import MessageLog
from terrafix.recorder import foxglove
from terrafix.recorder.foxglove import FOXGLOVE_CHANNELS, FoxgloveMessages, LogLevel, Stamped

PUBLISHED = {
    message.DESCRIPTOR.full_name: message
    for message in (CompressedImage, ImageAnnotations, LocationFix, Log, PoseInFrame)
}
JSON_TYPES = {
    FieldDescriptor.CPPTYPE_STRING: "string",  # bytes too: base64
    FieldDescriptor.CPPTYPE_DOUBLE: "number",
    FieldDescriptor.CPPTYPE_UINT32: "integer",
    FieldDescriptor.CPPTYPE_ENUM: "integer",
    FieldDescriptor.CPPTYPE_MESSAGE: "object",
}


def derived(*messages: m.Message) -> list[tuple[str, Stamped | foxglove.ImageAnnotations]]:
    source = FoxgloveMessages(32)
    return [found for message in messages for found in source.of(message)]


def logged(message: m.Message) -> tuple[int, str, str]:
    ((topic, log),) = derived(message)
    assert topic == "/log" and isinstance(log, foxglove.Log)
    assert log.timestamp == foxglove.Time.of(message.t_ns)
    return log.level, log.name, log.message


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[tuple[str, dict[str, Any]]]]:
    """By topic, as the reference reader gives them: (name of the schema, message)."""
    path = tmp_path_factory.mktemp("record") / "flight.mcap"
    write_record(path, live_messages())
    found = defaultdict(list)
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            assert schema is not None and channel.message_encoding == "json"
            found[channel.topic].append((schema.name, json.loads(message.data)))
    return found


def check_schema(schema: dict[str, Any], published: Descriptor) -> None:
    """The fields of ``schema`` are fields of the published message, of the same type."""
    fields = {field.name: field for field in published.fields}
    for name, node in schema["properties"].items():
        field = fields[name]
        if field.message_type is not None and field.message_type.full_name == "google.protobuf.Timestamp":
            assert node["title"] == "time" and sorted(node["properties"]) == ["nsec", "sec"]
        elif field.message_type is not None:
            check_schema(node["items"] if field.is_repeated else node, field.message_type)
        elif node["type"] == "array":
            assert field.is_repeated and node["items"]["type"] == JSON_TYPES[field.cpp_type]
        else:
            assert node["type"] == JSON_TYPES[field.cpp_type]
            assert (node.get("contentEncoding") == "base64") == (field.type == FieldDescriptor.TYPE_BYTES)


@pytest.mark.parametrize("topic", FOXGLOVE_CHANNELS)
def test_schemas_are_those_that_are_published(topic: str) -> None:
    schema = json.loads(foxglove.schema_of(topic))
    assert schema["title"] == foxglove.schema_name(topic)
    check_schema(schema, PUBLISHED[schema["title"]].DESCRIPTOR)


@pytest.mark.parametrize("topic", ["/location", "/pose", "/log", "/thumbnail"])
def test_recorded_messages_are_valid_by_the_published_schemas(
    topic: str, recorded: dict[str, list[tuple[str, dict[str, Any]]]]
) -> None:
    assert recorded[topic]
    for name, message in recorded[topic]:
        assert sorted(message.pop("timestamp")) == ["nsec", "sec"]  # protobuf has another form of time in JSON
        ParseDict(message, PUBLISHED[name]())


def test_location_has_position_and_covariance_in_east_north_up() -> None:
    cov = np.arange(36.0).reshape(6, 6)
    given = msgspec.structs.replace(estimate(3, 40.0, 25.0), cov=tuple(cov.ravel().tolist()))
    ((topic, fix),) = derived(given)
    assert topic == "/location" and isinstance(fix, foxglove.LocationFix)
    assert (fix.latitude, fix.longitude, fix.altitude) == (given.lat_deg, given.lon_deg, 600.0)
    assert fix.position_covariance == tuple(cov[:3, :3].ravel())
    assert fix.position_covariance_type == LocationFix.KNOWN
    assert (fix.timestamp.sec, fix.timestamp.nsec) == divmod(3 * PERIOD_NS, 1_000_000_000)


def test_pose_is_in_metres_about_the_origin_with_the_orientation_of_the_body() -> None:
    given = estimate(3, 40.0, 25.0)
    poses = [message for topic, message in derived(origin(), given) if topic == "/pose"]
    (pose,) = poses
    assert isinstance(pose, foxglove.PoseInFrame)
    at, turn = pose.pose.position, pose.pose.orientation
    assert (at.x, at.y, at.z) == pytest.approx((40.0, 25.0, 600.0), abs=1e-6)
    assert (turn.w, turn.x, turn.y, turn.z) == given.q_w_b
    assert ORIGIN.to_wgs84(at.x, at.y) == pytest.approx((given.lat_deg, given.lon_deg), abs=1e-9)


def test_matches_are_drawn_where_the_lens_shows_their_points_in_the_thumbnail() -> None:
    camera = m.Camera(width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=23.5, distortion=(-0.2, 0.0, 0.0, 0.0))
    start = msgspec.structs.replace(origin(), camera=camera)
    match = m.MapMatch(
        t_ns=PERIOD_NS,
        frame_id=1,
        verdict=m.Verdict.ACCEPTED,
        matcher="gradient",
        matches=[(0.0, 0.0, 1, 2, 3, 1), (0.5, 0.0, 1, 2, 3, 1)],
    )
    for verdict, colour in ((m.Verdict.ACCEPTED, foxglove.USED_COLOR), (m.Verdict.AMBIGUOUS, foxglove.NOT_USED_COLOR)):
        found = derived(start, msgspec.structs.replace(match, verdict=verdict))
        (drawn,) = [message for topic, message in found if topic == "/matches"]
        assert isinstance(drawn, foxglove.ImageAnnotations)
        (points,) = drawn.points
        assert points.timestamp == foxglove.Time.of(PERIOD_NS) and points.outline_color == colour  # that of the image
        u_px = 31.5 + 60.0 * 0.5 * (1.0 - 0.2 * 0.25)  # OpenCV's k1; then at half the size
        pixels = [(15.5, 11.5), ((u_px + 0.5) / 2 - 0.5, 11.5)]
        assert np.array([(point.x, point.y) for point in points.points]) == pytest.approx(np.array(pixels), abs=0.06)
        ParseDict(
            {"points": [{"type": 1, "points": [{"x": p.x, "y": p.y} for p in points.points]}]}, ImageAnnotations()
        )
    assert "/matches" not in dict(derived(start, msgspec.structs.replace(match, matches=[])))


def test_recorded_image_is_base64_of_the_file(recorded: dict[str, list[tuple[str, dict[str, Any]]]]) -> None:
    _, image = recorded["/thumbnail"][2]
    assert (image["frame_id"], image["format"]) == ("2", "jpeg")
    assert base64.b64decode(image["data"]).startswith(b"\xff\xd8")


@pytest.mark.parametrize(
    ("message", "level"),
    [
        (m.StatusText(t_ns=7, severity=7, text="no map fix"), LogLevel.DEBUG),
        (m.StatusText(t_ns=7, severity=5, text="no map fix"), LogLevel.INFO),
        (m.SearchState(t_ns=7, step=m.SearchStep.WHOLE_MAP), LogLevel.WARNING),
        (m.ModelEvent(t_ns=7, model="a", change=m.ModelChange.GIVEN_UP, provider="CPU", detail=""), LogLevel.ERROR),
    ],
)
def test_a_line_of_the_log_has_the_level_of_foxglove(message: m.Message, level: LogLevel) -> None:
    entry = MessageLog().entry(message)
    assert entry is not None and logged(message) == (level, entry.part, entry.text)


def test_a_line_of_the_log_of_a_process_is_recorded_with_its_fields() -> None:
    line = m.LogLine(t_ns=7, process="recorder", level="error", event="recording stopped", fields={"reason": "full"})
    assert logged(line) == (LogLevel.ERROR, "recorder", "recording stopped, reason full")


def test_accepted_measurements_are_not_logged() -> None:
    assert not derived(m.MeasurementVerdict(t_ns=7, frame_id=4, measurement="map", verdict=m.Verdict.ACCEPTED))


def test_times_before_zero_are_clamped() -> None:
    assert foxglove.Time.of(-5) == foxglove.Time(0, 0)


def test_derived_messages_have_the_times_of_their_source(tmp_path: Path) -> None:
    write_record(tmp_path / "flight.mcap", [origin(), estimate(4, 0.0, 0.0)])
    with (tmp_path / "flight.mcap").open("rb") as stream:
        times = {
            channel.topic: (message.log_time, message.publish_time)
            for _, channel, message in make_reader(stream).iter_messages()
        }
    assert times["/location"] == times["/pose"] == times["/nav_estimate"] == (4 * PERIOD_NS, 4 * PERIOD_NS)
