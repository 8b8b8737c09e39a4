"""What the record holds of the chosen moments: matches, verdicts and pictures, which are too many to keep for all."""

from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass, field

import cv2
import numpy as np

from terrafix.messages import MapMatch, MeasurementVerdict, Message, NavEstimate, Odometry, PoseSolution, Prediction
from terrafix.recorder.reader import read_with_thumbnails
from terrafix_tools.report.data import FlightView
from terrafix_tools.report.moments import Moment

_KINDS = (MapMatch, PoseSolution, Prediction, NavEstimate, Odometry, MeasurementVerdict)
JPEG_END = b"\xff\xd9"
NEAR_S = 1.5  # a map match of a neighbouring frame is shown if it is not farther; maps are matched at 1 to 2 Hz


@dataclass
class FrameRecord:
    """Last messages of one frame, all of its verdicts."""

    frame_id: int
    match: MapMatch | None = None
    solution: PoseSolution | None = None
    prediction: Prediction | None = None
    estimate: NavEstimate | None = None
    odometry: Odometry | None = None
    verdicts: list[MeasurementVerdict] = field(default_factory=list)

    def take(self, message: Message) -> None:
        match message:
            case MapMatch():
                self.match = message
            case PoseSolution():
                self.solution = message
            case Prediction():
                self.prediction = message
            case NavEstimate():
                self.estimate = message
            case Odometry():
                self.odometry = message
            case MeasurementVerdict():
                self.verdicts.append(message)


def shown_frame(view: FlightView, moment: Moment) -> int:
    """Frame id whose picture and matches stand for a moment: its own frame if that was matched with the map, else the
    nearest one within NEAR_S that was, else its own."""
    times_s = [t for t, _ in view.map_matches]
    i = bisect_left(times_s, moment.t_s)
    near = [(abs(t - moment.t_s), frame_id) for t, frame_id in view.map_matches[max(0, i - 2) : i + 2]]
    distance_s, frame_id = min(near, default=(NEAR_S, moment.frame_id))
    matched = {frame_id for _, frame_id in near}
    return moment.frame_id if moment.frame_id in matched or distance_s >= NEAR_S else frame_id


def read_frames(
    view: FlightView, frame_ids: Iterable[int], rows: Iterable[int]
) -> tuple[dict[int, FrameRecord], dict[int, bytes]]:
    """Reads the messages of some frames, and pictures by frame id: those of the frames, and for each of ``rows`` the
    nearest one that there is. A damaged picture is left out. One pass over the record."""
    found = {frame_id: FrameRecord(frame_id) for frame_id in frame_ids}
    pictures = _Pictures(view, set(found), list(rows))
    for item in read_with_thumbnails(view.folder, _KINDS):
        if isinstance(item, tuple):
            pictures.take(*item)
        elif isinstance(item, _KINDS) and item.frame_id in found:
            found[item.frame_id].take(item)
    return found, pictures.readable()


class _Pictures:
    """Keeps only the pictures that the page needs: those of an hour do not fit into memory."""

    def __init__(self, view: FlightView, frame_ids: set[int], rows: list[int]) -> None:
        self._frame_ids = frame_ids
        self._row_of = {frame_id: i for i, frame_id in enumerate(view.frame_ids)}
        self._targets = rows
        self._exact: dict[int, bytes] = {}
        self._nearest: dict[int, tuple[int, int, bytes]] = {}  # by row: distance in rows, frame id, picture

    def take(self, frame_id: int, jpeg: bytes) -> None:
        if frame_id in self._frame_ids:
            self._exact[frame_id] = jpeg
        if frame_id in self._row_of and jpeg.endswith(JPEG_END):
            for row in self._targets:
                distance = abs(self._row_of[frame_id] - row)
                if row not in self._nearest or distance < self._nearest[row][0]:
                    self._nearest[row] = (distance, frame_id, jpeg)

    def readable(self) -> dict[int, bytes]:
        found = self._exact | {frame_id: jpeg for _, frame_id, jpeg in self._nearest.values()}
        return {frame_id: jpeg for frame_id, jpeg in found.items() if is_picture(jpeg)}


def is_picture(jpeg: bytes) -> bool:
    """False for a damaged JPEG: it does not decode, or lacks its end."""
    if not jpeg.endswith(JPEG_END):
        return False
    try:
        return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_REDUCED_GRAYSCALE_8) is not None
    except cv2.error:
        return False
