"""The source contract: what every flight, photo folder, video and camera looks like to the rest."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from terrafix.messages import Frame, Origin, VehicleState


@dataclass(frozen=True)
class Shot:
    """One frame of a source, with what the vehicle reported on the way to it."""

    frame: Frame  # frame.error is set and image is None when the pixels cannot be trusted
    states: tuple[VehicleState, ...]  # measured since the previous shot, up to this frame, in time order
    image: np.ndarray | None  # (H, W, 3) uint8 BGR


class Source(Protocol):
    """``t_ns`` of everything is relative to the flight's zero (``live`` False: a recording), or on the
    monotonic clock (``live`` True: a camera). ``frame_id`` counts from 0 in source order."""

    live: bool

    def origin(self) -> Origin: ...

    def length(self) -> int | None:
        """Expected number of shots; None: not known."""
        ...

    def shots(self, from_s: float = 0.0) -> Iterator[Shot]:
        """Shots from ``from_s`` on; what lies before is skipped without reading its pixels, ids stay the same."""
        ...

    def map_hint(self) -> Path | None:
        """Map that the flight names, resolved; it may not exist."""
        ...

    def name(self) -> str: ...

    def close(self) -> None: ...
