"""Cameras and images of a recorded flight for an orthomosaic."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from terrafix.core.errors import SourceError
from terrafix.estimator.state import HORIZONTAL
from terrafix.recorder.reader import read_frame_images
from terrafix.vision.sources import open_source
from terrafix_tools.evaluate import read_summary
from terrafix_tools.locate.views import CameraView

MIN_STEP_SHARE = 0.15  # of the height, between two frames that are used: nearer ones show the same ground again


def spread(views: dict[int, CameraView], max_sigma_m: float) -> list[CameraView]:
    """Cameras in the order of the flight whose position is known to ``max_sigma_m`` (1-sigma, the worse axis), without
    those that stand near the one before."""
    chosen: list[CameraView] = []
    for _, view in sorted(views.items()):
        if np.sqrt(np.linalg.eigvalsh(view.cov[HORIZONTAL, HORIZONTAL])[-1]) > max_sigma_m:
            continue
        if chosen:
            moved_m = float(np.linalg.norm(view.p_c_in_w_m - chosen[-1].p_c_in_w_m))
            if moved_m < MIN_STEP_SHARE * view.height_m:
                continue
        chosen.append(view)
    return chosen


def images(record: Path, source: Path | None, wanted: set[int]) -> Iterator[tuple[int, np.ndarray]]:
    """Yields (frame id, image (H, W, 3) uint8 BGR) of the ``wanted`` frames: of the record where it has them, else of
    ``source``, None: that which the summary of a replay names.

    Raises SourceError."""
    found = False
    for image in read_frame_images(record):
        found = True
        pixels = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
        if image.frame_id in wanted and pixels is not None:
            yield image.frame_id, pixels
    if found:
        return
    folder = record if record.is_dir() else record.parent
    source = source or _source_of(folder)
    if source is None:
        raise SourceError(f"{record}: has no frames at full size, and names no source; give its flight with --frames")
    shots = open_source(str(source))
    for shot in shots.shots():
        if shot.frame.frame_id in wanted and shot.image is not None:
            yield shot.frame.frame_id, shot.image
    shots.close()


def _source_of(folder: Path) -> Path | None:
    """The source that summary.json of a replay names, if it is there."""
    named = read_summary(folder).get("source", "")
    return Path(named) if named and Path(named).exists() else None
