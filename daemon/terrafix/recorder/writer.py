"""One MCAP file of the flight record: complete header, then messages with regular flushes that limit the loss at a
kill."""

import base64
import os
import platform
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import cv2
import msgspec
import numpy as np
from mcap.writer import CompressionType, Writer

from terrafix.core.config import Config
from terrafix.core.errors import OutputError
from terrafix.messages import Message
from terrafix.recorder.schema import (
    MESSAGE_TYPES,
    THUMBNAIL_SCHEMA,
    THUMBNAIL_SCHEMA_NAME,
    THUMBNAIL_TOPIC,
    Stamp,
    Thumbnail,
    schema_of,
    topic_of,
)

CHUNK_BYTES = 128 * 1024  # largest loss at a kill between two calls of flush(); also the unit of compression
JPEG_QUALITY = 70  # sufficient for visual inspection of a thumbnail
GIT_TIMEOUT_S = 2.0
RECORD_FORMAT = "terrafix-flight/2"
HEADER_NAME = "terrafix"
_END_CHUNK = "_Writer__finalize_chunk"  # mcap ends chunks by size only; flush() calls this private method (tested)
_VERSIONED = ("terrafix", "numpy", "gtsam", "opencv-python-headless", "onnxruntime", "pymavlink", "mcap", "msgspec")

_encoder = msgspec.json.Encoder()


def versions() -> dict[str, str]:
    """Versions of this program and of its libraries; empty text where one is not installed."""
    found = {"python": sys.version.split()[0], "platform": platform.platform(), "git": git_describe()}
    for name in _VERSIONED:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = ""
    return found


def git_describe() -> str:
    """Commit of the running source tree; empty text for an installed package."""
    root = Path(__file__).resolve().parents[3]
    if not (root / ".git").exists():
        return ""
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--tags"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=GIT_TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip()


def header(config: Config) -> dict[str, str]:
    """Header of every file of the record: format, configuration, versions."""
    return {
        "format": RECORD_FORMAT,
        "config": _encoder.encode(config).decode(),
        "versions": _encoder.encode(versions()).decode(),
    }


def thumbnail_jpeg(image: np.ndarray, width_px: int) -> bytes:
    """(H, W, 3) uint8 BGR -> JPEG of ``width_px``, or of the original width if that is smaller."""
    factor = min(1.0, width_px / image.shape[1])
    size = (max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    _, coded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return bytes(coded)


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
        self._register(THUMBNAIL_TOPIC, THUMBNAIL_SCHEMA_NAME, _encoder.encode(THUMBNAIL_SCHEMA))
        self.flush()

    def write(self, message: Message, received_ns: int) -> None:
        """In MCAP, log_time is the time of the measurement and publish_time the time of reception at the recorder."""
        self._add(topic_of(type(message)), _encoder.encode(message), message.t_ns, received_ns)

    def write_thumbnail(self, t_ns: int, frame_id: int, jpeg: bytes) -> None:
        stamp = Stamp(sec=t_ns // 1_000_000_000, nsec=t_ns % 1_000_000_000)
        data = _encoder.encode(Thumbnail(timestamp=stamp, frame_id=str(frame_id), data=jpeg))
        self._add(THUMBNAIL_TOPIC, data, t_ns, t_ns)

    def size_bytes(self) -> int:
        return self._file.tell()

    def flush(self) -> None:
        """Passes all data to the operating system, so that kill -9 of this process does not lose it."""
        getattr(self._mcap, _END_CHUNK)()
        self._file.flush()

    def sync(self) -> None:
        """Passes what was flushed to the disk, so that a power cut does not lose it. A slow disk takes seconds."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        try:
            self._mcap.finish()  # type: ignore[no-untyped-call]
        finally:
            self._file.close()

    def _register(self, topic: str, schema_name: str, schema: bytes) -> None:
        schema_id = self._mcap.register_schema(schema_name, "jsonschema", schema)
        self._channels[topic] = self._mcap.register_channel(topic, "json", schema_id)

    def _add(self, topic: str, data: bytes, log_ns: int, publish_ns: int) -> None:
        self._sequence += 1
        # MCAP times are unsigned, so negative times are clamped.
        self._mcap.add_message(self._channels[topic], max(0, log_ns), data, max(0, publish_ns), self._sequence)


def decode_thumbnail(data: bytes) -> tuple[int, bytes]:
    """Payload of the thumbnail topic -> (frame id, JPEG)"""
    raw = msgspec.json.decode(data)
    return int(raw["frame_id"]), base64.b64decode(raw["data"])
