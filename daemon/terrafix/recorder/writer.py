"""One MCAP file of the flight record: complete header, then messages with regular flushes that limit the loss at a
kill."""

import base64
import os
from importlib.metadata import version
from pathlib import Path

import msgspec
from mcap.writer import CompressionType, Writer

from terrafix.core.config import RecorderSection
from terrafix.core.errors import OutputError
from terrafix.messages import Message, Origin, SourceFacts
from terrafix.recorder import foxglove
from terrafix.recorder.foxglove import IMAGE_TOPIC, THUMBNAIL_TOPIC, CompressedImage, FoxgloveMessages, Time
from terrafix.recorder.schema import MESSAGE_TYPES, schema_of, topic_of

CHUNK_BYTES = 128 * 1024  # largest loss at a kill between two calls of flush(); also the unit of compression
# Metadata records
HEADER_NAME, CALIBRATION_NAME, SOURCE_NAME = "terrafix", "terrafix.calibration", "terrafix.source"

_encoder = msgspec.json.Encoder()


class FlightWriter:
    """Writes one file. Not thread-safe. Raises OutputError when the file cannot be created."""

    def __init__(self, path: Path, header_metadata: dict[str, str]) -> None:
        self.path = path
        try:
            # A raw (unbuffered) file would be wrapped by mcap in a buffer that cannot be flushed from outside.
            self._file = path.open("wb")
        except OSError as error:
            raise OutputError(
                f"{path}: cannot be written ({error.strerror}); check the folder given to --out"
            ) from None
        self._mcap = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._mcap.start(profile="", library=f"terrafix {version('terrafix')}")
        self._mcap.add_metadata(HEADER_NAME, header_metadata)
        self._channels: dict[str, int] = {}
        self._sequence = 0
        for message_type in MESSAGE_TYPES.values():
            self._register(topic_of(message_type), f"terrafix.{message_type.__name__}", schema_of(message_type))
        for topic in foxglove.FOXGLOVE_CHANNELS:
            self._register(topic, foxglove.schema_name(topic), foxglove.schema_of(topic))
        config = msgspec.json.decode(header_metadata.get("config", "{}"))
        width_px = config.get("recorder", {}).get("thumbnail_width_px", RecorderSection().thumbnail_width_px)
        self._foxglove = FoxgloveMessages(width_px)
        self.flush()

    def write(self, message: Message, received_ns: int) -> None:
        """In MCAP, log_time is the time of the measurement and publish_time the time of reception at the recorder."""
        self._add(topic_of(type(message)), _encoder.encode(message), message.t_ns, received_ns)
        if isinstance(message, Origin):
            self._mcap.add_metadata(CALIBRATION_NAME, {"camera": _encoder.encode(message.camera).decode()})
        if isinstance(message, SourceFacts):
            self._mcap.add_metadata(SOURCE_NAME, {"facts": _encoder.encode(message.facts).decode()})
        for topic, derived in self._foxglove.of(message):
            self._add(topic, _encoder.encode(derived), message.t_ns, received_ns)

    def write_thumbnail(self, t_ns: int, frame_id: int, jpeg: bytes) -> None:
        self._image(THUMBNAIL_TOPIC, t_ns, CompressedImage(timestamp=Time.of(t_ns), frame_id=str(frame_id), data=jpeg))

    def write_frame_image(self, t_ns: int, frame_id: int, data: bytes, image_format: str) -> None:
        """``data``: a frame at full size (``ImagePolicy.encoded``)."""
        image = CompressedImage(timestamp=Time.of(t_ns), frame_id=str(frame_id), data=data, format=image_format)
        self._image(IMAGE_TOPIC, t_ns, image)

    def size_bytes(self) -> int:
        return self._file.tell()

    def flush(self) -> None:
        """Passes all data to the operating system, so that kill -9 of this process does not lose it."""
        self._mcap.flush()  # type: ignore[no-untyped-call]

    def sync(self) -> None:
        """Passes what was flushed to the disk, so that a power cut does not lose it. A slow disk takes seconds."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        try:
            self._mcap.finish()  # type: ignore[no-untyped-call]
        finally:
            self._file.close()

    def _image(self, topic: str, t_ns: int, image: CompressedImage) -> None:
        self._add(topic, _encoder.encode(image), t_ns, t_ns)

    def _register(self, topic: str, schema_name: str, schema: bytes) -> None:
        schema_id = self._mcap.register_schema(schema_name, "jsonschema", schema)
        self._channels[topic] = self._mcap.register_channel(topic, "json", schema_id)

    def _add(self, topic: str, data: bytes, log_ns: int, publish_ns: int) -> None:
        self._sequence += 1
        # MCAP times are unsigned, so negative times are clamped.
        self._mcap.add_message(self._channels[topic], max(0, log_ns), data, max(0, publish_ns), self._sequence)


def decode_image(data: bytes) -> tuple[int, str, bytes]:
    """Payload of a foxglove.CompressedImage -> (frame id, format, content of the image file)

    Raises msgspec.DecodeError, KeyError, TypeError, ValueError."""
    raw = msgspec.json.decode(data)
    return int(raw["frame_id"]), raw["format"], base64.b64decode(raw["data"])
