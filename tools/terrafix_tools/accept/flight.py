"""The flight that scenarios are made of: where its frames are, when they were taken, and the truth."""

from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import msgspec
import numpy as np

from terrafix.core.errors import EvaluationError
from terrafix.core.geodesy import LocalFrame
from terrafix.core.node import Image
from terrafix.messages import VehicleState
from terrafix.vision.sources import open_source
from terrafix_tools.estimates import number, read_table
from terrafix_tools.evaluate import Truth, read_truth

SAID = ("yaw_rad", "pitch_rad", "roll_rad", "agl_m", "velocity_enu_mps")
DEFAULT_AGL_M = 120.0  # of a flight that reports no height


class Stop(msgspec.Struct, frozen=True):
    """One frame of the flight."""

    file: str
    t_s: float
    state: VehicleState | None  # all that the vehicle had said by then, the newest of each


@dataclass(frozen=True)
class Flight:
    source: str  # what open_source takes
    map_path: Path | None  # None: the flight names its own
    dem: Path | None
    truth: dict[str, Truth]
    stops: list[Stop]
    footprint_m: float  # diagonal of what one frame sees, at the middle height
    other_map: Path | None = None  # GeoTIFF of another place, for scenarios that fly with it; None: none was given

    @property
    def has_raster_map(self) -> bool:
        """The map is a GeoTIFF, which a scenario can change; a package it cannot."""
        return self.map_path is not None and self.map_path.suffix.lower() != ".gpkg"

    @property
    def duration_s(self) -> float:
        return self.stops[-1].t_s - self.stops[0].t_s

    def at(self, share: float) -> int:
        """Number of the frame after this share of the frames."""
        return round(share * (len(self.stops) - 1))

    def track_m(self) -> np.ndarray:
        """(N, 2) true east, north of every frame around the first known one; nan where there is no truth."""
        first = next(self.truth[s.file] for s in self.stops if s.file in self.truth)
        place = LocalFrame(first.lat_deg, first.lon_deg)
        known = [self.truth.get(stop.file) for stop in self.stops]
        return np.array([(np.nan, np.nan) if t is None else place.to_local(t.lat_deg, t.lon_deg) for t in known], float)

    def picture(self, number: int) -> Image:
        """Of this frame, or of the first one after it that can be read."""
        with closing(open_source(self.source)) as source:
            shots = source.shots(from_s=self.stops[number].t_s)
            return next(shot.image for shot in shots if shot.image is not None)


def open_flight(source: str, map_path: Path | None, dem: Path | None, truth: Path, frames: int | None) -> Flight:
    """Goes once through the flight. ``frames``: only so many of it. Raises SourceError, EvaluationError."""
    opened = open_source(source)
    camera = opened.origin().camera
    stops: list[Stop] = []
    said: dict[str, object] = {}
    for shot in islice(opened.shots(), frames):
        for state in shot.states:
            said |= {name: value for name in SAID if (value := getattr(state, name)) is not None}
        latest = VehicleState(t_ns=shot.frame.t_ns, source="acceptance", **said) if said else None  # type: ignore[arg-type]
        stops.append(Stop(shot.frame.file, shot.frame.t_ns / 1e9, latest))
    map_path = map_path or opened.map_hint()
    opened.close()
    known = read_any_truth(truth, [stop.file for stop in stops])
    heights = [stop.state.agl_m for stop in stops if stop.state and stop.state.agl_m is not None]
    agl_m = float(np.median(heights)) if heights else DEFAULT_AGL_M
    footprint_m = agl_m * float(np.hypot(camera.width / camera.fx, camera.height / camera.fy))
    return Flight(source, map_path, dem, known, stops, footprint_m)


def read_any_truth(path: Path, files: list[str]) -> dict[str, Truth]:
    """truth.csv (file, lat_deg, lon_deg) or coordinates.csv (image, lat, lon), for the frames ``files``.

    Names in coordinates.csv may lack the suffix. Raises EvaluationError."""
    try:
        head = path.read_text(encoding="utf-8-sig").partition("\n")[0]
    except FileNotFoundError:
        raise EvaluationError(f"{path}: no such file; give truth.csv or coordinates.csv with --truth") from None
    except (OSError, UnicodeDecodeError) as error:
        raise EvaluationError(f"{path}: cannot be read ({error})") from None
    columns = [name.strip() for name in head.split(",")]
    known = _coordinates(path) if "image" in columns else read_truth(path)
    by_stem = {Path(name).stem: at for name, at in known.items()}
    found = {file: at for file in files if (at := known.get(file) or by_stem.get(Path(file).stem)) is not None}
    if not found:
        raise EvaluationError(
            f"{path}: none of its names is a frame of the flight ('{files[0]}' ...); is it the truth of this flight?"
        )
    return found


def _coordinates(path: Path) -> dict[str, Truth]:
    """PB-11's table. The general reader wants a column ``file``: this is the same table under another name."""
    truth = {}
    for line, row in read_table(path, ("image", "lat", "lon"), "give the coordinates of this flight", key="image"):
        lat_deg, lon_deg = number(path, line, "lat", row["lat"]), number(path, line, "lon", row["lon"])
        if lat_deg is None or lon_deg is None:
            continue
        if not (abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0):
            raise EvaluationError(f"{path}, line {line}: {lat_deg}, {lon_deg} is no place on earth; columns swapped?")
        truth[row["image"]] = Truth(lat_deg, lon_deg)
    if not truth:
        raise EvaluationError(f"{path}: no row with a position")
    return truth
