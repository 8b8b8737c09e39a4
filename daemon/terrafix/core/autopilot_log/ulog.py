"""Topics of a PX4 ULog (.ulg): arrays by field, of each instance. Read by pyulog."""

import contextlib
import io
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from terrafix.core.autopilot_log.attitude import AttitudeSeries, cleaned
from terrafix.core.errors import SourceError

ULOG_MAGIC = b"ULog"
# What pyulog raises on a damaged file beside its own exception.
_DAMAGE = (struct.error, ValueError, KeyError, IndexError, TypeError, AttributeError)

# Bytes that pyulog may read of a file: it reads a damaged part again from each of its bytes.
READS_BYTES, READS_PER_BYTE = 8 * 1024 * 1024, 20

Topic = dict[str, np.ndarray]  # fields of one instance of a topic


@dataclass(frozen=True)
class Topics:
    """``topics``: of each name its instances by number. ``texts``: (time [s], text). ``version``: of the firmware."""

    topics: dict[str, dict[int, Topic]]
    texts: list[tuple[float, str]]
    version: str


class _Stream(io.BytesIO):
    """A file that ends the search of pyulog for the next message in damaged definitions, which can be endless."""

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self._left = READS_BYTES + READS_PER_BYTE * len(data)

    def read(self, size: int | None = -1) -> bytes:
        data = super().read(size)
        self._left -= len(data)
        if self._left < 0:
            raise ValueError("no end of the damaged part")
        return data


def read_topics(path: Path, data: bytes, wanted: Sequence[str]) -> Topics:
    """``data``: the content of ``path``. Raises SourceError: it is damaged from the start."""
    from pyulog import ULog  # of the extra "ground"
    from pyulog.exceptions import ULogException

    try:
        with contextlib.redirect_stdout(io.StringIO()):  # pyulog prints what it finds damaged
            ulog = ULog(_Stream(data), list(wanted))
    except (ULogException, *_DAMAGE) as error:
        raise SourceError(f"{path}: is no readable ULog ({error}); give another log") from None
    topics: dict[str, dict[int, Topic]] = {}
    for one in (found for found in ulog.data_list if "timestamp" in found.data):
        topics.setdefault(one.name, {})[one.multi_id] = one.data
    texts = [(text.timestamp * 1e-6, text.message) for text in ulog.logged_messages]
    return Topics(topics, texts, ulog.get_version_info_str() or "")


def sampled_s(topic: Topic) -> np.ndarray:
    """Time of the measurement, where the version logs it beside the time of publication."""
    sampled = topic.get("timestamp_sample")
    chosen = sampled if sampled is not None and np.all(sampled > 0) else topic["timestamp"]
    return chosen.astype(np.float64) * 1e-6


def numbers(topic: Topic, field: str) -> np.ndarray:
    found = topic.get(field)
    return np.full(len(topic["timestamp"]), np.nan) if found is None else found.astype(np.float64)


def columns(topic: Topic, *fields: str) -> np.ndarray:
    return np.stack([numbers(topic, field) for field in fields], axis=1)


def attitude_of(topic: Topic) -> AttitudeSeries:
    """From the quaternion (w, x, y, z) that rotates the body (FRD) into north, east, down."""
    w, x, y, z = columns(topic, "q[0]", "q[1]", "q[2]", "q[3]").T
    roll_rad = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch_rad = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw_rad = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return cleaned(AttitudeSeries(sampled_s(topic), roll_rad, pitch_rad, yaw_rad))
