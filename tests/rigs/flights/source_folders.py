"""Generated flight folders for the tests of the image sources."""

from collections.abc import Callable, Iterable
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np

from origins import origin_of
from terrafix.messages import Camera

WIDTH, HEIGHT = 320, 240
TOML = f"""
name = "generated"
map = "../maps/here.tif"
[camera]
width = {WIDTH}
height = {HEIGHT}
fx = 300
fy = 300.0
cx = 160.0
cy = 120.0
[start]
lat_deg = 48.0
lon_deg = 2.0
[telemetry]
yaw_sigma_deg = 3.0
[truth]
sigma_m = 4.0
anything = "else"
"""
HEADER = "file,t_s,yaw_deg,pitch_deg,roll_deg,agl_m"


def picture(seed: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """-> (H, W, 3) uint8 with texture everywhere."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 255, (height // 8, width // 8, 3), dtype=np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)


def source_of(shots: Callable[[], Iterable[object]]) -> Mock:
    """A live camera."""
    camera = Camera(width=WIDTH, height=HEIGHT, fx=300.0, fy=300.0, cx=160.0, cy=120.0)
    nothing = {"length.return_value": None, "map_hint.return_value": None, "facts.return_value": []}
    made = Mock(live=True, **nothing, **{"origin.return_value": origin_of(camera), "name.return_value": "camera"})
    made.shots.side_effect = lambda *_: iter(shots())
    return made


def jpeg(seed: int, width: int = WIDTH, height: int = HEIGHT) -> bytes:
    return cv2.imencode(".jpg", picture(seed, width, height))[1].tobytes()


def flight(folder: Path, frames: int = 5, *, toml: str = TOML, csv: str | None = None, step_s: float = 0.5) -> Path:
    """Writes a flight folder -> the folder. ``csv``: content of frames.csv, instead of one that fits the frames."""
    (folder / "frames").mkdir(parents=True)
    for i in range(frames):
        (folder / "frames" / f"{i:04}.jpg").write_bytes(jpeg(i))
    rows = [f"{i:04}.jpg,{i * step_s:.3f},{350 + i},,,{100 + i}" for i in range(frames)]
    (folder / "flight.toml").write_text(toml)
    (folder / "frames.csv").write_text(csv if csv is not None else "\n".join([HEADER, *rows]) + "\n")
    return folder


def some_frames(flight: Path, folder: Path, chosen: slice) -> Path:
    """-> a new flight folder with the ``chosen`` frames of a flight."""
    folder.mkdir()
    for entry in flight.iterdir():
        if entry.name != "frames.csv":
            (folder / entry.name).symlink_to(entry.resolve())
    header, *rows = (flight / "frames.csv").read_text(encoding="utf-8").splitlines()
    (folder / "frames.csv").write_text("\n".join([header, *rows[chosen]]) + "\n", encoding="utf-8")
    return folder
