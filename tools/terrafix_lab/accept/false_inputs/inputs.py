"""Edits that falsify an input of a flight: pictures of another place, stale or late ones, telemetry, camera, start.

As in faults/flight_edits.py an edit is a function over the shots of a source, or over its Origin."""

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import islice, tee

import cv2
import msgspec
import numpy as np

from terrafix.core.node import Image
from terrafix.messages import Imu, Origin, VehicleState
from terrafix.vision.sources import Shot
from terrafix.vision.sources.contract import TimedMessage
from terrafix_lab.accept.faults.flight_edits import Edit, StateEdit, telemetry
from terrafix_lab.accept.measuring.results import Span

FEET_IN_A_METRE = 3.28084
NOISE_GREY = 2.0  # 1-sigma of a picture's noise from frame to frame, grey values: a small camera by day
FOREIGN_LAG_S = 25.0  # longer than the span of a lie in the closed loop: no picture comes from the span itself
FOCAL_SIGMA = 0.01  # stated relative 1-sigma of a wrong focal length
SEED = 1  # of the choice of foreign and dropped frames, and of noise
DOUBLED_SUFFIX = "again"  # appended to the file name of a doubled picture

OriginEdit = Callable[[Origin], Origin]


def mirrored(image: Image) -> Image:
    """Left and right exchanged: real texture that does not occur on the map."""
    return np.ascontiguousarray(image[:, ::-1])


def replaced(pictures: Mapping[str, Callable[[], Image]]) -> Edit:
    """Replaces the pictures of the frames with these file names by others of the same size, loaded on demand.

    Times and telemetry are unchanged."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        for shot in shots:
            load = pictures.get(shot.frame.file)
            yield shot if load is None else replace(shot, image=load())

    return edit


def every_picture(change: Callable[[Image], Image]) -> Edit:
    """Applies ``change``, which keeps the size, to each picture."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        for shot in shots:
            yield shot if shot.image is None else replace(shot, image=change(shot.image))

    return edit


def stale_buffers(span: Span, buffers: int, *, noise_grey: float = NOISE_GREY, seed: int = SEED) -> Edit:
    """In ``span`` the camera delivers the last ``buffers`` pictures before it in turn, each with new noise.

    One buffer is a frozen camera. ``noise_grey``: 1-sigma of the noise in grey values; 0: identical pictures."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        rng = np.random.default_rng([seed, 71])
        held: deque[Image] = deque(maxlen=buffers)
        turn = 0
        for shot in shots:
            if shot.image is None or not held or not span.has(shot.frame.t_ns / 1e9):
                if shot.image is not None:
                    held.append(shot.image)
                yield shot
                continue
            yield replace(shot, image=_noisy(held[turn % len(held)], noise_grey, rng))
            turn += 1

    return edit


def late_pictures(lag_s: float) -> Edit:
    """Each frame shows the newest picture with an age of at least ``lag_s``; times and telemetry are unchanged."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        held: deque[tuple[int, Image]] = deque()
        for shot in shots:
            if shot.image is None:
                yield shot
                continue
            held.append((shot.frame.t_ns, shot.image))
            while len(held) > 1 and held[1][0] <= shot.frame.t_ns - round(lag_s * 1e9):
                held.popleft()
            yield replace(shot, image=held[0][1])

    return edit


def slow_pictures(span: Span, speed: float) -> Edit:
    """In ``span`` the pictures play at ``speed`` (below 1) times the true one, so that their delay grows until the end
    of the span. Times and telemetry are true."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        held: deque[tuple[float, Image]] = deque()
        for shot in shots:
            t_s = shot.frame.t_ns / 1e9
            if shot.image is None or not span.has(t_s):
                yield shot
                continue
            held.append((t_s, shot.image))
            shown_s = span.from_s + speed * (t_s - span.from_s)
            while len(held) > 1 and held[1][0] <= shown_s:
                held.popleft()
            yield replace(shot, image=held[0][1])

    return edit


def black(span: Span) -> Edit:
    """Black pictures in ``span``: a covered lens, or night."""
    return during(span, every_picture(np.zeros_like))


def frozen(span: Span) -> Edit:
    """In ``span`` the camera repeats the last picture before it."""
    return stale_buffers(span, 1, noise_grey=0.0)


def during(span: Span, edit: Edit) -> Edit:
    """``edit``, which must give one shot for each shot, is computed over the whole flight and used in ``span`` only."""

    def edited(shots: Iterator[Shot]) -> Iterator[Shot]:
        true, seen = tee(shots)
        for shot, changed in zip(true, edit(seen), strict=True):
            yield changed if span.has(shot.frame.t_ns / 1e9) else shot

    return edited


def mirrored_before(span: Span) -> Edit:
    """In ``span`` self-consistent pictures of another camera: the flight's own of FOREIGN_LAG_S before, mirrored."""
    return during(span, lambda shots: every_picture(mirrored)(late_pictures(FOREIGN_LAG_S)(shots)))


def partly_frozen(share: float, seed: int) -> Edit:
    """The lower ``share`` of each picture repeats the first one, with new noise: a part of the vehicle in view."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        rng = np.random.default_rng([seed, 73])
        first: Image | None = None
        for shot in shots:
            if shot.image is None:
                yield shot
                continue
            first = shot.image if first is None else first
            rows = round(share * len(first))
            image = shot.image.copy()
            image[-rows:] = _noisy(first[-rows:], NOISE_GREY, rng)
            yield replace(shot, image=image)

    return edit


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


def _due(waiting: deque[TimedMessage], t_ns: int) -> tuple[TimedMessage, ...]:
    """Removes and returns the messages up to ``t_ns`` from ``waiting``."""
    due = []
    while waiting and waiting[0].t_ns <= t_ns:
        due.append(waiting.popleft())
    return tuple(due)


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


def forged(span: Span, change: StateEdit) -> Edit:
    """Applies ``change`` to telemetry in ``span``; inertial readings stay true."""
    return telemetry(lambda state: change(state) if span.has(state.t_ns / 1e9) else state)


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


def height_unknown(state: VehicleState) -> VehicleState:
    return msgspec.structs.replace(state, agl_m=None)


def start_unknown(origin: Origin) -> Origin:
    """As of a source without a [start]."""
    return msgspec.structs.replace(origin, start_sigma_m=math.inf)


def start_sigma(sigma_m: float) -> OriginEdit:
    return lambda origin: msgspec.structs.replace(origin, start_sigma_m=sigma_m)


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


def _noisy(image: Image, sigma: float, rng: np.random.Generator) -> Image:
    if sigma == 0.0:
        return image
    noise = rng.normal(0.0, sigma, image.shape).astype(np.float32)
    return np.asarray(cv2.add(image, noise, dtype=cv2.CV_8U))
