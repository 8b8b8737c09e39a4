"""Vision and estimator over a flight folder, without an anchor: a flight over ground that no map shows."""

import csv
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from terrafix.core.frames import MemoryFrameStore
from terrafix.core.geodesy import LocalFrame
from terrafix.core.node import Image
from terrafix.estimator.node import EstimatorNode
from terrafix.messages import (
    Imu,
    MeasurementVerdict,
    Message,
    NavEstimate,
    Odometry,
    Origin,
    Relocalization,
    VehicleState,
)
from terrafix.vision.node import VisionNode
from terrafix.vision.sources import Shot, open_source

Alter = Callable[[Shot], Shot | None]  # -> the shot to fly with; None: it is left out


def unaltered(shot: Shot) -> Shot | None:
    return shot


@dataclass
class MaplessFlight:
    """``truth_m``: frame -> true position (2,), east and north; ``published``: by vision and estimator."""

    place: LocalFrame
    truth_m: dict[int, np.ndarray] = field(default_factory=dict)
    t_s: dict[int, float] = field(default_factory=dict)
    published: list[Message] = field(default_factory=list)

    def estimates(self) -> dict[int, NavEstimate]:
        """Newest estimate of each frame."""
        return {m.frame_id: m for m in self.published if isinstance(m, NavEstimate)}

    def odometry(self) -> list[Odometry]:
        return [m for m in self.published if isinstance(m, Odometry)]

    def relocalizations(self) -> list[Relocalization]:
        return [m for m in self.published if isinstance(m, Relocalization)]

    def verdicts(self, measurement: str) -> list[MeasurementVerdict]:
        verdicts = (m for m in self.published if isinstance(m, MeasurementVerdict))
        return [m for m in verdicts if m.measurement == measurement]

    def error_m(self, frame_id: int) -> np.ndarray:
        """(2,): east and north."""
        estimate = self.estimates()[frame_id]
        return np.array(self.place.to_local(estimate.lat_deg, estimate.lon_deg)) - self.truth_m[frame_id]

    def cov_m2(self, frame_id: int) -> np.ndarray:
        return np.array(self.estimates()[frame_id].cov).reshape(6, 6)[:2, :2]

    def way_m(self) -> float:
        return float(np.linalg.norm(np.diff(list(self.truth_m.values()), axis=0), axis=1).sum())


def fly(
    folder: Path, alter: Alter = unaltered, *, relocalize: bool = True, estimate: bool = True, imu: bool = True
) -> MaplessFlight:
    """``relocalize``: the estimator gets Relocalization; ``estimate``: there is an estimator."""
    source = open_source(str(folder))
    origin, store = source.origin(), MemoryFrameStore()
    truth = {row["file"]: (float(row["lat_deg"]), float(row["lon_deg"])) for row in _rows(folder / "truth.csv")}
    flown = MaplessFlight(LocalFrame(origin.lat_deg, origin.lon_deg))
    vision, estimator = VisionNode(store), EstimatorNode()

    def deliver(message: Message) -> None:
        flown.published.append(message)
        if not estimate or (isinstance(message, Relocalization) and not relocalize):
            return
        flown.published += estimator.on(message)

    _both(origin, vision, deliver)
    for shot in source.shots(0.0):
        altered = alter(shot)
        if altered is None:
            continue
        frame = altered.frame
        flown.truth_m[frame.frame_id] = np.array(flown.place.to_local(*truth[Path(frame.file).name]))
        flown.t_s[frame.frame_id] = frame.t_ns * 1e-9
        if altered.image is not None:
            store.put(frame.frame_id, altered.image)
        for message in (*(altered.imu if imu else ()), *altered.states, frame):
            _both(message, vision, deliver)
    source.close()
    return flown


def darkened(shot: Shot) -> Shot:
    """The same shot, with a black image."""
    assert shot.image is not None
    image: Image = np.zeros_like(shot.image)
    return Shot(shot.frame, shot.states, image, shot.imu)


def _both(message: Message, vision: VisionNode, deliver: Callable[[Message], None]) -> None:
    if isinstance(message, (VehicleState, Imu, Origin)):
        deliver(message)
    for reply in vision.on(message):
        deliver(reply)


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))
