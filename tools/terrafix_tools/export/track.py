"""The positions of a flight that are exported: finalised, refined or as they were in flight, with their orientation."""

import math
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import numpy as np
from PIL import Image

from terrafix.core.camera import Mount, camera_rotation
from terrafix.core.errors import SourceError, UsageError
from terrafix.core.geodesy import LocalFrame, euler_from_rot, rot_from_quat
from terrafix.messages import Camera, Frame, NavEstimate, Origin, WallClock
from terrafix.recorder.reader import is_record, read_flight
from terrafix_tools.estimates import NS, Row
from terrafix_tools.evaluate import flight_rows, read_summary
from terrafix_tools.finalised import TABLE, FinalRow, read_poses

BEST, FINALISED, REFINED, IMMEDIATE = "best", "finalised", "refined", "immediate"
WHICH = (BEST, FINALISED, REFINED, IMMEDIATE)
REDUCTIONS = (1, 2, 4, 8)  # by which images are read (terrafix.vision.sources.images)
# Image axes of photogrammetry (right, up, towards the viewer) in those of OpenCV (right, down, along the view).
IMAGE_AXES = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class TrackPose:
    """Position of one frame. ``row``: of estimates.csv, with the coordinates that were chosen. None: not known."""

    row: Row
    lat_deg: float
    lon_deg: float
    name: str  # of the image; of a live camera, which has no files, the number of the frame
    which: str
    r_w_c: np.ndarray | None = None  # (3, 3): camera (right, down, along the view) into east, north, up
    cov: np.ndarray | None = None  # (6, 6): position [m], then rotation [rad], world axes
    unix_s: float | None = None

    @property
    def alt_m(self) -> float:
        """Above mean sea level; 0 where it is unknown."""
        return self.row.alt_amsl_m or 0.0

    @property
    def sigma_h_m(self) -> float | None:
        """1-sigma of the worse of east and north."""
        sigmas = [s for s in (self.row.sigma_e_m, self.row.sigma_n_m) if s is not None]
        return max(sigmas, default=None)

    @property
    def sigma_u_m(self) -> float | None:
        known = self.cov is not None and self.row.alt_amsl_m is not None
        return math.sqrt(self.cov[2, 2]) if self.cov is not None and known else None

    @property
    def time_utc(self) -> str | None:
        if self.unix_s is None:
            return None
        return datetime.fromtimestamp(self.unix_s, UTC).isoformat(timespec="milliseconds")

    def yaw_pitch_roll_deg(self) -> tuple[float, float, float]:
        """Of a body that carries the camera straight down with the image top forward (Pix4D, ODM). Needs ``r_w_c``."""
        assert self.r_w_c is not None
        yaw, pitch, roll = (math.degrees(angle) for angle in euler_from_rot(self.r_w_c @ Mount().r_b_c().T))
        return yaw % 360.0, pitch, roll

    def omega_phi_kappa_deg(self) -> tuple[float, float, float]:
        """R = Rx(omega) Ry(phi) Rz(kappa) turns image axes (right, up, backward) into east, north, up. Needs
        ``r_w_c``."""
        assert self.r_w_c is not None
        r = self.r_w_c @ IMAGE_AXES
        omega, phi = math.atan2(-r[1, 2], r[2, 2]), math.asin(max(-1.0, min(1.0, float(r[0, 2]))))
        return math.degrees(omega), math.degrees(phi), math.degrees(math.atan2(-r[0, 1], r[0, 0]))


@dataclass(frozen=True)
class Track:
    """``poses``: the frames that have a position, in order of arrival."""

    name: str
    poses: list[TrackPose]
    camera: Camera | None  # of the images as they were read; None: there is no record
    axes: LocalFrame  # east and north about the origin of the flight

    def oriented(self) -> list[TrackPose]:
        """The poses that have an orientation. Raises SourceError."""
        found = [pose for pose in self.poses if pose.r_w_c is not None]
        if not found:
            raise SourceError(
                f"{self.name}: no position has an orientation; this format needs the flight record (flight.mcap) or "
                "finalised.csv beside the table"
            )
        return found

    def position_m(self, pose: TrackPose) -> np.ndarray:
        """(3,): east and north of the origin, height above mean sea level; above the ground where no elevation is
        known."""
        height_m = pose.row.alt_amsl_m if pose.row.alt_amsl_m is not None else pose.row.agl_m
        return np.array([*self.axes.to_local(pose.lat_deg, pose.lon_deg), height_m or 0.0])


def read_track(folder: Path, which: str = BEST) -> Track:
    """The positions of a run, replay or record. ``which``: one of WHICH; BEST: the finalised ones, where `terrafix
    finalise` has written none the refined ones, and of frames without one those of the flight.

    Raises UsageError, SourceError, EvaluationError."""
    if which not in WHICH:
        raise UsageError(f"--which {which}: choose one of {', '.join(WHICH)}")
    rows = flight_rows(folder)
    record = _Record(folder)
    beside = folder if folder.is_dir() else folder.parent
    final = {round(row.t_s, 3): row for row in read_poses(beside)} if which in (BEST, FINALISED) else {}
    if which == FINALISED and not final:
        raise SourceError(
            f"{folder}: there is no {TABLE} with orientations; write it with 'terrafix finalise {folder}'"
        )
    poses = []
    for index, row in enumerate(rows):
        pose = _final(row, final) if final else _flown(row, which, record.estimates.get(round(row.t_s, 3)), record)
        if pose is not None:
            unix_s = None if record.unix_offset_ns is None else row.t_s + record.unix_offset_ns / NS
            poses.append(replace(pose, name=row.file or f"frame-{index:06d}", unix_s=unix_s))
    if not poses:
        raise SourceError(f"{folder}: no frame has a position{_of(which)}; there is nothing to export")
    origin = record.origin
    axes = LocalFrame(*((origin.lat_deg, origin.lon_deg) if origin else (poses[0].lat_deg, poses[0].lon_deg)))
    name = str(read_summary(folder).get("flight") or "") if folder.is_dir() else ""
    return Track(name or folder.absolute().name, poses, origin.camera if origin else None, axes)


def _of(which: str) -> str:
    return "" if which == BEST else f" that is {which}"


class _Record:
    """What tables do not have: origin, wall clock, and the last estimate of each frame by its time."""

    def __init__(self, folder: Path) -> None:
        self.origin: Origin | None = None
        self.unix_offset_ns: int | None = None  # None where no clock was plausible in flight, as in a replay
        self.estimates: dict[float, NavEstimate] = {}
        times_s: dict[int, float] = {}
        for _, _, message in read_flight(folder) if is_record(folder) else ():
            if isinstance(message, Origin):
                self.origin = self.origin or message
            elif isinstance(message, WallClock) and message.unix_ns is not None:
                self.unix_offset_ns = message.unix_ns - message.t_ns
            elif isinstance(message, Frame):
                times_s.setdefault(message.frame_id, round(message.t_ns / NS, 3))
            elif isinstance(message, NavEstimate) and message.frame_id in times_s:
                self.estimates[times_s[message.frame_id]] = message


def _final(row: Row, final: dict[float, FinalRow]) -> TrackPose | None:
    found = final.get(round(row.t_s, 3))
    return None if found is None else _smoothed(row, found, FINALISED)


def _flown(row: Row, which: str, estimate: NavEstimate | None, record: _Record) -> TrackPose | None:
    """The refined pose of a row, else the immediate one, as far as ``which`` allows them."""
    if which != IMMEDIATE and row.refined_lat_deg is not None and row.refined_lon_deg is not None:
        found = FinalRow(
            row.file,
            row.t_s,
            row.refined_lat_deg,
            row.refined_lon_deg,
            row.refined_alt_amsl_m,
            q_w_c=row.refined_q_w_c,
            cov=row.refined_cov,
        )
        return _smoothed(row, found, REFINED)
    if which == REFINED or row.lat_deg is None or row.lon_deg is None:
        return None
    pose = TrackPose(row, row.lat_deg, row.lon_deg, "", IMMEDIATE)
    if estimate is None or record.origin is None:
        return pose
    cov = np.array(estimate.cov).reshape(6, 6)
    return replace(pose, r_w_c=camera_rotation(estimate, record.origin.camera), cov=cov)


def _smoothed(row: Row, found: FinalRow, which: str) -> TrackPose:
    """``found`` in place of the position of ``row``. The heading stays that of the body, as estimated in flight, unless
    ``found`` has one."""
    assert found.lat_deg is not None and found.lon_deg is not None
    quaternion = [float(value) for value in (found.q_w_c or "").split()]
    terms = [float(value) for value in (found.cov or "").split()]
    cov = np.array(terms).reshape(6, 6) if terms else None
    chosen = replace(
        row,
        lat_deg=found.lat_deg,
        lon_deg=found.lon_deg,
        alt_amsl_m=found.alt_amsl_m,
        sigma_e_m=None if cov is None else math.sqrt(cov[0, 0]),
        sigma_n_m=None if cov is None else math.sqrt(cov[1, 1]),
        cov_en_m2=None if cov is None else float(cov[0, 1]),
        yaw_deg=row.yaw_deg if found.yaw_deg is None else found.yaw_deg,
    )
    r_w_c = rot_from_quat((quaternion[0], quaternion[1], quaternion[2], quaternion[3])) if quaternion else None
    return TrackPose(chosen, found.lat_deg, found.lon_deg, "", which, r_w_c, cov)


def camera_of(track: Track, photos: Path | None) -> Camera:
    """The camera of the images in ``photos``, which the flight may have read at a half, a quarter or an eighth; without
    ``photos`` that of the images as they were read. Raises SourceError."""
    if track.camera is None:
        raise SourceError(f"{track.name}: the camera is in the flight record (flight.mcap), and there is none here")
    if photos is None:
        return track.camera
    camera = track.camera
    width, height = image_size(photo_path(photos, track.poses[0].name))
    by = next((n for n in REDUCTIONS if (-(-width // n), -(-height // n)) == (camera.width, camera.height)), None)
    if by is None:
        raise SourceError(
            f"{photos / track.poses[0].name}: {width}x{height} px, and the flight used images of "
            f"{camera.width}x{camera.height}; give the images of this flight (a fisheye has none that are pinhole)"
        )
    return msgspec.structs.replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * by,
        fy=camera.fy * by,
        cx=(camera.cx + 0.5) * by - 0.5,
        cy=(camera.cy + 0.5) * by - 0.5,
    )


def photo_path(photos: Path, name: str) -> Path:
    """The image ``name`` in a folder of photos or in a flight folder. Raises SourceError."""
    for path in (photos / name, photos / "frames" / name):
        if path.is_file():
            return path
    raise SourceError(f"{photos}: {name} is not there; give the folder with the images of this flight")


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of an image file. Raises SourceError."""
    try:
        with Image.open(path) as image:
            return image.size
    except (OSError, SyntaxError, ValueError) as error:
        raise SourceError(f"{path}: not a readable image ({error}); give the folder with the images") from None
