"""Edits that a scenario applies to a flight between its source and the nodes: pictures, telemetry, start.

The flight on disk is not copied or changed. An edit is a function over the shots of a source; ``AlteredSource`` applies
it and renumbers the frames."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import islice
from pathlib import Path

import msgspec

from terrafix.core.geodesy import LocalFrame
from terrafix.core.node import Image
from terrafix.messages import Origin, VehicleState
from terrafix.vision.sources import Shot, Source
from terrafix_lab.accept.flight import FrameRef

Edit = Callable[[Iterator[Shot]], Iterator[Shot]]
StateEdit = Callable[[VehicleState], VehicleState]
LAP_MARK = "@"  # "0001.jpg@2": the same picture flown over again


def unchanged(shots: Iterator[Shot]) -> Iterator[Shot]:
    """The identity edit."""
    return shots


def unchanged_origin(origin: Origin) -> Origin:
    return origin


class AlteredSource:
    """A Source that wraps and edits another one."""

    live = False

    def __init__(
        self, source: Source, edit: Edit = unchanged, *, frames: int | None = None, origin: Callable[[Origin], Origin]
    ) -> None:
        """``frames``: limit of the frames of ``source``. ``origin``: edits start and camera."""
        self._source, self._edit, self._frames, self._origin = source, edit, frames, origin

    def origin(self) -> Origin:
        return self._origin(self._source.origin())

    def length(self) -> int | None:
        """Approximate: an edit may add or remove frames."""
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
    """The flight forwards and backwards in turn: a long route from a short one. Implements Source."""

    live = False

    def __init__(self, source: Source, frame_refs: list[FrameRef], frames: int) -> None:
        """``stops``: every frame of ``source``. ``frames``: of the long flight."""
        self._source, self._frame_refs, self._frames = source, frame_refs, frames

    def origin(self) -> Origin:
        return self._source.origin()

    def length(self) -> int | None:
        return self._frames

    def shots(self, from_s: float = 0.0) -> Iterator[Shot]:
        first_s, last_s = self._frame_refs[0].t_s, self._frame_refs[-1].t_s
        for number in range(self._frames):
            lap, index = divmod(number, len(self._frame_refs) - 1)
            ref = self._frame_refs[-1 - index if lap % 2 else index]
            t_s = lap * (last_s - first_s) + (last_s - ref.t_s if lap % 2 else ref.t_s - first_s)
            if t_s < from_s:
                continue
            shot = next(self._source.shots(from_s=ref.t_s))
            file = shot.frame.file + (f"{LAP_MARK}{lap + 1}" if lap else "")
            frame = msgspec.structs.replace(shot.frame, frame_id=number, file=file, t_ns=round(t_s * 1e9))
            states = () if ref.state is None else (_moved(ref.state, frame.t_ns, bool(lap % 2)),)
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
    """Inserts a foreign picture before each of these files."""

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


def without_frames(files: frozenset[str]) -> Edit:
    """Removes these frames; their telemetry comes with the next frame."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        pending: tuple[VehicleState, ...] = ()
        for shot in shots:
            pending += shot.states
            if shot.frame.file not in files:
                yield replace(shot, states=pending)
                pending = ()

    return edit


def telemetry(change: StateEdit) -> Edit:
    """Applies ``change`` to all telemetry."""

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
    """Adds this error to the heading, clockwise."""

    def change(state: VehicleState) -> VehicleState:
        if state.yaw_rad is None:
            return state
        yaw_rad = math.remainder(state.yaw_rad + math.radians(degrees), 2 * math.pi)
        return msgspec.structs.replace(state, yaw_rad=yaw_rad)

    return change


def yaw_unknown() -> Edit:
    return telemetry(lambda state: msgspec.structs.replace(state, yaw_rad=None))


def start_moved(east_m: float, north_m: float, sigma_m: float | None = None) -> Callable[[Origin], Origin]:
    """Adds this error to the start coordinate and states ``sigma_m`` for it (None: leaves the stated sigma)."""

    def move(origin: Origin) -> Origin:
        lat_deg, lon_deg = LocalFrame(origin.lat_deg, origin.lon_deg).to_wgs84(east_m, north_m)
        claimed_m = origin.start_sigma_m if sigma_m is None else sigma_m
        return msgspec.structs.replace(origin, lat_deg=lat_deg, lon_deg=lon_deg, start_sigma_m=claimed_m)

    return move


def original(files: Iterable[str]) -> list[str]:
    """File names without the lap mark, as in the truth of the flight."""
    return [file.split(LAP_MARK)[0] for file in files]
