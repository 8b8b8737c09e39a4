"""The source contract: what every flight, photo folder, video and camera looks like to the rest."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Protocol, TypeVar

import numpy as np

from terrafix.messages import Frame, Imu, Origin, VehicleState

Said = TypeVar("Said", VehicleState, Imu)


@dataclass(frozen=True)
class Shot:
    """One frame of a source, with what the vehicle reported on the way to it."""

    frame: Frame  # frame.error is set and image is None when the pixels cannot be trusted
    states: tuple[VehicleState, ...]  # measured since the previous shot, up to this frame, in time order
    image: np.ndarray | None  # (H, W, 3) uint8 BGR
    imu: tuple[Imu, ...] = ()  # inertial readings of the same time


class UpTo(Generic[Said]):
    """What was said since the last call, up to a time. ``said`` in time order; what is before ``from_ns`` falls out."""

    def __init__(self, said: Sequence[Said], from_ns: int) -> None:
        self._said: Sequence[Said] = said
        self._from_ns, self._at = from_ns, 0

    def __call__(self, t_ns: int) -> tuple[Said, ...]:
        first = self._at
        while self._at < len(self._said) and self._said[self._at].t_ns <= t_ns:
            self._at += 1
        return tuple(m for m in self._said[first : self._at] if m.t_ns >= self._from_ns)


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
