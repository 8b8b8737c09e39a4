"""The frames of a flight record as a source, for a replay that computes vision and map matching again as well."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from terrafix.core.errors import SourceError
from terrafix.messages import (
    EkfDeadReckoning,
    Fact,
    Frame,
    GimbalAttitude,
    GnssInitialPosition,
    Health,
    Imu,
    Message,
    PositionHint,
    VehicleState,
)
from terrafix.recorder.reader import FrameImage, ReadResult, read_with_images
from terrafix.vision.sources import Shot
from terrafix.vision.sources.contract import SourceBase
from terrafix_tools.log.edit import origin_of

ALL_FRAMES = "all"  # of [recorder] frames
# What the replayed processes receive from others, beside telemetry.
OTHERS = (EkfDeadReckoning, GimbalAttitude, GnssInitialPosition, Health, PositionHint)
NOT_RECORDED = "the record does not have the pixels of this frame"


class RecordedFrames(SourceBase):
    """A Source. Raises SourceError for a record without all frames at full size."""

    def __init__(self, record: Path) -> None:
        self.record = record
        result = ReadResult()
        self._origin = origin_of(record, result)
        self.header: dict[str, Any] = result.header
        kept = self.header["config"].get("recorder", {}).get("frames", "thumbnails")
        if kept != ALL_FRAMES:
            raise SourceError(
                f'{record}: its frames were not recorded at full size ([recorder] frames = "{kept}"); replay it from '
                f'its messages, without --frames, or record the next flight with frames = "{ALL_FRAMES}"'
            )

    def name(self) -> str:
        return self.record.resolve().name

    def map_hint(self) -> Path | None:
        path = self.header.get("map", {}).get("path", "") or self.header["config"].get("map", {}).get("path", "")
        return Path(path) if path else None

    def facts(self) -> list[Fact]:
        return [Fact(*fact) for fact in self.header.get("source", [])]

    def shots(self, from_s: float = 0.0) -> Iterator[Shot]:
        """A frame waits for its pixels, which are recorded after it, until those of a later frame arrive."""
        waiting: list[Shot] = []
        since: list[Message] = []
        for message in read_with_images(self.record):
            if isinstance(message, FrameImage):
                while waiting and waiting[0].frame.frame_id <= message.frame_id:
                    shot = waiting.pop(0)
                    yield _with_pixels(shot, message if shot.frame.frame_id == message.frame_id else None)
            elif isinstance(message, Frame):
                waiting.append(_shot(message, since))
                since = []
            elif isinstance(message, (VehicleState, Imu, *OTHERS)):
                since.append(message)
        for shot in waiting:
            yield _with_pixels(shot, None)


def _shot(frame: Frame, since: list[Message]) -> Shot:
    """Without its pixels. ``since``: messages since the frame before."""
    return Shot(
        frame=frame,
        states=tuple(message for message in since if isinstance(message, VehicleState)),
        image=None,
        imu=tuple(message for message in since if isinstance(message, Imu)),
        others=tuple(message for message in since if isinstance(message, OTHERS)),
    )


def _with_pixels(shot: Shot, image: FrameImage | None) -> Shot:
    if shot.frame.error:
        return shot
    pixels = None if image is None else cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
    frame = shot.frame if pixels is not None else msgspec.structs.replace(shot.frame, error=NOT_RECORDED)
    return Shot(frame, shot.states, pixels, shot.imu, shot.others)
