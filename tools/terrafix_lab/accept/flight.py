"""The flight on which scenarios are based: times and telemetry of its frames, and the truth."""

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

REPORTED = ("yaw_rad", "pitch_rad", "roll_rad", "agl_m", "velocity_enu_mps")
DEFAULT_AGL_M = 120.0  # of a flight that reports no height


class FrameRef(msgspec.Struct, frozen=True):
    """One frame of the flight."""

    file: str
    t_s: float
    state: VehicleState | None  # the newest value of each quantity by then


@dataclass(frozen=True)
class AcceptFlight:
    source: str  # argument of open_source
    map_path: Path | None  # None: that of the flight
    dem: Path | None
    truth: dict[str, Truth]
    frame_refs: list[FrameRef]
    footprint_m: float  # diagonal of the footprint of a frame at the median height
    other_map: Path | None = None  # GeoTIFF of another place, for scenarios with a wrong map; None: none was given

    @property
    def has_raster_map(self) -> bool:
        """The map is a GeoTIFF, which a scenario can edit; it cannot edit a package."""
        return self.map_path is not None and self.map_path.suffix.lower() != ".gpkg"

    @property
    def duration_s(self) -> float:
        return self.frame_refs[-1].t_s - self.frame_refs[0].t_s

    def at(self, share: float) -> int:
        """Index of the frame at this share of the frames."""
        return round(share * (len(self.frame_refs) - 1))

    def track_m(self) -> np.ndarray:
        """(N, 2) true east, north of every frame around the first known one; nan where there is no truth."""
        first = next(self.truth[s.file] for s in self.frame_refs if s.file in self.truth)
        place = LocalFrame(first.lat_deg, first.lon_deg)
        known = [self.truth.get(ref.file) for ref in self.frame_refs]
        return np.array([(np.nan, np.nan) if t is None else place.to_local(t.lat_deg, t.lon_deg) for t in known], float)

    def picture(self, number: int) -> Image:
        """Picture of this frame, or of the first readable one after it."""
        with closing(open_source(self.source)) as source:
            shots = source.shots(from_s=self.frame_refs[number].t_s)
            return next(shot.image for shot in shots if shot.image is not None)


def open_flight(source: str, map_path: Path | None, dem: Path | None, truth: Path, frames: int | None) -> AcceptFlight:
    """Reads the flight once. ``frames``: limit of the frames. Raises SourceError, EvaluationError."""
    opened = open_source(source)
    camera = opened.origin().camera
    frame_refs: list[FrameRef] = []
    reported: dict[str, object] = {}
    for shot in islice(opened.shots(), frames):
        for state in shot.states:
            reported |= {name: value for name in REPORTED if (value := getattr(state, name)) is not None}
        latest = VehicleState(t_ns=shot.frame.t_ns, source="acceptance", **reported) if reported else None  # type: ignore[arg-type]
        frame_refs.append(FrameRef(shot.frame.file, shot.frame.t_ns / 1e9, latest))
    map_path = map_path or opened.map_hint()
    opened.close()
    known = read_any_truth(truth, [ref.file for ref in frame_refs])
    heights = [ref.state.agl_m for ref in frame_refs if ref.state and ref.state.agl_m is not None]
    agl_m = float(np.median(heights)) if heights else DEFAULT_AGL_M
    footprint_m = agl_m * float(np.hypot(camera.width / camera.fx, camera.height / camera.fy))
    return AcceptFlight(source, map_path, dem, known, frame_refs, footprint_m)


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
    """Table of PB-11: as truth.csv, with the column ``image`` instead of ``file``."""
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
