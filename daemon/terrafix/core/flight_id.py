"""Ids that are unique over all flights: a UUID of the flight, and of a frame that and its number."""

import uuid
from pathlib import Path

import numpy as np

from terrafix.core.codec import encode
from terrafix.messages import Origin

BOOT_ID_FILE = Path("/proc/sys/kernel/random/boot_id")  # UUID of this start of the computer [spec: proc_sys_kernel(5)]
RECORDINGS = uuid.UUID("684103f7-867f-415a-b086-96d3fd85fb1a")  # name space of the ids of recordings


def live_flight_id(zero_ns: int) -> str:
    """UUID of a live flight by the monotonic time of its zero, which a restart of its processes keeps."""
    return str(uuid.uuid5(uuid.UUID(BOOT_ID_FILE.read_text(encoding="ascii").strip()), str(zero_ns)))


def recorded_flight_id(origin: Origin, first: np.ndarray | None) -> str:
    """UUID of a recording by its Origin and the pixels of its first frame (None: it has none): the same each time."""
    content = encode(origin) + (b"" if first is None else first.tobytes())
    return str(uuid.uuid5(RECORDINGS, content.hex()))


def frame_uid(flight_id: str, frame_id: int) -> str:
    """Flight and number of a frame: "UUID/17"; empty where the flight has no id, as of records of an earlier
    version."""
    return f"{flight_id}/{frame_id}" if flight_id else ""
