"""A simulated flight in open loop, written as a flight folder.

The vehicle flies on the truth; ``telemetry.tlog`` is the telemetry of its autopilot, with sensor errors.
"""

import csv
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import msgspec
import numpy as np

from terrafix import messages as m
from terrafix.core.errors import OutputError, SourceError, UsageError
from terrafix.core.geodesy import LocalFrame
from terrafix.vision.sources.description import (
    CameraTable,
    Description,
    MountTable,
    StartTable,
    TelemetryTable,
)
from terrafix_lab.sim.autopilot.lockstep import SimAutopilot
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.camera.mount import CameraMount, mount_of
from terrafix_lab.sim.camera.render import Film, Ground, Renderer
from terrafix_lab.sim.flights.log import T0_US, TelemetryLog
from terrafix_lab.sim.flights.path import FlownPath, fly
from terrafix_lab.sim.flights.scene import Scene, scene_of_world
from terrafix_lab.sim.interfaces import State, navigation_of
from terrafix_lab.sim.sensors.clock import Clock
from terrafix_lab.sim.sensors.gnss_events import AnyEvent
from terrafix_lab.sim.sensors.suite import VehicleSensors
from terrafix_lab.sim.vehicle.copter import Copter
from terrafix_lab.sim.vehicle.plane import Plane
from terrafix_lab.sim.vehicle.wind import BREEZE, Wind
from terrafix_lab.sim.world.place import World
from terrafix_tools.camera.description import write_toml
from terrafix_tools.mission.course import course
from terrafix_tools.mission.items import Mission, check

CAMERA = m.Camera(
    width=960, height=540, fx=560.0, fy=560.0, cx=479.5, cy=269.5, focal_sigma=0.01, mount_tolerance_deg=1.0
)
ON_GIMBAL = msgspec.structs.replace(CAMERA, gimbal=m.Gimbal())
FRAME_HZ = 2.0
JPEG_QUALITY = 92
AGL_M = 130.0
EDGE_MARGIN_PER_AGL = 1.3  # distance of the course from the edge of the image, in heights: the camera's reach
TURN_ROOM_M = {Kind.PLANE: 120.0, Kind.COPTER: 10.0}  # additional distance, for turns outside their corner
MAX_DURATION_S = 3600.0
EXTRA_S = 20.0  # flown beyond the end, for a consumer that lags behind in real time
START_SIGMA_M = 25.0
START_ERROR_M = 12.0  # 1-sigma of the true error of the start coordinate, smaller than the stated one
YAW_SIGMA_DEG = 3.0
AGL_SIGMA_M = 3.0
ATTITUDE_SIGMA_DEG = 0.7

Progress = Callable[[int, int], None]  # frames done, frames in total


@dataclass(frozen=True)
class Flight:
    """A simulated flight without its images."""

    kind: Kind
    frame: LocalFrame
    ground: Ground
    mission: Mission
    path: FlownPath
    telemetry: TelemetryLog
    start_wgs84: tuple[float, float]  # start given by the pilot: near the position at time zero
    ground_amsl_m: float  # under the start: zero of the reported height
    duration_s: float
    frame_hz: float = FRAME_HZ  # of the camera
    camera: m.Camera = CAMERA

    def frame_times_s(self) -> np.ndarray:
        """Exposure times, from zero."""
        return np.arange(math.floor(self.duration_s * self.frame_hz + 1e-6)) / self.frame_hz

    @property
    def mount(self) -> CameraMount:
        return mount_of(self.camera)

    def camera_pose(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Returns p_c_in_w_m (3,) and R_w_c (3, 3)."""
        return state.p_b_in_w_m, self.mount.r_w_c(state)


def plan_flight(
    place: World,
    camera_image_bgr: np.ndarray,
    duration_s: float,
    frame_hz: float = FRAME_HZ,
    camera: m.Camera = CAMERA,
) -> Flight:
    """Plans a fixed-wing flight on a closed course over a generated place, in the season of ``camera_image_bgr``."""
    scene = scene_of_world(place, camera_image_bgr)
    return replace(flight_over(scene, seed=place.seed, duration_s=duration_s, camera=camera), frame_hz=frame_hz)


def mission_over(
    scene: Scene, kind: Kind, *, seed: int, length_m: float, agl_m: float, from_ground: bool = False
) -> Mission:
    """Returns a closed course inside the scene; ``from_ground``: with take-off and landing. Raises UsageError: no
    room.
    """
    box = scene.box.shrunk(EDGE_MARGIN_PER_AGL * agl_m + TURN_ROOM_M[kind])
    return course(seed, length_m, box, scene.frame, agl_m=agl_m, from_ground=from_ground)


def flight_over(
    scene: Scene,
    kind: Kind = Kind.PLANE,
    *,
    seed: int,
    mission: Mission | None = None,
    agl_m: float = AGL_M,
    duration_s: float | None = None,
    events: Sequence[AnyEvent] = (),
    wind: Wind = BREEZE,
    camera: m.Camera = CAMERA,
) -> Flight:
    """Flies ``mission`` (None: a generated course of sufficient length) for ``duration_s`` (None: until it is
    complete).

    Raises UsageError, SourceError when duration or mission cannot be flown.
    """
    if duration_s is not None and not 0.0 < duration_s <= MAX_DURATION_S:
        raise UsageError(f"--duration {duration_s:g}: choose more than 0 and at most {MAX_DURATION_S:g} seconds")
    if mission is None:
        mission = mission_over(scene, kind, seed=seed, length_m=30.0 * (duration_s or 200.0), agl_m=agl_m)
    check(mission, scene.frame, scene.box)
    height = scene.height()
    vehicle = (Plane if kind is Kind.PLANE else Copter)(mission, scene.frame, height, wind=wind, seed=seed)
    first = vehicle.state
    ground_amsl_m = float(first.p_b_in_w_m[2]) - first.agl_m
    sensors = VehicleSensors(scene.frame, seed=seed, events=events, airspeed=kind is Kind.PLANE, mount=mount_of(camera))
    navigation = None if mission.starts_on_ground() else navigation_of(first)
    autopilot = SimAutopilot(
        scene.frame,
        kind,
        start=navigation,
        home_amsl_m=ground_amsl_m if navigation else None,
        boot_ns=Clock.of(seed).boot_ns,
    )
    log = TelemetryLog(autopilot, T0_US)
    until = (lambda: False) if duration_s is not None else (lambda: vehicle.finished)
    path = fly(vehicle, sensors, (duration_s or MAX_DURATION_S) + EXTRA_S, until=until, on_reading=log.step)
    if vehicle.crashed:
        raise SourceError(
            f"{mission.name}: the vehicle flew into the ground after {vehicle.state.t_s:.0f} s; raise the heights, or "
            "use heights above the ground below"
        )
    start = first.p_b_in_w_m[:2] + np.random.default_rng([seed, 42]).normal(0.0, START_ERROR_M, 2)
    return Flight(
        kind=kind,
        frame=scene.frame,
        ground=scene.ground,
        mission=mission,
        path=path,
        telemetry=log,
        start_wgs84=scene.frame.to_wgs84(float(start[0]), float(start[1])),
        ground_amsl_m=ground_amsl_m,
        duration_s=duration_s or path.duration_s,
        camera=camera,
    )


def write_flight(
    folder: Path, flight: Flight, map_name: str, *, seed: int, telemetry: bool = True, progress: Progress | None = None
) -> None:
    """Writes the flight folder. ``telemetry=False``: no telemetry.tlog, attitude and height come over MAVLink.

    ``map_name`` is relative to the folder. Raises OutputError.
    """
    film = Film(readout_s=flight.camera.readout_s or 0.0)
    renderer = Renderer(flight.ground, flight.camera, film=film, seed=seed)
    times = flight.frame_times_s()
    frame_rows, truth = [], []
    try:
        (folder / "frames").mkdir(parents=True, exist_ok=True)
        for i, t_s in enumerate(times.tolist()):
            state = flight.path.state(t_s)
            name = f"{i + 1:04d}.jpg"
            _write_jpeg(
                folder / "frames" / name,
                renderer.frame(*flight.camera_pose(state), i, motion=flight.mount.motion(state)),
            )
            frame_rows.append([name, f"{t_s:.3f}"])
            truth.append([name, *truth_row(flight.frame, state)])
            if progress:
                progress(i + 1, len(times))
        write_csv(folder / "frames.csv", ["file", "t_s"], frame_rows)
        write_csv(folder / "truth.csv", ["file", "lat_deg", "lon_deg", "agl_m", "yaw_deg"], truth)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error}); choose another --out") from None
    write_toml(folder / "flight.toml", _describe(flight, map_name), "A simulated flight.")
    if telemetry:
        add_telemetry(folder, flight)


def add_telemetry(folder: Path, flight: Flight) -> None:
    """Writes telemetry.tlog into the folder. Raises OutputError."""
    flight.telemetry.write(folder / "telemetry.tlog")


def truth_row(frame: LocalFrame, state: State) -> list[str]:
    """Returns the cells of truth.csv after the file name."""
    lat_deg, lon_deg = frame.to_wgs84(float(state.p_b_in_w_m[0]), float(state.p_b_in_w_m[1]))
    yaw_deg = math.degrees(state.yaw_rad) % 360.0
    return [f"{lat_deg:.7f}", f"{lon_deg:.7f}", f"{state.agl_m:.2f}", f"{yaw_deg:.2f}"]


def write_csv(path: Path, columns: list[str], rows: list[list[str]]) -> None:
    """Writes a CSV file. Raises OSError."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)


def _write_jpeg(path: Path, image: np.ndarray) -> None:
    path.write_bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes())


def _describe(flight: Flight, map_name: str) -> Description:
    lat_deg, lon_deg = (round(v, 7) for v in flight.start_wgs84)
    c = flight.camera
    return Description(
        name=f"simulated {flight.kind}",
        map=map_name,
        camera=CameraTable.of(c),
        mount=MountTable.of(c),
        start=StartTable(
            lat_deg=lat_deg, lon_deg=lon_deg, ground_amsl_m=round(flight.ground_amsl_m, 1), sigma_m=START_SIGMA_M
        ),
        telemetry=TelemetryTable(
            yaw_sigma_deg=YAW_SIGMA_DEG,
            agl_sigma_m=AGL_SIGMA_M,
            attitude_sigma_deg=ATTITUDE_SIGMA_DEG,
            tlog_t0_us=T0_US,
        ),
        truth={"sigma_m": 0.0},
    )
