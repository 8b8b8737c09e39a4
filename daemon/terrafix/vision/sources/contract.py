"""The source contract: the common interface of flight folders, photo folders, videos and cameras."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np

from terrafix.core.errors import SourceError
from terrafix.messages import Frame, GimbalAttitude, Imu, Message, Origin, VehicleState

TimedMessage = TypeVar("TimedMessage", VehicleState, Imu, GimbalAttitude)


class Timing(NamedTuple):
    """What is known of the time from exposure to time stamp. ``sigma_s`` 0: as usual for the kind of camera."""

    latency_s: float = 0.0
    sigma_s: float = 0.0
    sender_clock: bool = False  # that of a camera on the network is synchronised with this computer's


UNKNOWN_TIMING = Timing()


@dataclass(frozen=True)
class Shot:
    """One frame of a source, with the telemetry since the previous one."""

    frame: Frame  # when the pixels are not usable, frame.error is set and image is None
    states: tuple[VehicleState, ...]  # measured since the previous shot, up to this frame, in time order
    image: np.ndarray | None  # (H, W, 3) uint8 BGR
    imu: tuple[Imu, ...] = ()  # IMU samples of the same interval
    others: tuple[Message, ...] = ()  # what else was received in that interval: GimbalAttitude, and of a record more


class TelemetryCursor(Generic[TimedMessage]):
    """Cursor over a time-ordered sequence: a call returns the messages since the last call, up to ``t_ns``.

    Messages before ``from_ns`` are dropped."""

    def __init__(self, messages: Sequence[TimedMessage], from_ns: int) -> None:
        self._messages: Sequence[TimedMessage] = messages
        self._from_ns, self._at = from_ns, 0

    def __call__(self, t_ns: int) -> tuple[TimedMessage, ...]:
        first = self._at
        while self._at < len(self._messages) and self._messages[self._at].t_ns <= t_ns:
            self._at += 1
        return tuple(m for m in self._messages[first : self._at] if m.t_ns >= self._from_ns)


class Source(Protocol):
    """Recordings (``live`` False) have ``t_ns`` relative to the start of the flight; cameras (``live`` True) on the
    monotonic clock. ``frame_id`` counts from 0 in source order."""

    live: bool

    def origin(self) -> Origin: ...

    def length(self) -> int | None:
        """Expected number of shots; None: unknown."""
        ...

    def shots(self, from_s: float = 0.0) -> Iterator[Shot]:
        """Shots from ``from_s`` on. Earlier ones are skipped without reading their pixels; frame ids do not change."""
        ...

    def select(self, takes: Callable[[int], bool]) -> bool:
        """Leaves frames out unread for which ``takes`` (t_ns), asked once for each, is false. -> False: it cannot."""
        ...

    def map_hint(self) -> Path | None:
        """Resolved path of the map that the flight names; the file may not exist."""
        ...

    def name(self) -> str: ...

    def close(self) -> None: ...


class SourceBase:
    """What most sources are: recordings of an ``_origin``, of unknown length, which name no map."""

    live = False
    _origin: Origin

    def origin(self) -> Origin:
        return self._origin

    def length(self) -> int | None:
        return None

    def select(self, takes: Callable[[int], bool]) -> bool:
        return False

    def map_hint(self) -> Path | None:
        return None

    def close(self) -> None:
        """No resource stays open between shots."""


class WrappedSource:
    """All of another source but its shots."""

    def __init__(self, source: Source) -> None:
        self.live, self._source = source.live, source

    def origin(self) -> Origin:
        return self._source.origin()

    def length(self) -> int | None:
        return self._source.length()

    def select(self, takes: Callable[[int], bool]) -> bool:
        return self._source.select(takes)

    def map_hint(self) -> Path | None:
        return self._source.map_hint()

    def name(self) -> str:
        return self._source.name()

    def close(self) -> None:
        self._source.close()


@runtime_checkable
class WithTruth(Protocol):
    """A source whose file also has positions, which nothing reads but ``terrafix source truth``."""

    def truth(self) -> list[tuple[str, float, float]]:
        """(file, latitude, longitude [degrees, WGS 84]) of frames. Raises SourceError: it has no positions."""
        ...


def truth_of(source: Source) -> list[tuple[str, float, float]]:
    """``WithTruth.truth``. Raises SourceError for a source without any."""
    if not isinstance(source, WithTruth):
        raise SourceError(f"{source.name()}: has no positions that could be the truth")
    return source.truth()
