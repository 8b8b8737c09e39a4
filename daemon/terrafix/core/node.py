"""The node contract: a function of messages (law 1).

``on`` and ``tick`` take messages and time and return messages. No clock, socket, file or thread inside; live,
replay and simulation run the same objects. What a node needs from outside (pixels, a map) it is given."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from terrafix.core.config import Config
from terrafix.messages import Message

Image = np.ndarray  # (H, W, 3) uint8 BGR


class FrameStore(Protocol):
    """Pixels by frame id. A frame that was overwritten or never arrived is ``None``."""

    def get(self, frame_id: int) -> Image | None: ...


@dataclass(frozen=True)
class NodeContext:
    """What a node may use; every path is absolute."""

    config: Config
    frames: FrameStore
    map_path: Path | None  # map package (GeoPackage)
    out_dir: Path  # where the recorder writes
    ground_amsl_m: float | None = None  # of the map at the start, for sources that do not know it
    checkpoint: Path | None = (
        None  # file in memory for what this process leaves to the one that is started in its place
    )
    shelf: Path | None = None  # folder in memory for what would have to be computed anew; it need not exist
    epoch_ns: int | None = None  # t_ns of this run's first Origin: set when the source's process starts again


class Node(Protocol):
    def on(self, message: Message) -> Iterable[Message]:
        """Take one message, return what follows from it."""
        ...

    def tick(self, now_ns: int) -> Iterable[Message]:
        """Called at the rate of the process table; ``now_ns`` is the shell's monotonic time."""
        ...


class Edge(Protocol):
    """The part of a process that touches the world (camera, serial port, MCAP file).

    The live shell polls it: what it read becomes messages for the bus *and* for the node of the same process;
    what the node says is offered to it."""

    def poll(self, now_ns: int) -> Iterable[Message]: ...

    def heard(self, message: Message) -> None:
        """Every message that the process hears or says itself."""
        ...

    def close(self) -> None: ...
