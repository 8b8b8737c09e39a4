"""A flight over a generated world, written as a flight folder: pictures, what an autopilot reports, the truth."""

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from pyproj import CRS

from terrafix import messages as m
from terrafix.core.camera import Mount
from terrafix.core.errors import OutputError
from terrafix.core.geodesy import LocalFrame
from terrafix_tools.sim.render import Film, Ground, Renderer, drape
from terrafix_tools.sim.trajectory import Sensors, State, Trajectory
from terrafix_tools.sim.world import EPSG, World

CAMERA = m.Camera(width=960, height=540, fx=560.0, fy=560.0, cx=479.5, cy=269.5, mount_tolerance_deg=1.0)
FRAME_HZ = 2.0
JPEG_QUALITY = 92
EDGE_M = 380.0  # the course keeps this far from the edge of the image: the view reaches 250 m to the side
CORNERS = 10  # of the course
START_SIGMA_M = 25.0
START_ERROR_M = 12.0  # 1-sigma of what the start coordinate is really off, smaller than it claims
YAW_SIGMA_DEG = 3.0
AGL_SIGMA_M = 3.0
ATTITUDE_SIGMA_DEG = 0.7

Progress = Callable[[int, int], None]  # frames done, frames in all


@dataclass(frozen=True)
class Flight:
    """Everything about a simulated flight that is not a picture."""

    frame: LocalFrame
    ground: Ground
    trajectory: Trajectory
    sensors: Sensors
    start_wgs84: tuple[float, float]  # what the pilot says: near the position at time zero
    ground_amsl_m: float  # under the start: the zero of the reported height
    duration_s: float

    def frame_times_s(self) -> np.ndarray:
        """Times of the pictures, from zero."""
        return np.arange(round(self.duration_s * FRAME_HZ)) / FRAME_HZ

    def camera_pose(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """-> p_c_in_w_m (3,), R_w_c (3, 3)"""
        return state.p_b_in_w_m, state.r_w_b() @ Mount(
            CAMERA.mount_yaw_deg, CAMERA.mount_pitch_deg, CAMERA.mount_roll_deg
        ).r_b_c()


def plan_flight(world: World, camera_look_bgr: np.ndarray, duration_s: float) -> Flight:
    """A course around the world in the season of ``camera_look_bgr``."""
    rng = np.random.default_rng([world.seed, 41])
    layout = world.layout
    middle, reach = (
        np.array([layout.width_m, layout.height_m]) / 2,
        np.array([layout.width_m, layout.height_m]) / 2 - EDGE_M,
    )
    turn = np.arange(CORNERS) / CORNERS * 2 * math.pi + rng.uniform(0, 2 * math.pi)
    size = np.where(np.arange(CORNERS) % 2 == 0, 1.0, 0.55)[:, None] * rng.uniform(0.92, 1.0, (CORNERS, 1))
    course_m = middle + np.stack([np.cos(turn), np.sin(turn)], axis=1) * reach * size
    frame = LocalFrame(*world.wgs84(float(course_m[0, 0]), float(course_m[0, 1])))
    ground = drape(camera_look_bgr, world.utm_from_px, world.dem_amsl_m, world.utm_from_dem, CRS.from_epsg(EPSG), frame)
    corners = np.array([frame.to_local(*world.wgs84(float(x), float(y))) for x, y in course_m])

    def height(e_m: float, n_m: float) -> float:
        return float(ground.height_amsl_m(np.array([[e_m]]), np.array([[n_m]]))[0, 0])

    trajectory = Trajectory(corners, height, duration_s, seed=world.seed)
    e_m, n_m = trajectory.state(0.0).p_b_in_w_m[:2] + rng.normal(0.0, START_ERROR_M, 2)
    start_amsl_m = height(float(e_m), float(n_m))
    sensors = Sensors(trajectory, start_amsl_m, seed=world.seed)
    start = frame.to_wgs84(float(e_m), float(n_m))
    return Flight(frame, ground, trajectory, sensors, start, start_amsl_m, duration_s)


def write_flight(
    folder: Path, flight: Flight, map_name: str, *, seed: int, telemetry: bool = True, progress: Progress | None = None
) -> None:
    """The flight folder. ``telemetry=False``: attitude and height come over MAVLink, frames.csv has only times.

    ``map_name`` is relative to the folder. Raises OutputError."""
    renderer = Renderer(flight.ground, CAMERA, film=Film(), seed=seed)
    times = flight.frame_times_s()
    said, truth = [], []
    try:
        (folder / "frames").mkdir(parents=True, exist_ok=True)
        for i, t_s in enumerate(times.tolist()):
            state = flight.trajectory.state(t_s)
            name = f"{i + 1:04d}.jpg"
            image = renderer.frame(*flight.camera_pose(state), i)
            _write_jpeg(folder / "frames" / name, image)
            said.append([name, f"{t_s:.3f}"])
            lat_deg, lon_deg = flight.frame.to_wgs84(float(state.p_b_in_w_m[0]), float(state.p_b_in_w_m[1]))
            yaw_deg = math.degrees(state.yaw_rad) % 360.0
            truth.append([name, f"{lat_deg:.7f}", f"{lon_deg:.7f}", f"{state.agl_m:.2f}", f"{yaw_deg:.2f}"])
            if progress:
                progress(i + 1, len(times))
        _write_csv(folder / "frames.csv", ["file", "t_s"], said)
        _write_csv(folder / "truth.csv", ["file", "lat_deg", "lon_deg", "agl_m", "yaw_deg"], truth)
        (folder / "flight.toml").write_text(_toml(flight, map_name), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error}); choose another --out") from None
    if telemetry:
        add_telemetry(folder, flight)


def add_telemetry(folder: Path, flight: Flight) -> None:
    """Into frames.csv what the autopilot says of attitude and height: the folder can be replayed without it.

    Raises OutputError."""
    path = folder / "frames.csv"
    try:
        with path.open(newline="", encoding="utf-8") as file:
            frames = [(row["file"], row["t_s"]) for row in csv.DictReader(file)]
        rows = [[name, t_s, *_telemetry(flight, float(t_s))] for name, t_s in frames]
        _write_csv(path, ["file", "t_s", "yaw_deg", "pitch_deg", "roll_deg", "agl_m"], rows)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error}); choose another --out") from None


def _telemetry(flight: Flight, t_s: float) -> list[str]:
    said = flight.sensors.report(t_s)
    angles = (math.degrees(said.yaw_rad) % 360.0, math.degrees(said.pitch_rad), math.degrees(said.roll_rad))
    return [*(f"{a:.2f}" for a in angles), f"{said.agl_m:.2f}"]


def _write_jpeg(path: Path, image: np.ndarray) -> None:
    path.write_bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes())


def _write_csv(path: Path, columns: list[str], rows: list[list[str]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)


def _toml(flight: Flight, map_name: str) -> str:
    camera = CAMERA
    return f'''# A flight over a generated world: nothing in it is real.
name = "generated"
map = "{map_name}"
[camera]
model = "pinhole"
width = {camera.width}
height = {camera.height}
fx = {camera.fx}
fy = {camera.fy}
cx = {camera.cx}
cy = {camera.cy}
distortion = {list(camera.distortion)}
[mount]                    # fixed to the body, straight down, image top forward
yaw_deg = {camera.mount_yaw_deg}
pitch_deg = {camera.mount_pitch_deg}
roll_deg = {camera.mount_roll_deg}
tolerance_deg = {camera.mount_tolerance_deg}
[start]
lat_deg = {flight.start_wgs84[0]:.7f}
lon_deg = {flight.start_wgs84[1]:.7f}
ground_amsl_m = {flight.ground_amsl_m:.1f}
sigma_m = {START_SIGMA_M}
[telemetry]                # agl_m counts from the ground at the start
yaw_sigma_deg = {YAW_SIGMA_DEG}
agl_sigma_m = {AGL_SIGMA_M}
attitude_sigma_deg = {ATTITUDE_SIGMA_DEG}
[truth]
sigma_m = 0.0
'''
