"""What a scenario does to a flight on its way to the nodes: its pictures, its telemetry, its start.

The flight on the disk is never copied or changed. An edit is a function over the shots of a source; ``AlteredSource``
applies it and gives the frames new numbers."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import islice
from pathlib import Path

import msgspec
import numpy as np

from terrafix.core.geodesy import LocalFrame
from terrafix.core.node import Image
from terrafix.messages import Origin, VehicleState
from terrafix.vision.sources import Shot, Source
from terrafix_tools.accept.flight import Stop
from terrafix_tools.accept.judged import Span

Edit = Callable[[Iterator[Shot]], Iterator[Shot]]
StateEdit = Callable[[VehicleState], VehicleState]
LAP_MARK = "@"  # "0001.jpg@2": the same picture flown over again


def same(shots: Iterator[Shot]) -> Iterator[Shot]:
    """Nothing is wrong."""
    return shots


def same_origin(origin: Origin) -> Origin:
    return origin


class AlteredSource:
    """The Source contract around another source."""

    live = False

    def __init__(
        self, source: Source, edit: Edit = same, *, frames: int | None = None, origin: Callable[[Origin], Origin]
    ) -> None:
        """``frames``: only so many of ``source``. ``origin`` changes what is said of start and camera."""
        self._source, self._edit, self._frames, self._origin = source, edit, frames, origin

    def origin(self) -> Origin:
        return self._origin(self._source.origin())

    def length(self) -> int | None:
        """An edit may add or remove a few."""
        length = self._source.length()
        return length if self._frames is None or length is None else min(length, self._frames)

    def shots(self, from_s: float = 0.0) -> Iterator[Shot]:
        for number, shot in enumerate(self._edit(islice(self._source.shots(), self._frames))):
            if shot.frame.t_ns >= round(from_s * 1e9):
                yield replace(shot, frame=msgspec.structs.replace(shot.frame, frame_id=number))

    def map_hint(self) -> Path | None:
        return self._source.map_hint()

    def name(self) -> str:
        return self._source.name()

    def close(self) -> None:
        self._source.close()


class ThereAndBack:
    """The same flight forwards, backwards, forwards ...: a long route from a short one. The Source contract."""

    live = False

    def __init__(self, source: Source, stops: list[Stop], frames: int) -> None:
        """``stops``: every frame of ``source``. ``frames``: of the long flight."""
        self._source, self._stops, self._frames = source, stops, frames

    def origin(self) -> Origin:
        return self._source.origin()

    def length(self) -> int | None:
        return self._frames

    def shots(self, from_s: float = 0.0) -> Iterator[Shot]:
        first_s, last_s = self._stops[0].t_s, self._stops[-1].t_s
        for number in range(self._frames):
            lap, index = divmod(number, len(self._stops) - 1)
            stop = self._stops[-1 - index if lap % 2 else index]
            t_s = lap * (last_s - first_s) + (last_s - stop.t_s if lap % 2 else stop.t_s - first_s)
            if t_s < from_s:
                continue
            shot = next(self._source.shots(from_s=stop.t_s))
            file = shot.frame.file + (f"{LAP_MARK}{lap + 1}" if lap else "")
            frame = msgspec.structs.replace(shot.frame, frame_id=number, file=file, t_ns=round(t_s * 1e9))
            states = () if stop.state is None else (_moved(stop.state, frame.t_ns, bool(lap % 2)),)
            yield Shot(frame, states, shot.image)

    def map_hint(self) -> Path | None:
        return self._source.map_hint()

    def name(self) -> str:
        return self._source.name()

    def close(self) -> None:
        self._source.close()


def _moved(state: VehicleState, t_ns: int, backwards: bool) -> VehicleState:
    velocity = state.velocity_enu_mps
    if velocity is not None and backwards:
        velocity = (-velocity[0], -velocity[1], -velocity[2])
    return msgspec.structs.replace(state, t_ns=t_ns, velocity_enu_mps=velocity)


def foreign_frames(pictures: Mapping[str, Image]) -> Edit:
    """Before each of these files comes a picture that does not belong there."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        last_ns = 0
        for shot in shots:
            if shot.frame.file in pictures:
                t_ns = (last_ns + shot.frame.t_ns) // 2
                frame = msgspec.structs.replace(shot.frame, t_ns=t_ns, file=foreign_name(shot.frame.file))
                yield Shot(frame, (), pictures[shot.frame.file])
            last_ns = shot.frame.t_ns
            yield shot

    return edit


def foreign_name(file: str) -> str:
    """Name of the foreign picture that comes before ``file``."""
    return f"foreign before {file}"


def without(files: frozenset[str]) -> Edit:
    """The pictures are gone; what the vehicle reported meanwhile is not."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        kept: tuple[VehicleState, ...] = ()
        for shot in shots:
            kept += shot.states
            if shot.frame.file not in files:
                yield replace(shot, states=kept)
                kept = ()

    return edit


def dark(span: Span) -> Edit:
    """Black pictures: the lens is covered, or it is night."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        for shot in shots:
            seen = shot.image is not None and span.has(shot.frame.t_ns / 1e9)
            yield replace(shot, image=np.zeros_like(shot.image)) if seen else shot

    return edit


def frozen(span: Span) -> Edit:
    """The camera goes on delivering the last picture before ``span``, with new times."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        last = None
        for shot in shots:
            if last is not None and span.has(shot.frame.t_ns / 1e9):
                yield replace(shot, image=last)
            else:
                last = shot.image if shot.image is not None else last
                yield shot

    return edit


def telemetry(change: StateEdit) -> Edit:
    """What the autopilot reports is not so."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        for shot in shots:
            yield replace(shot, states=tuple(change(s) for s in shot.states))

    return edit


def height_times(factor: float) -> Edit:
    def change(state: VehicleState) -> VehicleState:
        return state if state.agl_m is None else msgspec.structs.replace(state, agl_m=state.agl_m * factor)

    return telemetry(change)


def yaw_plus(degrees: float) -> Edit:
    return telemetry(turned(degrees))


def turned(degrees: float) -> StateEdit:
    """The heading is off by this, clockwise."""

    def change(state: VehicleState) -> VehicleState:
        if state.yaw_rad is None:
            return state
        yaw_rad = math.remainder(state.yaw_rad + math.radians(degrees), 2 * math.pi)
        return msgspec.structs.replace(state, yaw_rad=yaw_rad)

    return change


def yaw_unknown() -> Edit:
    return telemetry(lambda state: msgspec.structs.replace(state, yaw_rad=None))


def start_moved(east_m: float, north_m: float, sigma_m: float | None = None) -> Callable[[Origin], Origin]:
    """The start coordinate is wrong by this, and claims ``sigma_m`` (None: what it always claims)."""

    def move(origin: Origin) -> Origin:
        lat_deg, lon_deg = LocalFrame(origin.lat_deg, origin.lon_deg).to_wgs84(east_m, north_m)
        claimed_m = origin.start_sigma_m if sigma_m is None else sigma_m
        return msgspec.structs.replace(origin, lat_deg=lat_deg, lon_deg=lon_deg, start_sigma_m=claimed_m)

    return move


def original(files: Iterable[str]) -> list[str]:
    """Names in the flight's own truth for frames of any lap."""
    return [file.split(LAP_MARK)[0] for file in files]
