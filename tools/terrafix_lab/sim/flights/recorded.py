"""`terrafix sim telemetry`: telemetry.tlog of a simulated autopilot along the true path of a recorded flight.

A smooth path is fitted to truth.csv, and an IMU, a barometer and a receiver are simulated along it, which gives real
frames inertial data. Roll and pitch of the real vehicle are not recorded: camera and inertial sensors are assumed to
be held level, as on a gimbal.
"""

import math
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from terrafix.core.errors import OutputError, SourceError
from terrafix.core.geodesy import LocalFrame
from terrafix.vision.sources.description import Description, read_description
from terrafix.vision.sources.table import read_table as read_frames
from terrafix_lab.sim.autopilot.lockstep import SimAutopilot
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.flights.log import T0_US, TelemetryLog
from terrafix_lab.sim.flights.path import STEP_S, FlownPath, fly
from terrafix_lab.sim.flights.smooth import Curve, smooth
from terrafix_lab.sim.interfaces import Navigation, State, navigation_of
from terrafix_lab.sim.sensors.clock import Clock
from terrafix_lab.sim.sensors.suite import VehicleSensors
from terrafix_lab.sim.vehicle.motion import Motion
from terrafix_tools.camera.description import write_toml
from terrafix_tools.estimates import number, read_table

MIN_FRAMES = 4  # least number of frames with truth for a fit
MAX_LEVEL_MPS2 = 6.0  # a small multirotor tilts by 30 degrees at most
MAX_CLIMB_MPS2 = 3.0
MAX_YAW_RADPS2 = math.radians(60.0)
COLUMNS = ("file", "lat_deg", "lon_deg", "agl_m", "yaw_deg")


@dataclass(frozen=True)
class Recorded:
    """The fitted path of a recorded flight. The ground height is constant, that of the start."""

    frame: LocalFrame
    ground_amsl_m: float
    level: Curve  # east, north
    height: Curve  # above ground
    yaw: Curve

    def path(self, duration_s: float) -> np.ndarray:
        """Returns (N, 7): east, north, up; velocity; yaw, every STEP_S from the first to the last sample."""
        t_s = np.arange(math.ceil(duration_s / STEP_S) + 1) * STEP_S
        level, height, yaw = (curve.at(t_s) for curve in (self.level, self.height, self.yaw))
        return np.column_stack([level[:, 0], height[:, 0] + self.ground_amsl_m, level[:, 1], height[:, 1], yaw[:, 0]])


class RailVehicle:
    """Implements ``Vehicle`` of interfaces.py on a fixed path."""

    def __init__(self, path: np.ndarray, ground_amsl_m: float) -> None:
        """``path``: array of ``Recorded.path``."""
        self._path, self._at = path.tolist(), 0
        e, n, up, ve, vn, vu, yaw = self._path[0]
        self._motion = Motion(
            lambda e_m, n_m: ground_amsl_m, e_m=e, n_m=n, up_m=up, velocity_enu_mps=(ve, vn, vu), yaw_rad=yaw
        )

    @property
    def state(self) -> State:
        return self._motion.state

    def step(self, dt_s: float, navigation: Navigation | None) -> State:
        """Moves along the path regardless of ``navigation``; stops at its end."""
        self._at = min(self._at + 1, len(self._path) - 1)
        _, _, _, ve, vn, vu, yaw = self._path[self._at]
        speed_mps = math.sqrt(ve * ve + vn * vn + vu * vu)
        return self._motion.move(dt_s, (ve, vn, vu), (yaw, 0.0, 0.0), speed_mps)


def read_recorded(flight: Path) -> tuple[Recorded, Description]:
    """Reads flight.toml, frames.csv and truth.csv of a folder. Raises SourceError, EvaluationError."""
    description = read_description(flight / "flight.toml")
    times = {row.file: row.t_ns / 1e9 for row in read_frames(flight / "frames.csv", "frames.csv", with_file=True)}
    path = flight / "truth.csv"
    rows: list[list[float]] = []
    for line, row in read_table(path, COLUMNS, "the path is fitted to the truth; give a flight that has one"):
        values = [number(path, line, name, row[name]) for name in COLUMNS[1:]]
        if row["file"] in times and None not in values:
            rows.append([times[row["file"]], *(v for v in values if v is not None)])
    if len(rows) < MIN_FRAMES:
        raise SourceError(
            f"{path}: {len(rows)} rows are complete and belong to a frame; at least {MIN_FRAMES} are needed"
        )
    t_s, lat_deg, lon_deg, agl_m, yaw_deg = np.array(sorted(rows)).T
    frame = LocalFrame(float(lat_deg[0]), float(lon_deg[0]))
    level_m = np.array([frame.to_local(float(a), float(b)) for a, b in zip(lat_deg, lon_deg, strict=True)])
    yaw_rad = np.unwrap(np.radians(yaw_deg))
    ground_amsl_m = 0.0
    if description.start is not None:
        ground_amsl_m = next(
            v for v in (description.start.ground_amsl_m, description.start.alt_amsl_m, 0.0) if v is not None
        )
    return Recorded(
        frame=frame,
        ground_amsl_m=ground_amsl_m,
        level=smooth(t_s, level_m, MAX_LEVEL_MPS2),
        height=smooth(t_s, agl_m[:, None], MAX_CLIMB_MPS2),
        yaw=smooth(t_s, yaw_rad[:, None], MAX_YAW_RADPS2),
    ), description


def fly_recorded(recorded: Recorded, *, seed: int) -> tuple[FlownPath, TelemetryLog]:
    """Simulates sensors and autopilot along the path, from time zero to the last sample."""
    duration_s = float(recorded.level.t_s[-1])
    vehicle = RailVehicle(recorded.path(duration_s), recorded.ground_amsl_m)
    sensors = VehicleSensors(recorded.frame, seed=seed, airspeed=False)
    autopilot = SimAutopilot(
        recorded.frame,
        Kind.COPTER,
        start=navigation_of(vehicle.state),
        home_amsl_m=recorded.ground_amsl_m,
        boot_ns=Clock.of(seed).boot_ns,
    )
    log = TelemetryLog(autopilot, T0_US)
    return fly(vehicle, sensors, duration_s, on_reading=log.step), log


def write_recorded(flight: Path, out: Path, *, seed: int) -> Recorded:
    """Writes a flight folder with the frames and the truth of ``flight``, and a simulated telemetry.tlog.

    Raises SourceError, EvaluationError, OutputError.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise OutputError(f"{out}: exists and is not an empty folder; choose another --out")
    recorded, description = read_recorded(flight)
    _, log = fly_recorded(recorded, seed=seed)
    try:
        _link(flight / "frames", out / "frames")
        shutil.copyfile(flight / "truth.csv", out / "truth.csv")
        rows = read_frames(flight / "frames.csv", "frames.csv", with_file=True)
        table = "\n".join(["file,t_s", *(f"{row.file},{row.t_ns / 1e9:.3f}" for row in rows)])
        (out / "frames.csv").write_text(table + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error}); choose another --out") from None
    log.write(out / "telemetry.tlog")
    map_path = str((flight / description.map).resolve()) if description.map else ""
    telemetry = msgspec.structs.replace(description.telemetry, tlog_t0_us=T0_US)
    description = msgspec.structs.replace(description, map=map_path, telemetry=telemetry)
    write_toml(out / "flight.toml", description, "Real frames; the telemetry is simulated from their truth.")
    return recorded


def _link(frames: Path, into: Path) -> None:
    """Hard-links the images if the file system allows it, otherwise copies them."""
    into.mkdir(parents=True)
    for image in sorted(frames.iterdir()):
        try:
            os.link(image.resolve(), into / image.name)
        except OSError:
            shutil.copyfile(image, into / image.name)
