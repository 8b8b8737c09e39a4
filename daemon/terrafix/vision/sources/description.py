"""flight.toml and camera descriptions: camera, mount, initial position, accuracy of the telemetry.

The same format serves ``flight.toml`` in a flight folder, the sidecar of a video, and a camera description in
``config/cameras`` (without [start]). Parsing is strict: an unknown key is an error that names the closest key."""

import difflib
import math
import re
import tomllib
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from msgspec import UNSET, Meta, UnsetType

from terrafix.core.errors import SourceError
from terrafix.core.toml_file import read_toml
from terrafix.messages import Camera, Gimbal, Origin, VehicleState
from terrafix.vision.sources.fisheye import FULL_FOV_DEG, FisheyeCamera, view_of
from terrafix.vision.sources.plausible import check_camera, check_centre

if TYPE_CHECKING:
    from terrafix.core.autopilot_log.own_log import OwnLog
    from terrafix.core.mavlink.tlog import TelemetryLog

START_SIGMA_M = 10.0  # a coordinate from a map or a phone before take-off
YAW_SIGMA_DEG = 5.0  # compass of a small multirotor near its motors
AGL_SIGMA_M = 5.0  # barometer drift over a flight, and terrain relief relative to the take-off point
LOG_SUFFIXES = (".tlog", ".bin", ".BIN", ".log", ".ulg")  # of logs beside a flight: of a ground station, ArduPilot, PX4
ATTITUDE_SIGMA_DEG = 2.0  # EKF attitude under acceleration
# Relative 1-sigma of the focal length: calibrated (a calibration also gives distortion), and nominal. A wide-angle lens
# that was described by its field of view as a pinhole was 30 % off in a public data set.
CALIBRATED_FOCAL_SIGMA, FOCAL_SIGMA = 0.01, 0.1
DISTORTION_LENGTHS = (0, 4, 5, 8, 12, 14)  # accepted by OpenCV's projectPoints
FISHEYE_LENGTH = 4  # of cv2.fisheye
NO_OMNIDIRECTIONAL = (
    "omnidirectional lenses (omni, MEI, Scaramuzza's ocam, double sphere, EUCM) are not supported; calibrate the "
    "lens as fisheye (Kalibr: pinhole-equi; OpenCV: cv2.fisheye; or `terrafix camera calibrate --model fisheye`)"
)

Positive = Annotated[float, Meta(gt=0)]
Degrees = Annotated[float, Meta(ge=-360, le=360)]


class _Table(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    pass


class CameraTable(_Table, frozen=True, kw_only=True):
    """All lengths in pixels of the stored frames; the middle of the first pixel is 0, 0."""

    width: Annotated[int, Meta(ge=16, le=65_535)]
    height: Annotated[int, Meta(ge=16, le=65_535)]
    fx: Positive
    fy: Positive
    cx: float
    cy: float
    model: Literal["pinhole", "fisheye"] = "pinhole"
    distortion: tuple[float, ...] = ()
    focal_sigma: Annotated[float, Meta(gt=0, le=0.5)] | None = None
    fov_deg: Annotated[float, Meta(gt=0, le=360)] | None = (
        None  # circle that a fisheye images, if smaller than the image
    )
    # Rolling shutter: from the exposure of the first row to that of the last; negative: the last row is first
    readout_ms: Annotated[float, Meta(ge=-200, le=200)] = 0.0

    @classmethod
    def of(cls, camera: Camera) -> "CameraTable":
        """The table that describes this camera."""
        return cls(
            width=camera.width,
            height=camera.height,
            fx=camera.fx,
            fy=camera.fy,
            cx=camera.cx,
            cy=camera.cy,
            distortion=camera.distortion,
            focal_sigma=camera.focal_sigma,
            model="fisheye" if isinstance(camera, FisheyeCamera) else "pinhole",
            fov_deg=camera.fov_deg if isinstance(camera, FisheyeCamera) and camera.fov_deg < FULL_FOV_DEG else None,
            readout_ms=1e3 * (camera.readout_s or 0.0),
        )


class MountTable(_Table, frozen=True, kw_only=True):
    yaw_deg: Degrees = 0.0
    pitch_deg: Degrees = -90.0
    roll_deg: Degrees = 0.0
    tolerance_deg: Annotated[float, Meta(gt=0, le=90)] = 5.0
    gimbal: Literal["mavlink", "auto", "none"] | None = None  # None: "auto" where the file has no [mount]
    gimbal_device: Annotated[int, Meta(ge=0, le=255)] = 0  # gimbal_device_id or component id; 0: the first heard
    stabilised: tuple[Literal["roll", "pitch"], ...] = ("roll", "pitch")

    @classmethod
    def of(cls, camera: Camera) -> "MountTable":
        """The table that describes the mount of this camera."""
        gimbal = camera.gimbal if isinstance(camera.gimbal, Gimbal) else Gimbal()
        return cls(
            gimbal=None if camera.gimbal is UNSET else "mavlink" if gimbal.required else "auto",
            gimbal_device=gimbal.device,
            stabilised=gimbal.stabilised,  # type: ignore[arg-type]
            yaw_deg=camera.mount_yaw_deg,
            pitch_deg=camera.mount_pitch_deg,
            roll_deg=camera.mount_roll_deg,
            tolerance_deg=camera.mount_tolerance_deg,
        )


class StartTable(_Table, frozen=True, kw_only=True):
    lat_deg: Annotated[float, Meta(ge=-90, le=90)]
    lon_deg: Annotated[float, Meta(ge=-180, le=180)]
    ground_amsl_m: Annotated[float, Meta(ge=-500, le=9000)] | None = None
    alt_amsl_m: Annotated[float, Meta(ge=-500, le=9000)] | None = None  # alias of ground_amsl_m
    sigma_m: Annotated[float, Meta(gt=0, le=100_000)] = START_SIGMA_M


class TelemetryTable(_Table, frozen=True, kw_only=True):
    yaw_sigma_deg: Positive = YAW_SIGMA_DEG
    agl_sigma_m: Positive = AGL_SIGMA_M
    attitude_sigma_deg: Positive | None = None  # ATTITUDE_SIGMA_DEG, or what the source assumes
    tlog_t0_us: int | None = None  # UNIX microseconds of t_s = 0; absent: time of the first record of the log
    log_zero_s: float | None = None  # t_s = 0 on the clock of the autopilot's own log; absent: by the attitudes
    system_id: Annotated[int, Meta(ge=0, le=255)] = 0  # vehicle of the log; 0: the only one, or the only one that moves


class Description(_Table, frozen=True, kw_only=True):
    """A whole file. ``truth`` is for the evaluation and is not read."""

    version: Literal[1] = 1
    name: str = ""
    description: str = ""
    source: str = ""
    licence: str = ""
    license: str = ""
    map: str = ""
    camera: CameraTable | None = None
    mount: MountTable = MountTable(gimbal="auto")
    start: StartTable | None = None
    telemetry: TelemetryTable = TelemetryTable()
    truth: dict[str, Any] = {}


def read_description(path: Path) -> Description:
    """Reads and validates a file. Raises SourceError: missing or broken file, unknown key, value out of bounds."""
    try:
        table = read_toml(path)
    except FileNotFoundError:
        raise SourceError(f"{path}: no such file; docs/flight-folder.md shows what belongs in it") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{path}: cannot be read ({error})") from None
    except tomllib.TOMLDecodeError as error:
        raise SourceError(f"{path}: not valid TOML ({error})") from None
    try:
        description = msgspec.convert(table, Description)
    except msgspec.ValidationError as error:
        raise SourceError(f"{path}: {_explain(str(error))}") from None
    _check_numbers(path, table)
    camera = description.camera
    if camera and camera.model == "fisheye" and len(camera.distortion) != FISHEYE_LENGTH:
        raise SourceError(
            f"{path}: [camera] distortion has {len(camera.distortion)} numbers; a fisheye has k1, k2, k3, k4"
        )
    if camera and camera.model == "fisheye" and camera.width / camera.fx > math.tau:
        raise SourceError(
            f"{path}: [camera] fx = {camera.fx:g} and {camera.width} px of a fisheye are more than half a turn off the "
            "axis; give the focal length in pixels of the stored frames"
        )
    if camera and camera.model == "pinhole" and camera.fov_deg is not None:
        raise SourceError(f'{path}: [camera] fov_deg is for model = "fisheye"; leave it out')
    if camera and len(camera.distortion) not in DISTORTION_LENGTHS:
        raise SourceError(
            f"{path}: [camera] distortion has {len(camera.distortion)} numbers; OpenCV takes 0, 4, 5, 8, 12 or 14"
        )
    if camera:
        check_centre(path, camera)
    if description.start and description.start.ground_amsl_m is not None and description.start.alt_amsl_m is not None:
        raise SourceError(f"{path}: [start] has both ground_amsl_m and alt_amsl_m; they mean the same, keep one")
    return description


def camera_of(path: Path, description: Description) -> Camera:
    """Camera of the stored images, and mount, of the description in ``path``; a FisheyeCamera of a fisheye.

    Raises SourceError: no [camera], or implausible values."""
    if description.camera is None:
        raise SourceError(f"{path}: there is no [camera]; add one with width, height, fx, fy, cx, cy in pixels")
    c = description.camera
    circle = FULL_FOV_DEG if c.fov_deg is None else c.fov_deg
    kind = partial(FisheyeCamera, fov_deg=circle) if c.model == "fisheye" else Camera
    camera = kind(
        width=c.width,
        height=c.height,
        fx=c.fx,
        fy=c.fy,
        cx=c.cx,
        cy=c.cy,
        distortion=c.distortion,
        focal_sigma=c.focal_sigma or (CALIBRATED_FOCAL_SIGMA if c.distortion else FOCAL_SIGMA),
        readout_s=1e-3 * c.readout_ms or UNSET,
    )
    return with_mount(path, camera, description.mount)


def with_mount(path: Path, camera: Camera, mount: MountTable) -> Camera:
    """``camera`` on ``mount``. Raises SourceError: implausible values of either; ``path``: where they come from."""
    mounted = msgspec.structs.replace(
        camera,
        mount_yaw_deg=mount.yaw_deg,
        mount_pitch_deg=mount.pitch_deg,
        mount_roll_deg=mount.roll_deg,
        mount_tolerance_deg=mount.tolerance_deg,
        gimbal=_gimbal(mount),
    )
    check_camera(path, view_of(mounted))
    return mounted


def _gimbal(mount: MountTable) -> Gimbal | UnsetType:
    if mount.gimbal in (None, "none"):
        return UNSET
    return Gimbal(
        required=mount.gimbal == "mavlink", device=mount.gimbal_device, stabilised=tuple(sorted(set(mount.stabilised)))
    )


def origin_of(
    description: Description,
    camera: Camera,
    start: tuple[float, float] | None,
    attitude_sigma_deg: float = ATTITUDE_SIGMA_DEG,
) -> Origin:
    """The flight's Origin at t 0. ``start`` (lat_deg, lon_deg) overrides [start]; without both, the initial position is
    unknown (infinite sigma, ``core.initial_position``). ``attitude_sigma_deg``: where [telemetry] does not state it."""
    stated, ground_m = description.start, None
    lat_deg, lon_deg = start or ((stated.lat_deg, stated.lon_deg) if stated else (0.0, 0.0))
    if stated:
        ground_m = stated.alt_amsl_m if stated.ground_amsl_m is None else stated.ground_amsl_m
    return Origin(
        t_ns=0,
        camera=camera,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        ground_amsl_m=ground_m,
        start_sigma_m=stated.sigma_m if stated else START_SIGMA_M if start else math.inf,
        yaw_sigma_deg=description.telemetry.yaw_sigma_deg,
        agl_sigma_m=description.telemetry.agl_sigma_m,
        attitude_sigma_deg=description.telemetry.attitude_sigma_deg or attitude_sigma_deg,
    )


def telemetry_log(
    stem: Path, description: Description, states: Sequence[VehicleState] = (), frames_s: Sequence[float] = ()
) -> "TelemetryLog | OwnLog | None":
    """The log beside a flight: ``stem`` with one of LOG_SUFFIXES; None: there is none. Zero and vehicle are those that
    the description states. The clock of an autopilot's own log is aligned by ``states``, those of the frames, or by
    their stamps ``frames_s``.

    Raises SourceError: it cannot be used, or there are several."""
    found = [stem.with_suffix(suffix) for suffix in LOG_SUFFIXES if stem.with_suffix(suffix).is_file()]
    if len(found) > 1:
        raise SourceError(f"{found[0]}: {found[1].name} lies beside it; keep one log of the flight")
    if not found:
        return None
    if found[0].suffix == ".tlog":
        from terrafix.core.mavlink.tlog import TelemetryLog  # the console reads descriptions and no telemetry

        return TelemetryLog(found[0], description.telemetry.tlog_t0_us, description.telemetry.system_id)
    from terrafix.core.autopilot_log.own_log import OwnLog

    return OwnLog(found[0], description.telemetry.log_zero_s, states, frames_s)


def _check_numbers(path: Path, table: dict[str, Any], where: str = "") -> None:
    """Raises SourceError for nan and inf, which TOML permits but no key accepts."""
    for key, value in table.items():
        if where == "" and key == "truth":
            continue
        if isinstance(value, dict):
            _check_numbers(path, value, key)
        for number in value if isinstance(value, list) else [value]:
            if isinstance(number, float) and not math.isfinite(number):
                raise SourceError(f"{path}: [{where}] {key} is {number}; write a number, or leave the key out")


def _explain(text: str) -> str:
    """msgspec's message in terms of the file, with the closest known key."""
    missing = re.search(r"missing required field `(.+?)`(?: - at `\$\.?(.*?)`)?", text)
    if missing:
        return f"[{missing.group(2)}] has no '{missing.group(1)}'; add it"
    unknown = re.search(r"unknown field `(.+?)`(?: - at `\$\.?(.*?)`)?", text)
    if unknown:
        key, where = unknown.group(1), unknown.group(2) or ""
        tables: dict[str, type[_Table]] = {
            "camera": CameraTable,
            "mount": MountTable,
            "start": StartTable,
            "telemetry": TelemetryTable,
        }
        known = [field.name for field in msgspec.structs.fields(tables.get(where, Description))]
        near = difflib.get_close_matches(key, known, 1, cutoff=0.5)
        hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(known)}"
        return f"unknown key '{key}' {f'in [{where}]' if where else 'at the top'}; {hint}"
    at = re.search(r"(.*) - at `\$\.?(\w*)\.?(.*)`", text)
    if not at:
        return text
    if (at.group(2), at.group(3)) == ("camera", "model"):
        return f'[camera] model: {at.group(1)}; write "pinhole" or "fisheye"; {NO_OMNIDIRECTIONAL}'
    place = f"[{at.group(2)}] {at.group(3)}" if at.group(3) else f"'{at.group(2)}'"
    return f"{place}: {at.group(1)[0].lower()}{at.group(1)[1:]}"
