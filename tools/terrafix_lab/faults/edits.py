"""Edits of a flight between its source and the nodes: frames, times, telemetry, start and camera.

The flight on disk is not copied or changed. An edit is a function over the shots of a source; the edits of pictures are
in pictures.py. The image of a shot may be a ``Sight``: in Monte Carlo a picture is the pose of the camera that took it.
"""

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import islice, tee

import msgspec
import numpy as np

from terrafix.core.geodesy import LocalFrame, quat_from_rot, rot_from_quat
from terrafix.core.node import Image
from terrafix.core.pose import exp_so3
from terrafix.messages import GimbalAttitude, Imu, Message, Origin, VehicleState
from terrafix.vision.sources import Shot
from terrafix.vision.sources.contract import TimedMessage

FEET_IN_A_METRE = 3.28084
FOCAL_SIGMA = 0.01  # stated relative 1-sigma of a wrong focal length
GIMBAL_PAST = 3000  # reports that are kept: a minute at 50 Hz
DOUBLED_SUFFIX = "again"  # appended to the file name of a doubled picture

Edit = Callable[[Iterator[Shot]], Iterator[Shot]]
StateEdit = Callable[[VehicleState], VehicleState]
OriginEdit = Callable[[Origin], Origin]


class Span(msgspec.Struct, frozen=True):
    """A time span of the flight with a fault, in seconds of its time stamps."""

    from_s: float
    to_s: float
    text: str

    def has(self, t_s: float) -> bool:
        return self.from_s <= t_s <= self.to_s


EVER = Span(-math.inf, math.inf, "")


def unchanged(shots: Iterator[Shot]) -> Iterator[Shot]:
    """The identity edit."""
    return shots


def unchanged_origin(origin: Origin) -> Origin:
    return origin


def during(span: Span, edit: Edit) -> Edit:
    """``edit``, which must give one shot for each shot, is computed over the whole flight and used in ``span`` only."""

    def edited(shots: Iterator[Shot]) -> Iterator[Shot]:
        true, seen = tee(shots)
        for shot, changed in zip(true, edit(seen), strict=True):
            yield changed if span.has(shot.frame.t_ns / 1e9) else shot

    return edited


# --- frames and their times ---


def without_frames(files: frozenset[str]) -> Edit:
    """Removes these frames; their telemetry comes with the next frame."""
    return _without(lambda shot: shot.frame.file in files)


def unplugged(span: Span) -> Edit:
    """No frame in ``span``; their telemetry comes with the next frame."""
    return _without(lambda shot: span.has(shot.frame.t_ns / 1e9))


def _without(is_gone: Callable[[Shot], bool]) -> Edit:
    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        states: tuple[VehicleState, ...] = ()
        for shot in shots:
            states += shot.states
            if not is_gone(shot):
                yield replace(shot, states=states)
                states = ()

    return edit


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


def repeated(span: Span, times: int) -> Edit:
    """Each frame of ``span`` comes so often, with one time."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        for shot in shots:
            yield from [shot] * (times if span.has(shot.frame.t_ns / 1e9) else 1)

    return edit


def stamped(span: Span, by_s: float) -> Edit:
    """The time stamps of the frames in ``span`` are ``by_s`` off."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        for shot in shots:
            by_ns = round(1e9 * by_s) if span.has(shot.frame.t_ns / 1e9) else 0
            yield replace(shot, frame=msgspec.structs.replace(shot.frame, t_ns=shot.frame.t_ns + by_ns))

    return edit


def dropped_and_doubled(dropped: float, doubled: float, seed: int) -> Edit:
    """A share of the frames is missing, and a share is doubled, with the copy half way to the next frame.

    The telemetry of missing frames comes with the next frame."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        rng = np.random.default_rng([seed, 72])
        waiting: Shot | None = None  # the repetition, until the time of the next frame is known
        lost = Shot(frame=None, states=(), image=None)  # type: ignore[arg-type]
        for number, shot in enumerate(shots):
            draw = rng.uniform()
            if waiting is not None:
                half_ns = (waiting.frame.t_ns + shot.frame.t_ns) // 2
                name = f"{waiting.frame.file} {DOUBLED_SUFFIX}"
                frame = msgspec.structs.replace(waiting.frame, t_ns=half_ns, file=name)
                yield Shot(frame, (), waiting.image)
                waiting = None
            if number and draw < dropped:
                lost = replace(lost, states=lost.states + shot.states, imu=lost.imu + shot.imu)
                continue
            yield replace(shot, states=lost.states + shot.states, imu=lost.imu + shot.imu)
            lost = replace(lost, states=(), imu=())
            waiting = shot if draw > 1.0 - doubled else None

    return edit


def photos(files: frozenset[str]) -> Edit:
    """Only these frames, each with one state of the newest values of all quantities by then: an autopilot reports
    attitude and height in separate messages."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        newest: VehicleState | None = None
        for shot in shots:
            for state in shot.states:
                known = {n: value for n in state.__struct_fields__ if (value := getattr(state, n)) is not None}
                newest = state if newest is None else msgspec.structs.replace(newest, **known)
            if shot.frame.file in files:
                yield Shot(shot.frame, () if newest is None else (newest,), shot.image)

    return edit


def pause(first: int, end: int, more_s: float) -> Edit:
    """Frames ``first`` to ``end`` (excluded) and their telemetry are missing, and all later shots are delayed by
    ``more_s``: the vehicle flew its true trajectory and hovered on it."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        yield from islice(shots, first)
        for _ in islice(shots, end - first):
            pass
        for shot in shots:
            yield _delayed(shot, round(more_s * 1e9))

    return edit


def _delayed(shot: Shot, by_ns: int) -> Shot:
    frame = msgspec.structs.replace(shot.frame, t_ns=shot.frame.t_ns + by_ns)
    states = tuple(msgspec.structs.replace(s, t_ns=s.t_ns + by_ns) for s in shot.states)
    imu = tuple(msgspec.structs.replace(i, t_ns=i.t_ns + by_ns) for i in shot.imu)
    return Shot(frame, states, shot.image, imu)


# --- telemetry ---


def telemetry(change: StateEdit) -> Edit:
    """Applies ``change`` to all telemetry."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        for shot in shots:
            yield replace(shot, states=tuple(change(s) for s in shot.states))

    return edit


def forged(span: Span, change: StateEdit) -> Edit:
    """Applies ``change`` to telemetry in ``span``; inertial readings stay true."""
    return telemetry(lambda state: change(state) if span.has(state.t_ns / 1e9) else state)


def late_telemetry(lag_s: float) -> Edit:
    """Delays telemetry by ``lag_s``, with time stamps of its arrival; pictures are unchanged."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        lag_ns = round(lag_s * 1e9)
        states: deque[VehicleState] = deque()
        imu: deque[Imu] = deque()
        for shot in shots:
            states += [msgspec.structs.replace(s, t_ns=s.t_ns + lag_ns) for s in shot.states]
            imu += [msgspec.structs.replace(i, t_ns=i.t_ns + lag_ns) for i in shot.imu]
            due_ns = shot.frame.t_ns
            yield replace(shot, states=_due(states, due_ns), imu=_due(imu, due_ns))

    return edit


def never(_since_s: float) -> float:
    return 0.0


def gimbal_reports(
    span: Span, *, age_s: Callable[[float], float] = never, up_deg: Callable[[float], float] = never
) -> Edit:
    """In ``span`` a gimbal reports what was ``age_s`` ago (inf: nothing), with a view ``up_deg`` above the true one.
    Both by the seconds since the beginning."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        past: deque[GimbalAttitude] = deque(maxlen=GIMBAL_PAST)

        def reported(message: Message) -> Message | None:
            if not isinstance(message, GimbalAttitude):
                return message
            past.append(message)
            t_s = message.t_ns / 1e9
            if not span.has(t_s):
                return message
            since_s = t_s - max(span.from_s, past[0].t_ns / 1e9)
            then_s = t_s - age_s(since_s)
            seen = next((old for old in reversed(past) if old.t_ns / 1e9 <= then_s), None)
            if seen is None:
                return None
            up = exp_so3(np.array([0.0, math.radians(up_deg(since_s)), 0.0]))
            return msgspec.structs.replace(seen, t_ns=message.t_ns, q=quat_from_rot(rot_from_quat(seen.q) @ up))

        for shot in shots:
            others = (reported(message) for message in shot.others)
            yield replace(shot, others=tuple(message for message in others if message is not None))

    return edit


def _due(waiting: deque[TimedMessage], t_ns: int) -> tuple[TimedMessage, ...]:
    """Removes and returns the messages up to ``t_ns`` from ``waiting``."""
    due = []
    while waiting and waiting[0].t_ns <= t_ns:
        due.append(waiting.popleft())
    return tuple(due)


def height_times(factor: float) -> StateEdit:
    def change(state: VehicleState) -> VehicleState:
        return state if state.agl_m is None else msgspec.structs.replace(state, agl_m=state.agl_m * factor)

    return change


def turned(degrees: float) -> StateEdit:
    """Adds this error to the heading, clockwise."""

    def change(state: VehicleState) -> VehicleState:
        if state.yaw_rad is None:
            return state
        yaw_rad = math.remainder(state.yaw_rad + math.radians(degrees), 2 * math.pi)
        return msgspec.structs.replace(state, yaw_rad=yaw_rad)

    return change


def rolled(degrees: float) -> StateEdit:
    def change(state: VehicleState) -> VehicleState:
        if state.roll_rad is None:
            return state
        return msgspec.structs.replace(state, roll_rad=state.roll_rad + math.radians(degrees))

    return change


def roll_pitch_swapped(state: VehicleState) -> VehicleState:
    return msgspec.structs.replace(state, roll_rad=state.pitch_rad, pitch_rad=state.roll_rad)


def roll_pitch_negated(state: VehicleState) -> VehicleState:
    roll, pitch = state.roll_rad, state.pitch_rad
    return msgspec.structs.replace(
        state, roll_rad=None if roll is None else -roll, pitch_rad=None if pitch is None else -pitch
    )


def yaw_unknown(state: VehicleState) -> VehicleState:
    return msgspec.structs.replace(state, yaw_rad=None)


def height_unknown(state: VehicleState) -> VehicleState:
    return msgspec.structs.replace(state, agl_m=None)


# --- start and camera ---


def start_unknown(origin: Origin) -> Origin:
    """As of a source without a [start]."""
    return msgspec.structs.replace(origin, start_sigma_m=math.inf)


def start_sigma(sigma_m: float) -> OriginEdit:
    return lambda origin: msgspec.structs.replace(origin, start_sigma_m=sigma_m)


def start_moved(east_m: float, north_m: float, sigma_m: float | None = None) -> OriginEdit:
    """Adds this error to the start coordinate and states ``sigma_m`` for it (None: leaves the stated sigma)."""

    def move(origin: Origin) -> Origin:
        lat_deg, lon_deg = LocalFrame(origin.lat_deg, origin.lon_deg).to_wgs84(east_m, north_m)
        claimed_m = origin.start_sigma_m if sigma_m is None else sigma_m
        return msgspec.structs.replace(origin, lat_deg=lat_deg, lon_deg=lon_deg, start_sigma_m=claimed_m)

    return move


def focal_times(factor: float) -> OriginEdit:
    """The calibration has a focal length wrong by ``factor``, with a stated 1-sigma of 1 %."""

    def change(origin: Origin) -> Origin:
        camera = origin.camera
        wrong = msgspec.structs.replace(camera, fx=camera.fx * factor, fy=camera.fy * factor, focal_sigma=FOCAL_SIGMA)
        return msgspec.structs.replace(origin, camera=wrong)

    return change


def mount_yaw_plus(degrees: float) -> OriginEdit:
    """Adds an error to the mount yaw of the calibration."""

    def change(origin: Origin) -> Origin:
        wrong = msgspec.structs.replace(origin.camera, mount_yaw_deg=origin.camera.mount_yaw_deg + degrees)
        return msgspec.structs.replace(origin, camera=wrong)

    return change
