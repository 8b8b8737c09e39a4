"""`terrafix init`: configuration, camera description, parameters of the autopilot and checklist of one vehicle."""

import json
import math
import shutil
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from terrafix.core.config import load
from terrafix.core.errors import OutputError, UsageError
from terrafix.core.installed_files import installed_files
from terrafix.messages import Camera
from terrafix.vision.sources.description import FOCAL_SIGMA, camera_of, read_description
from terrafix_tools.camera.describe import describe, parse_size
from terrafix_tools.configuration.schema import CAMERA, CONFIG, NAMES, write_all
from terrafix_tools.installation import command, docs_page

CONFIG_FILE, CAMERA_FILE, PARAMETERS, CHECKLIST = "config.toml", "camera.toml", "autopilot.param", "CHECKLIST.md"


class Vehicle(StrEnum):
    """What flies, and whether the autopilot keeps a GNSS receiver beside Terrafix."""

    COPTER = "copter"
    PLANE = "plane"
    SECOND_GPS = "second-gps"  # ArduPilot with its receiver as first GPS
    PX4 = "px4"


@dataclass(frozen=True)
class FirstAnswers:
    """``camera``: address of the camera. ``lens``: a camera description, or "" for ``size`` and ``fov_deg``."""

    vehicle: Vehicle
    camera: str
    link: str
    map_path: str = ""
    lens: str = ""
    size: str = ""
    fov_deg: float = 0.0


def write_first_files(folder: Path, answers: FirstAnswers) -> list[Path]:
    """Writes the files, none of which may exist, and returns them. Raises UsageError, SourceError, OutputError."""
    files = [folder / name for name in (CONFIG_FILE, CAMERA_FILE, CHECKLIST)]
    files += [folder / PARAMETERS] if answers.vehicle is not Vehicle.PX4 else []
    there = [str(path) for path in files if path.exists()]
    if there:
        raise UsageError(f"{', '.join(there)}: exists, and is not overwritten; name another folder, or move it away")
    camera = _camera(answers)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_all(folder / "schema")
        list(describe(folder / CAMERA_FILE, camera, "camera", [_lens_note(answers)]))
        _with_schema(folder / CAMERA_FILE, CAMERA)
        (folder / CONFIG_FILE).write_text(_config(folder, answers), encoding="utf-8")
        _with_schema(folder / CONFIG_FILE, CONFIG)
        (folder / CHECKLIST).write_text(_checklist(folder, answers), encoding="utf-8")
        if answers.vehicle is not Vehicle.PX4:
            shutil.copy(installed_files() / "config" / "vehicles" / f"{answers.vehicle}.param", folder / PARAMETERS)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error.strerror}); choose another folder") from None
    load([folder / CONFIG_FILE])
    return files


def _camera(answers: FirstAnswers) -> Camera:
    """Raises UsageError, SourceError."""
    if answers.lens:
        return camera_of(Path(answers.lens), read_description(Path(answers.lens)))
    size = parse_size(answers.size)
    if size is None or not 10 <= answers.fov_deg <= 150:
        raise UsageError(
            f"--size {answers.size or '(none)'} --fov {answers.fov_deg:g}: give the size in pixels, such as 1280x720, "
            "and the horizontal field of view in degrees, 10 to 150; or --lens with a camera description"
        )
    width, height = size
    focal_px = round(width / 2 / math.tan(math.radians(answers.fov_deg) / 2), 2)
    return Camera(
        width=width,
        height=height,
        fx=focal_px,
        fy=focal_px,
        cx=(width - 1) / 2,
        cy=(height - 1) / 2,
        focal_sigma=FOCAL_SIGMA,
    )


def _lens_note(answers: FirstAnswers) -> str:
    if answers.lens:
        return f"from {answers.lens}"
    return f"field of view {answers.fov_deg:g} degrees, nominal: calibrate with '{command()} camera calibrate'"


def _with_schema(path: Path, kind: str) -> None:
    path.write_text(f"#:schema schema/{NAMES[kind]}\n{path.read_text(encoding='utf-8')}", encoding="utf-8")


def _config(folder: Path, answers: FirstAnswers) -> str:
    """Strings of JSON are valid TOML."""

    def text(value: object) -> str:
        return json.dumps(str(value), ensure_ascii=False)

    return (
        f"# Paths are relative to the folder in which Terrafix is started. Every key: {command()} config keys\n"
        f"[map]\npath = {text(answers.map_path)}\n\n"
        f"[source]\npath = {text(answers.camera)}\ncamera = {text(folder / CAMERA_FILE)}\n\n"
        f"[link]\ndevice = {text(answers.link)}\n"
        + ("gps_id = 1  # the second receiver of the autopilot\n" if answers.vehicle is Vehicle.SECOND_GPS else "")
    )


def _checklist(folder: Path, answers: FirstAnswers) -> str:
    run, config = command(), folder / CONFIG_FILE
    firmware = answers.vehicle is not Vehicle.PX4
    steps = [
        f"Practise: `{run} preflight --simulate {answers.vehicle} --config {config}`; one parameter is wrong."
        if firmware
        else f"The camera and its image: `{run} camera show {answers.camera} --camera {folder / CAMERA_FILE}`.",
        f"The lens is {'described' if answers.lens else 'nominal'}. Calibrate it: `{run} camera calibrate`, then "
        f"`{run} config check {config}` ({docs_page('camera.md')}).",
        f"The map covers the whole route: `{run} map check {answers.map_path or 'MAP.gpkg'}`"
        + ("" if answers.map_path else "; write its path into `[map] path`")
        + f" ({docs_page('map-package.md')}).",
        f"Parameters of the autopilot: load `{folder / PARAMETERS}` with the ground station, restart."
        if firmware
        else f"Parameters of PX4: {docs_page('autopilot.md')}.",
        f"At the vehicle, motors off: `{run} preflight --config {config} --mission PLAN` without FAIL"
        + ("." if firmware else ", but for what it asks of an ArduPilot: it does not know the parameters of PX4."),
        f"On the ground, sky covered: `{run} run --config {config} --out out/ground`; the pilot sees GPS of Terrafix.",
        "First flights: a receiver stays first, Terrafix second (`second-gps`); another person can take over by hand.",
        f"After each flight: `{run} report out/FLIGHT`, `{run} log autopilot out/FLIGHT LOG.bin`.",
    ]
    return f"# Checklist: {answers.vehicle}\n\n" + "".join(f"- [ ] {step}\n" for step in steps)
