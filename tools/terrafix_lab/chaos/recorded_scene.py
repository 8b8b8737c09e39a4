"""The scene of a fault matrix from a recorded flight: its images, and its truth as the course of the autopilot."""

import csv
import math
from pathlib import Path

import numpy as np

from terrafix.core.errors import SourceError
from terrafix.core.geodesy import LocalFrame
from terrafix.vision.sources.description import camera_of, read_description
from terrafix.vision.sources.table import Row, read_table
from terrafix_lab.chaos.scene import ChaosScene, phases_in_the_air
from terrafix_lab.sim.autopilot.course import PeerState, read_course, write_course
from terrafix_tools.evaluate import Truth, read_truth, truth_sigma_of
from terrafix_tools.flight_map import package_of

SMOOTHING_S = 2.5  # of the velocity: the truth of a flight is good to metres, and the autopilot's EKF to decimetres
UNEVEN = 0.1  # share of the period by which images of an even rate may be off
ATTITUDE_SIGMA_DEG = 5.0  # of roll and pitch where none were recorded: the course is level [measured: docs/faults.md]


def recorded_scene(flight: Path, map_path: Path | None, folder: Path) -> ChaosScene:
    """``flight``: folder with flight.toml, frames.csv, JPEG frames and truth.csv; ``map_path``: None for the one that
    it names. Its course is written into ``folder``. Raises SourceError, EvaluationError, MapError, OutputError."""
    description = read_description(flight / "flight.toml")
    rows = read_table(flight / "frames.csv", str(flight), with_file=True)
    truth = read_truth(flight / "truth.csv")
    rows = [row for row in rows if row.file in truth]
    if len(rows) < 2:
        raise SourceError(f"{flight}: fewer than two frames have a position in truth.csv")
    jpegs = [flight / "frames" / row.file for row in rows]
    if any(path.suffix.lower() not in (".jpg", ".jpeg") for path in jpegs):
        raise SourceError(f"{flight}: its frames are no JPEG files, which a camera over HTTP sends")
    times_s = np.array([row.t_ns for row in rows]) / 1e9
    times_s -= times_s[0]
    course_csv = folder / "course.csv"
    ground_amsl_m = description.start.ground_amsl_m if description.start else None
    states = _states(rows, truth, _heights_and_headings(flight, rows), ground_amsl_m or 0.0, times_s)
    write_course(course_csv, zip(times_s.tolist(), states, strict=True))
    course = read_course(course_csv)
    has_attitude = all(row.state is not None and row.state.roll_rad is not None for row in rows)
    return ChaosScene(
        map_path=package_of(map_path or (flight / description.map).resolve(), progress=True),
        jpegs=jpegs,
        course=course,
        at_s=phases_in_the_air(course, float(times_s[-1])),
        duration_s=float(times_s[-1]),
        camera=camera_of(flight / "flight.toml", description),
        frame_hz=_rate_hz(flight, times_s),
        truth_sigma_m=truth_sigma_of(flight / "truth.csv") or 0.0,
        attitude_sigma_deg=None if has_attitude else ATTITUDE_SIGMA_DEG,
    )


def _states(
    rows: list[Row],
    truth: dict[str, Truth],
    heights_headings: dict[str, tuple[float, float]],
    ground_amsl_m: float,
    times_s: np.ndarray,
) -> list[PeerState]:
    """The states at the frames; the velocity is that of the smoothed truth."""
    first = truth[rows[0].file]
    frame = LocalFrame(first.lat_deg, first.lon_deg)
    east_north = [frame.to_local(truth[row.file].lat_deg, truth[row.file].lon_deg) for row in rows]
    height_m = np.array([heights_headings[row.file][0] for row in rows])
    place_m = np.column_stack([np.array(east_north), height_m])
    count = max(1, round(SMOOTHING_S / float(np.median(np.diff(times_s)))))
    smooth_m = np.column_stack([_mean_of(column, count) for column in place_m.T])
    velocity_mps = np.gradient(smooth_m, times_s, axis=0)
    states = []
    for row, (ve, vn, vu), agl_m in zip(rows, velocity_mps.tolist(), height_m.tolist(), strict=True):
        at, yaw_rad = truth[row.file], heights_headings[row.file][1]
        pitch_rad = 0.0 if row.state is None else row.state.pitch_rad or 0.0
        roll_rad = 0.0 if row.state is None else row.state.roll_rad or 0.0
        states.append(
            PeerState(at.lat_deg, at.lon_deg, ground_amsl_m + agl_m, agl_m, yaw_rad, pitch_rad, roll_rad, vn, ve, -vu)
        )
    return states


def _mean_of(values: np.ndarray, count: int) -> np.ndarray:
    """Moving mean over ``count`` values, of fewer at the ends."""
    kernel = np.ones(count)
    weights = np.convolve(np.ones(len(values)), kernel, "same")
    return np.asarray(np.convolve(values, kernel, "same") / weights)


def _heights_and_headings(flight: Path, rows: list[Row]) -> dict[str, tuple[float, float]]:
    """By file: height above ground [m] and heading [rad] of the truth, or those of the telemetry."""
    with (flight / "truth.csv").open(newline="", encoding="utf-8-sig") as file:
        cells = {row["file"]: (row.get("agl_m") or "", row.get("yaw_deg") or "") for row in csv.DictReader(file)}
    found = {}
    for row in rows:
        agl, yaw = cells[row.file]
        reported = (None, None) if row.state is None else (row.state.agl_m, row.state.yaw_rad)
        agl_m = float(agl) if agl else reported[0]
        yaw_rad = math.radians(float(yaw)) if yaw else reported[1]
        if agl_m is None or yaw_rad is None:
            raise SourceError(
                f"{flight}: frame {row.file} has neither a height nor a heading, which an autopilot reports"
            )
        found[row.file] = (agl_m, yaw_rad)
    return found


def _rate_hz(flight: Path, times_s: np.ndarray) -> float:
    steps_s = np.diff(times_s)
    step_s = float(np.median(steps_s))
    if np.abs(np.arange(len(times_s)) * step_s - times_s).max() > UNEVEN * step_s:
        raise SourceError(f"{flight}: its frames have no even rate, as those of a camera")
    return 1.0 / step_s
