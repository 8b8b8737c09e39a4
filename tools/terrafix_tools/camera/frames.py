"""Views of a board from images, a video or a device."""

import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from terrafix.core.errors import SourceError
from terrafix.vision.sources import VIDEO_SUFFIXES
from terrafix.vision.sources.images import IMAGE_SUFFIXES
from terrafix_tools.camera.board import Board
from terrafix_tools.camera.calibrating import MIN_CORNERS, BoardView

VIDEO_STEP_S = 0.25  # between frames of a video or device that are looked at
MIN_MOVED = 0.04  # of the image width by which the board has moved since each view that is kept of a video
MAX_VIEWS = 60  # of a video; more take minutes and tell little
DEVICE_S = 90.0  # that a device is watched at most


def board_views(sources: Sequence[str], board: Board) -> tuple[list[BoardView], tuple[int, int], int]:
    """-> views with the board, width and height of the images, and how many were looked at. Raises SourceError."""
    views: list[BoardView] = []
    size: tuple[int, int] | None = None
    count = 0
    for name, grey, moving in _images(sources):
        count += 1
        if size is None:
            size = grey.shape[1], grey.shape[0]
        if size != (grey.shape[1], grey.shape[0]):
            raise SourceError(
                f"{name}: {grey.shape[1]}x{grey.shape[0]} px, those before have {size[0]}x{size[1]}; calibrate one mode"
            )
        view = BoardView(name, *board.find(grey))
        if len(view.ids) >= MIN_CORNERS and (not moving or _is_new(view, views, MIN_MOVED * size[0])):
            views.append(view)
        if moving and len(views) >= MAX_VIEWS:
            break
    if size is None:
        raise SourceError(f"{' '.join(sources)}: no images; name images, a folder, a video or a device")
    return views, size, count


def _is_new(view: BoardView, views: Sequence[BoardView], moved_px: float) -> bool:
    """Whether the corners are elsewhere than in each view: in a video most are not."""
    for old in views:
        _, ours, theirs = np.intersect1d(view.ids, old.ids, return_indices=True)
        if len(ours) and np.hypot(*(view.px[ours] - old.px[theirs]).T).mean() < moved_px:
            return False
    return True


def _images(sources: Sequence[str]) -> Iterator[tuple[str, np.ndarray, bool]]:
    """Name, image (H, W) and whether it is of a video or device. Raises SourceError."""
    for source in sources:
        path = Path(source)
        if source.isdecimal() or source.startswith("/dev/") or "://" in source:
            yield from _moving(source, cv2.VideoCapture(int(source) if source.isdecimal() else source), DEVICE_S)
        elif path.suffix.lower() in VIDEO_SUFFIXES:
            yield from _moving(source, cv2.VideoCapture(str(path)), None)
        else:
            files = sorted(p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES) if path.is_dir() else [path]
            for file in files:
                image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
                if image is None:
                    missing = "cannot be read as an image" if file.exists() else "no such file or folder"
                    raise SourceError(f"{file}: {missing}")
                yield file.name, image, False


def _moving(source: str, capture: cv2.VideoCapture, limit_s: float | None) -> Iterator[tuple[str, np.ndarray, bool]]:
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    if not capture.isOpened():
        raise SourceError(f"{source}: cannot be opened as a video or camera; is it there, and free?")
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    began_s, due_s = time.monotonic(), 0.0
    rate = capture.get(cv2.CAP_PROP_FPS) or 30.0
    index = -1
    while capture.grab():
        index += 1
        t_s = index / rate if limit_s is None else time.monotonic() - began_s
        if limit_s is not None and t_s > limit_s:
            break
        if t_s < due_s:
            continue
        due_s = t_s + VIDEO_STEP_S
        decoded, image = capture.retrieve()
        if decoded:
            yield f"{Path(source).name}@{t_s:.2f}", cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), True
    capture.release()
