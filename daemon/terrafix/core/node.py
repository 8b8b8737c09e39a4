"""The node contract: a node is a function of messages (law 1).

``on`` and ``tick`` take messages and time and return messages. A node has no clock, socket, file or thread of its own;
live operation, replay and simulation run the same objects. Pixels, the map and settings come with ``NodeContext``."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from terrafix.core.config import Config
from terrafix.messages import Message

Image = np.ndarray  # (H, W, 3) uint8 BGR


class FrameStore(Protocol):
    """Pixels by frame id. ``None``: the frame was overwritten or never arrived."""

    def get(self, frame_id: int) -> Image | None: ...


@dataclass(frozen=True)
class NodeContext:
    """Resources of a node; every path is absolute."""

    config: Config
    frames: FrameStore
    map_path: Path | None  # map package (GeoPackage)
    out_dir: Path  # output folder of the recorder
    ground_amsl_m: float | None = None  # ground height of the map at the initial position, for sources without one
    checkpoint: Path | None = None  # checkpoint file in shared memory, read by the next instance of this process
    state_dir: Path | None = None  # folder on disk for what the next start must know (core/state_folder.py)
    cache_dir: Path | None = None  # folder in shared memory for recomputable results; it need not exist
    epoch_ns: int | None = None  # t_ns of the first Origin of this run; set when the source process is restarted


class Node(Protocol):
    def on(self, message: Message) -> Iterable[Message]:
        """Processes one message; returns the resulting messages."""

    def tick(self, now_ns: int) -> Iterable[Message]:
        """Called at the tick rate of the process table; ``now_ns`` is the monotonic time of the shell."""


class NodeBase:
    """A node without a reaction; those that only messages drive have no tick of their own."""

    def on(self, message: Message) -> Iterable[Message]:
        return ()

    def tick(self, now_ns: int) -> Iterable[Message]:
        return ()


class Edge(Protocol):
    """The input and output of a process (camera, serial port, MCAP file).

    The live shell polls it. The messages that it returns are published on the bus and passed to the node of the same
    process; the messages of the node are passed to ``on_message``."""

    def poll(self, now_ns: int) -> Iterable[Message]: ...

    def on_message(self, message: Message) -> None:
        """Called with every message that the process receives and every message that its node publishes."""

    def close(self) -> None: ...
