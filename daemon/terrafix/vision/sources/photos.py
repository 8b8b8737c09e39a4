"""Folder of photos as a camera stores them; all metadata comes from EXIF and XMP.

The body frame of such a flight is a virtual vehicle that carries the camera straight down with the image top forward.
At gimbal pitch -90 the image top points along the gimbal's yaw, so that is the body's yaw."""

import math
from collections.abc import Iterator
from datetime import datetime, timedelta
from itertools import groupby
from pathlib import Path

import numpy as np

from terrafix.core.errors import SourceError
from terrafix.core.geodesy import euler_from_rot, rot_w_b
from terrafix.messages import Camera, Frame, Origin, VehicleState
from terrafix.vision.sources.contract import Shot
from terrafix.vision.sources.description import Description, StartTable, camera_of, origin_of, read_description
from terrafix.vision.sources.exif import PhotoInfo, read_info
from terrafix.vision.sources.images import IMAGE_SUFFIXES, downscaled_camera, read_image

GIMBAL_TOLERANCE_DEG = 3.0  # a stabilised gimbal that reports its attitude
EXIF_FOCAL_SIGMA = 0.03  # the focal length in EXIF is rounded, or a 35 mm equivalent, and ignores distortion
UNKNOWN_TOLERANCE_DEG = 10.0  # the mount angle of the camera is unknown
UNTIMED_STEP_S = 1.0  # photos without times: ordered by name, one per second
EXIF_STEP_S = 1.0  # resolution of an EXIF time without SubSecTime


class Photos:
    """Photos ordered by time, then name. The GPS coordinate of the first one serves as initial position, no other."""

    live = False

    def __init__(self, folder: Path, start: tuple[float, float] | None = None, camera: Path | None = None) -> None:
        self.folder = folder
        paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file())
        if not paths:
            raise SourceError(f"{folder}: there are no photos in this folder")
        infos = [(path, read_info(path)) for path in paths]
        readable = [info for _, info in infos if info is not None]
        if not readable:
            raise SourceError(f"{folder}: none of the {len(paths)} photos can be read")
        self._photos = in_time_order(infos)
        self._description, self._where = self._describe(camera)
        first = next(info for _, info, _ in self._photos if info is not None)
        self._stored = (
            camera_of(self._where, self._description) if self._description.camera else self._camera_from_exif(first)
        )
        self._origin = self._make_origin(first, downscaled_camera(self._stored), start)

    def origin(self) -> Origin:
        return self._origin

    def length(self) -> int | None:
        return len(self._photos)

    def name(self) -> str:
        return self._description.name or self.folder.resolve().name

    def map_hint(self) -> Path | None:
        return (self._where.parent / self._description.map).resolve() if self._description.map else None

    def close(self) -> None:
        """No resource stays open between shots."""

    def shots(self, from_s: float = 0.0) -> Iterator[Shot]:
        camera, stored = self._origin.camera, self._stored
        for frame_id, (path, info, t_s) in enumerate(self._photos):
            if t_s < from_s:
                continue
            t_ns = round(t_s * 1e9)
            image, error = read_image(path, stored.width, stored.height)
            frame = Frame(
                t_ns=t_ns, frame_id=frame_id, file=path.name, width=camera.width, height=camera.height, error=error
            )
            state = state_of(info, t_ns) if info else None
            yield Shot(frame, (state,) if state else (), image)

    def _describe(self, camera: Path | None) -> tuple[Description, Path]:
        """The camera description that was given, else a flight.toml beside the photos; both override EXIF."""
        beside = self.folder / "flight.toml"
        if camera is not None:
            return read_description(camera), camera
        return (read_description(beside), beside) if beside.is_file() else (Description(), beside)

    def _make_origin(self, first: PhotoInfo, camera: Camera, start: tuple[float, float] | None) -> Origin:
        description = self._description
        if start is None and description.start is None and first.lat_deg is not None and first.lon_deg is not None:
            description = _with_start(description, first.lat_deg, first.lon_deg)
        return origin_of(description, camera, start)

    def _camera_from_exif(self, first: PhotoInfo) -> Camera:
        source = next((info for _, info, _ in self._photos if info is not None and info.focal_px), None)
        if source is None or source.focal_px is None:
            raise SourceError(
                f"{self.folder}: no photo says its focal length; write a flight.toml with [camera] beside the photos"
            )
        has_gimbal = "GimbalPitchDegree" in first.xmp
        scale = source.width / first.width
        return Camera(
            width=first.width,
            height=first.height,
            fx=source.focal_px / scale,
            fy=source.focal_px / scale,
            cx=source.xmp.get("CalibratedOpticalCenterX", source.width / 2) / scale,
            cy=source.xmp.get("CalibratedOpticalCenterY", source.height / 2) / scale,
            focal_sigma=EXIF_FOCAL_SIGMA,
            mount_tolerance_deg=GIMBAL_TOLERANCE_DEG if has_gimbal else UNKNOWN_TOLERANCE_DEG,
        )


def _with_start(description: Description, lat_deg: float, lon_deg: float) -> Description:
    return Description(
        name=description.name,
        map=description.map,
        telemetry=description.telemetry,
        start=StartTable(lat_deg=lat_deg, lon_deg=lon_deg),
    )


def state_of(info: PhotoInfo, t_ns: int) -> VehicleState | None:
    """Attitude and height of the virtual vehicle; None when the photo has neither yaw nor height."""
    xmp = info.xmp
    agl_m = xmp.get("RelativeAltitude")
    yaw_deg = xmp.get("GimbalYawDegree", xmp.get("FlightYawDegree"))
    yaw_rad = None if yaw_deg is None else math.remainder(math.radians(yaw_deg), math.tau)
    pitch_rad = roll_rad = None
    if "GimbalYawDegree" in xmp and "GimbalPitchDegree" in xmp:
        yaw_rad, pitch_rad, roll_rad = body_angles_from_gimbal(
            xmp["GimbalYawDegree"], xmp["GimbalPitchDegree"], xmp.get("GimbalRollDegree", 0.0)
        )
    if agl_m is None and yaw_rad is None:
        return None
    return VehicleState(t_ns=t_ns, source="exif", yaw_rad=yaw_rad, pitch_rad=pitch_rad, roll_rad=roll_rad, agl_m=agl_m)


def body_angles_from_gimbal(yaw_deg: float, pitch_deg: float, roll_deg: float) -> tuple[float, float, float]:
    """(yaw, pitch, roll) in rad of a body whose camera is mounted at pitch -90, from the gimbal's Z-Y-X angles."""
    r_w_gimbal = rot_w_b(math.radians(yaw_deg), math.radians(pitch_deg), math.radians(roll_deg))
    r_gimbal_b = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # Ry(+90)
    return euler_from_rot(r_w_gimbal @ r_gimbal_b)  # undoes the mount


def in_time_order(photos: list[tuple[Path, PhotoInfo | None]]) -> list[tuple[Path, PhotoInfo | None, float]]:
    """(path, info, t_s) ordered by time, then name; the first at 0. ``photos`` are sorted by name.

    A photo without a time gets that of the previous one by name. Photos of one second are distributed evenly in it."""
    first = next((info.taken for _, info in photos if info is not None and info.taken is not None), None)
    if first is None:
        return [(path, info, index * UNTIMED_STEP_S) for index, (path, info) in enumerate(photos)]
    timed: list[tuple[datetime, Path, PhotoInfo | None]] = []
    last = first
    for path, info in photos:
        last = info.taken if info is not None and info.taken is not None else last
        timed.append((last, path, info))
    timed.sort(key=lambda photo: (photo[0], photo[1].name))
    ordered: list[tuple[Path, PhotoInfo | None, float]] = []
    for taken, group in groupby(timed, key=lambda photo: photo[0]):
        group_photos = list(group)
        later = next((other for other, _, _ in timed if other > taken), taken + timedelta(seconds=EXIF_STEP_S))
        interval_s = min(EXIF_STEP_S, (later - taken).total_seconds())
        for k, (_, path, info) in enumerate(group_photos):
            ordered.append((path, info, (taken - timed[0][0]).total_seconds() + interval_s * k / len(group_photos)))
    return ordered
