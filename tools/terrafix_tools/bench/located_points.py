"""Object positions of a recorded flight against the map and against each other.

python -m terrafix_tools.bench.located_points REPLAY

Two tests that need no survey. Points of the map: the pixel of a map match, located, against the place of that match on
the map. One point in several keyframes: the pixel of a feature in two keyframes, located from each. Both errors are
compared with the stated covariances; the error of the map is common to both sides and not tested."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from terrafix.core.camera import CameraCalibration
from terrafix.core.gate import CHI2_95
from terrafix.messages import MapMatch, Odometry, Verdict
from terrafix.recorder.reader import read_flight
from terrafix_tools.locate.locator import FlightLocator
from terrafix_tools.locate.position import ObjectPosition
from terrafix_tools.standalone import run_standalone

SEED = 5  # of the points that are drawn
PER_FRAME = 4  # points drawn from one frame: neighbours have the same error


@dataclass(frozen=True)
class Errors:
    """Horizontal differences (N,) in metres, and whether each is in the stated 95 % ellipse (N,)."""

    length_m: np.ndarray
    inside: np.ndarray

    def line(self, name: str) -> str:
        return (
            f"{name:28}{len(self.length_m):7}{np.median(self.length_m):10.2f}{np.percentile(self.length_m, 95):8.2f}"
            f"{100 * self.inside.mean():11.1f} %"
        )


def map_points(locator: FlightLocator, replayed: Path, random: np.random.Generator) -> Errors:
    found = []
    for _, _, match in read_flight(replayed):
        if isinstance(match, MapMatch) and match.verdict is Verdict.ACCEPTED and match.frame_id in locator.flight.views:
            camera = replace(locator.flight.views[match.frame_id].calibration, radial_k1=match.radial_k1)
            for x, y, e_m, n_m, _, _ in _some(match.matches, random):
                position = _located(locator, match.frame_id, camera, (x, y))
                if position is not None:
                    found.append((position.p_m[:2] - (e_m, n_m), position.cov[:2, :2]))
    return _errors(found)


def same_points(locator: FlightLocator, replayed: Path, random: np.random.Generator) -> Errors:
    """A feature in a keyframe and in the next one. Their stated covariances add up as if independent: an upper bound,
    since poses of one flight share errors."""
    camera = CameraCalibration.of(locator.flight.origin.camera)
    found = []
    for _, _, odometry in read_flight(replayed):
        if isinstance(odometry, Odometry) and odometry.becomes_keyframe and odometry.keyframe_id != odometry.frame_id:
            ids = (odometry.keyframe_id, odometry.frame_id)
            if all(frame_id in locator.flight.views for frame_id in ids):
                for x_kf, y_kf, x, y in _some(odometry.two_view, random):
                    first = _located(locator, ids[0], camera, (x_kf, y_kf))
                    second = _located(locator, ids[1], camera, (x, y))
                    if first is None or second is None:
                        continue
                    found.append((first.p_m[:2] - second.p_m[:2], first.cov[:2, :2] + second.cov[:2, :2]))
    return _errors(found)


def _some(points: list[Any], random: np.random.Generator) -> list[Any]:
    chosen: list[int] = random.permutation(len(points))[:PER_FRAME].tolist()
    return [points[i] for i in chosen]


def _located(
    locator: FlightLocator, frame_id: int, camera: CameraCalibration, xy: tuple[float, float]
) -> ObjectPosition | None:
    """None: a point at the border, which the present estimate of the lens projects out of the frame."""
    u, v = camera.project(np.array([[*xy, 1.0]]))[0]
    if not (0.0 <= u < camera.width and 0.0 <= v < camera.height):
        return None
    return locator.locate([(str(frame_id), (float(u), float(v)))])


def _errors(found: list[tuple[np.ndarray, np.ndarray]]) -> Errors:
    error_m, cov_m2 = np.array([error for error, _ in found]), np.array([cov for _, cov in found])
    squared = np.einsum("ni,nij,nj->n", error_m, np.linalg.inv(cov_m2), error_m)
    return Errors(np.hypot(*error_m.T), squared <= CHI2_95)


def bench(replay: Annotated[Path, typer.Argument(help="Output of replay.")]) -> None:
    """Compare object positions with the map and with each other."""
    locator = FlightLocator.open(replay)
    random = np.random.default_rng(SEED)
    lines = [
        map_points(locator, replay, random).line("map points"),
        same_points(locator, replay, random).line("one point in two keyframes"),
    ]
    typer.echo(f"{'':28} points  median m   p95 m  inside 95 %")
    for line in lines:
        typer.echo(line)


if __name__ == "__main__":
    run_standalone("located_points", bench)
