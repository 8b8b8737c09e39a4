"""Edits of the pictures of a flight: other content, other times of exposure, other geometry."""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Protocol

import cv2
import msgspec
import numpy as np

from terrafix.core.node import Image
from terrafix.vision.sources import Shot
from terrafix_lab.faults.edits import Edit, Span, during

NOISE_GREY = 2.0  # 1-sigma of a picture's noise from frame to frame, grey values: a small camera by day
FOREIGN_LAG_S = 25.0  # longer than the span of a lie in the closed loop: no picture comes from the span itself
EXPOSURE_GAIN, EXPOSURE_OFFSET = 6.0, 60.0  # of an overexposed image: all but the darkest ground is white
DEFOCUS_PX = 12.0  # 1-sigma of the blur
JITTER_PX = 0.4  # of a picture that stands still, as of an encoder
WAVE_PX, WAVE_GREY, WATER_GREY = 3.0, 6.0, 70.0  # size and contrast of waves, 1-sigma; grey value of the water
SEED = 1  # of noise


class Sight(Protocol):
    """A picture without pixels: what of it depends on the camera's pose and lens."""

    def scaled(self, x: float, y: float) -> "Sight": ...

    def darkened(self) -> "Sight": ...


Change = Callable[[Image], Image]  # of a picture, an image or a Sight


def mirrored(picture: Image) -> Image:
    """Left and right exchanged: real texture that does not occur on the map."""
    return scaled(-1.0, 1.0)(picture)


def upside_down(picture: Image) -> Image:
    """Turned by 180 degrees."""
    return scaled(-1.0, -1.0)(picture)


def scaled(x: float, y: float) -> Change:
    """The content about the centre by these factors along the two axes, at least 1 or negative; the size stays."""

    def change(picture: Image) -> Image:
        if not isinstance(picture, np.ndarray):
            return picture.scaled(x, y)
        flipped = picture[:: -1 if y < 0 else 1, :: -1 if x < 0 else 1]
        if abs(x) == abs(y) == 1.0:
            return np.ascontiguousarray(flipped)
        height, width = picture.shape[:2]
        about = [[abs(x), 0.0, (1.0 - abs(x)) * (width - 1) / 2], [0.0, abs(y), (1.0 - abs(y)) * (height - 1) / 2]]
        return np.asarray(cv2.warpAffine(flipped, np.array(about), (width, height), flags=cv2.INTER_LINEAR))

    return change


def darkened(picture: Image) -> Image:
    return np.zeros_like(picture) if isinstance(picture, np.ndarray) else picture.darkened()


def overexposed(image: Image) -> Image:
    return np.asarray(cv2.convertScaleAbs(image, alpha=EXPOSURE_GAIN, beta=EXPOSURE_OFFSET))


def defocused(image: Image) -> Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), DEFOCUS_PX))


def halved(image: Image) -> Image:
    """Half the width and height."""
    return np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))


def every_picture(change: Change) -> Edit:
    """Applies ``change`` to each picture."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        for shot in shots:
            yield shot if shot.image is None else replace(shot, image=change(shot.image))

    return edit


def black(span: Span) -> Edit:
    """Black pictures in ``span``: a covered lens, or night."""
    return during(span, every_picture(darkened))


def torn(span: Span) -> Edit:
    """In ``span`` what comes is no image."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        for shot in shots:
            frame = msgspec.structs.replace(shot.frame, error="no image")
            yield replace(shot, image=None, frame=frame) if span.has(shot.frame.t_ns / 1e9) else shot

    return edit


def replaced(pictures: Mapping[str, Callable[[], Image]]) -> Edit:
    """Replaces the pictures of the frames with these file names by others of the same size, loaded on demand.

    Times and telemetry are unchanged."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        for shot in shots:
            load = pictures.get(shot.frame.file)
            yield shot if load is None else replace(shot, image=load())

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


def frozen(span: Span) -> Edit:
    """In ``span`` the camera repeats the last picture before it."""
    return stale_buffers(span, 1, noise_grey=0.0)


def jittering(span: Span) -> Edit:
    """In ``span`` the camera repeats the last picture before it, each time moved by JITTER_PX (1-sigma, each axis)."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        rng = np.random.default_rng([SEED, 74])
        for shot in frozen(span)(shots):
            if shot.image is None or not span.has(shot.frame.t_ns / 1e9):
                yield shot
                continue
            height, width = shot.image.shape[:2]
            moved = np.column_stack([np.eye(2), rng.normal(0.0, JITTER_PX, 2)])
            image = cv2.warpAffine(shot.image, moved, (width, height), borderMode=cv2.BORDER_REFLECT)
            yield replace(shot, image=np.asarray(image))

    return edit


def zooming(span: Span, factor: float) -> Edit:
    """In ``span`` the focal length grows evenly to ``factor`` times that of the description."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        for shot in shots:
            share = (shot.frame.t_ns / 1e9 - span.from_s) / (span.to_s - span.from_s)
            if shot.image is None or not 0.0 < share <= 1.0:
                yield shot
                continue
            scale = 1.0 + share * (factor - 1.0)
            yield replace(shot, image=scaled(scale, scale)(shot.image))

    return edit


def water(span: Span) -> Edit:
    """In ``span`` the camera sees open water: waves that are others in each picture, and nothing else."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        rng = np.random.default_rng([SEED, 75])
        for shot in shots:
            if shot.image is None or not span.has(shot.frame.t_ns / 1e9):
                yield shot
                continue
            waves = cv2.GaussianBlur(rng.normal(0.0, 1.0, shot.image.shape[:2]), (0, 0), WAVE_PX)
            grey = WATER_GREY + WAVE_GREY * waves / waves.std()
            image = np.clip(grey, 0, 255).astype(np.uint8)
            yield replace(shot, image=image if shot.image.ndim == 2 else cv2.merge([image] * 3))

    return edit


def taken_at(taken_s: Callable[[float], float]) -> Edit:
    """At ``t`` seconds the newest picture from ``taken_s(t)`` or before is shown; times and telemetry are unchanged."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        held: deque[tuple[int, Image]] = deque()
        for shot in shots:
            if shot.image is None:
                yield shot
                continue
            held.append((shot.frame.t_ns, shot.image))
            while len(held) > 1 and held[1][0] <= round(1e9 * taken_s(shot.frame.t_ns / 1e9)):
                held.popleft()
            yield replace(shot, image=held[0][1])

    return edit


def late_pictures(lag_s: float) -> Edit:
    return taken_at(lambda t_s: t_s - lag_s)


def falling_behind(span: Span, lag_s: float) -> Edit:
    """In ``span`` the delay of the pictures grows evenly from nothing to ``lag_s``: a buffer that is not emptied as
    fast as it fills. Afterwards they are live."""
    per_s = lag_s / (span.to_s - span.from_s)
    return taken_at(lambda t_s: t_s - per_s * (t_s - span.from_s) if span.has(t_s) else t_s)


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


def _noisy(picture: Image, sigma: float, rng: np.random.Generator) -> Image:
    if sigma == 0.0 or not isinstance(picture, np.ndarray):
        return picture
    noise = rng.normal(0.0, sigma, picture.shape).astype(np.float32)
    return np.asarray(cv2.add(picture, noise, dtype=cv2.CV_8U))
