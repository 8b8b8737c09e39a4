"""Folder of photos as a camera stores them; all metadata comes from EXIF and XMP.

The body frame of such a flight is a virtual vehicle that carries the camera straight down with the image top forward.
At gimbal pitch -90 the image top points along the gimbal's yaw, so that is the body's yaw."""

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import fields, replace
from datetime import datetime, timedelta
from itertools import groupby
from pathlib import Path

import msgspec

from terrafix.core.errors import SourceError
from terrafix.messages import Camera, Fact, Frame, Origin, VehicleState
from terrafix.vision.sources.contract import Shot, SourceBase
from terrafix.vision.sources.description import Description, StartTable, camera_of, origin_of, read_description
from terrafix.vision.sources.exif import PhotoInfo, read_info
from terrafix.vision.sources.facts import camera_facts, mount_fact, rate_facts, start_fact, telemetry_facts
from terrafix.vision.sources.images import downscaled_camera, image_files, is_image_name, read_image
from terrafix.vision.sources.plausible import check_camera, check_heights
from terrafix.vision.sources.xmp import PIX4D, BodyAngles, Xmp

# 1-sigma of the tilt that photos state: the angle to which a gimbal was sent, or the autopilot's, without an accuracy.
# [measured: the camera of town-a, on a gimbal, is 9 degrees from straight down in all photos; photos of seneca-wing are
# off by 3.7 degrees in pitch and 4.6 in roll, each by another angle]
STATED_TILT_SIGMA_DEG = 9.0
EXIF_FOCAL_SIGMA = 0.03  # the focal length in EXIF is rounded, or a 35 mm equivalent, and ignores distortion
UNKNOWN_TOLERANCE_DEG = 10.0  # the mount angle of the camera is unknown
# Some cameras state a yaw of their gimbal that is 40 to 55 degrees off (reports on DJI Air 3, Mavic 2 Pro, Air 2S),
# others carry it turned: beyond this the two yaws are no heading to a few degrees.
MAX_YAWS_APART_DEG = 30.0
MAX_NAMED = 3  # files of a kind that are named
MAX_OTHER_LENS_SHARE = 0.1  # of the photos: up to here they are left out, above it which lens is meant is asked
_ZERO_NAMES = {"agl_m": "a height", "heading_deg": "a heading", "angles": "camera angles"}
UNTIMED_STEP_S = 1.0  # photos without times: ordered by name, one per second
EXIF_STEP_S = 1.0  # resolution of an EXIF time without SubSecTime


class Photos(SourceBase):
    """Photos ordered by time, then name. The GPS coordinate of the first one serves as initial position, no other."""

    def __init__(self, folder: Path, start: tuple[float, float] | None = None, camera: Path | None = None) -> None:
        self.folder = folder
        paths = image_files(folder)
        if not paths:
            raise SourceError(f"{folder}: there are no photos in this folder")
        infos = reported([read_info(path) for path in paths])
        if all(info is None for info in infos):
            raise SourceError(f"{folder}: none of the {len(paths)} photos can be read")
        self._photos = in_time_order(list(zip(paths, infos, strict=True)))
        self._lenses = lens_groups([(path, info) for path, info, _ in self._photos if info is not None])
        check_lenses(str(folder), self._lenses)
        self._unclear = self._unclear_lenses()
        self._description, self._where = self._describe(camera)
        main = {path for path, _ in self._lenses[0]} if self._lenses else None
        first = next(info for path, info, _ in self._photos if info is not None and (main is None or path in main))
        self._first = first
        self._stored = (
            camera_of(self._where, self._description) if self._description.camera else self._camera_from_exif(first)
        )
        heights_m = [i.xmp.agl_m for i in infos if i is not None and i.xmp.agl_m is not None]
        check_heights(folder, heights_m, "the height", "photos")
        self._apart_deg = yaws_apart_deg(infos)
        self._origin = self._make_origin(first, downscaled_camera(self._stored), start)
        self._start_given = start is not None

    @property
    def stored(self) -> Camera:
        """The camera of the photos as they are stored."""
        return self._stored

    def length(self) -> int | None:
        return len(self._photos)

    def name(self) -> str:
        return self._description.name or self.folder.resolve().name

    def map_hint(self) -> Path | None:
        return (self._where.parent / self._description.map).resolve() if self._description.map else None

    def facts(self) -> list[Fact]:
        """Where each number of the photos comes from."""
        known = [info for _, info, _ in self._photos if info is not None]
        described, lens = self._where.name, self._first.lens
        whence = f"[camera] of {described}" if self._description.camera else f"{lens.focal_from} of the photos"
        notes = [f"camera {self._first.model or 'unknown'}"] if not self._description.camera else []
        angles = Counter(info.xmp.angles.source for info in known if info.xmp.angles is not None)
        mount = f"[mount] of {described}" if self._description.camera else _counted(angles, len(known))
        start = "--start" if self._start_given else f"[start] of {described}" if self._description.start else "GPS"
        gps = "GPS of the first photo; that of the others is not used" if start == "GPS" else start
        states = [state for _, info, _ in self._photos if info is not None and (state := state_of(info, 0)) is not None]
        heights = Counter(info.xmp.agl_from for info in known if info.xmp.agl_m is not None)
        found = [
            *camera_facts(self._stored, whence, [*notes, *(lens.notes if not self._description.camera else ())]),
            mount_fact(self._stored, mount or "nothing: the photos do not say it"),
            start_fact(self._origin, gps),
            *(
                Fact("height", f"{_counted(heights, len(known))}, 1-sigma {self._origin.agl_sigma_m:g} m")
                if fact.topic == "height" and heights
                else fact
                for fact in telemetry_facts(states, "the photos", self._origin)
            ),
            Fact("clock", _clock_text(known)),
            *rate_facts([t_s for _, _, t_s in self._photos], "photos"),
        ]
        if self._apart_deg > MAX_YAWS_APART_DEG:
            apart = f"GimbalYawDegree and FlightYawDegree are {self._apart_deg:.0f} degrees apart in half of the photos"
            found.append(Fact("heading", f"{apart}, which is the 1-sigma of the heading; the gimbal's is read"))
        return [*found, *self._left_out()]

    def _left_out(self) -> Iterator[Fact]:
        for note, count in Counter(n for _, i, _ in self._photos if i is not None for n in i.xmp.notes).items():
            yield Fact("left out", f"{note} ({count} photos)")
        for group in self._lenses[1:]:
            yield Fact("left out", f"another lens: {lens_text(group)}")
        for path, problem in self._unclear.items():
            yield Fact("left out", f"{path.name}: {problem}")
        unreadable = [path.name for path, info, _ in self._photos if info is None]
        if unreadable:
            yield Fact("left out", f"{len(unreadable)} that cannot be read: {', '.join(unreadable[:MAX_NAMED])}")
        others = sorted(path.name for path in self.folder.iterdir() if path.is_file())
        others = [n for n in others if not is_image_name(n) and n not in ("flight.toml", self._where.name)]
        if others:
            more = f" and {len(others) - MAX_NAMED} more" if len(others) > MAX_NAMED else ""
            yield Fact("left out", f"files that are no photos: {', '.join(others[:MAX_NAMED])}{more}")

    def shots(self, from_s: float = 0.0) -> Iterator[Shot]:
        camera, stored = self._origin.camera, self._stored
        other_lens = {path: f"another lens: {lens_text(group)}" for group in self._lenses[1:] for path, _ in group}
        other_lens |= self._unclear
        for frame_id, (path, info, t_s) in enumerate(self._photos):
            if t_s < from_s:
                continue
            t_ns = round(t_s * 1e9)
            image, error = read_image(path, stored.width, stored.height)
            if path in other_lens:
                image, error = None, other_lens[path]
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
            start_table = StartTable(lat_deg=first.lat_deg, lon_deg=first.lon_deg)
            description = msgspec.structs.replace(description, start=start_table)
        origin = origin_of(description, camera, start, STATED_TILT_SIGMA_DEG)
        if self._apart_deg <= MAX_YAWS_APART_DEG:
            return origin
        return msgspec.structs.replace(origin, yaw_sigma_deg=max(origin.yaw_sigma_deg, self._apart_deg))

    def _unclear_lenses(self) -> dict[Path, str]:
        """Photos whose focal length cannot be known beside others whose can, with the reason: they are left out. Raises
        SourceError when they are too many. Where it is unclear in all photos, [camera] may state it."""
        known = [(path, info.lens.problem) for path, info, _ in self._photos if info is not None]
        unclear = {path: f"a lens that is not clear: {problem}" for path, problem in known if problem}
        if len(unclear) == len(known):
            return {}
        if len(unclear) > MAX_OTHER_LENS_SHARE * len(known):
            path, problem = next((path, problem) for path, problem in known if problem)
            raise SourceError(
                f"{self.folder}: {path.name} and {len(unclear) - 1} more {problem}, the other photos do not; put those "
                "of one lens and zoom into a folder of its own"
            )
        return unclear

    def _camera_from_exif(self, first: PhotoInfo) -> Camera:
        problem = next((i.lens.problem for _, i, _ in self._photos if i is not None and i.lens.problem), "")
        if first.focal_px is None and problem:
            raise SourceError(f"{self.folder}: a photo {problem}; write a flight.toml with [camera] beside the photos")
        if first.focal_px is None:
            raise SourceError(
                f"{self.folder}: no photo says its focal length; write a flight.toml with [camera] beside the photos"
            )
        centre_px = first.lens.centre_px or (first.width / 2, first.height / 2)
        camera = Camera(
            width=first.width,
            height=first.height,
            fx=first.focal_px,
            fy=first.focal_px,
            cx=centre_px[0],
            cy=centre_px[1],
            focal_sigma=EXIF_FOCAL_SIGMA,
            mount_tolerance_deg=UNKNOWN_TOLERANCE_DEG if first.xmp.angles is None else STATED_TILT_SIGMA_DEG,
        )
        check_camera(self.folder, camera, f"the photos' EXIF ({first.lens.focal_from}):")
        return camera


def _counted(sources: Counter[str], count: int) -> str:
    """ "gimbal angles of DJI in 35 of 36 photos"; empty without sources."""
    return ", ".join(f"{source} in {n} of {count} photos" for source, n in sources.most_common())


def _clock_text(infos: list[PhotoInfo]) -> str:
    timed = sum(info.taken is not None for info in infos)
    if not timed:
        return "no photo has a time: one a second in the order of their names"
    fractions = "with" if any(info.has_subsec for info in infos) else "without"
    return f"DateTimeOriginal of {timed} of {len(infos)} photos, {fractions} fractions of a second"


def state_of(info: PhotoInfo, t_ns: int) -> VehicleState | None:
    """Attitude and height of the virtual vehicle; None when the photo has neither yaw nor height."""
    xmp = info.xmp
    yaw_deg = xmp.heading_deg if xmp.angles is None else xmp.angles.yaw_deg
    yaw_rad = None if yaw_deg is None else math.remainder(math.radians(yaw_deg), math.tau)
    if xmp.agl_m is None and yaw_rad is None:
        return None
    return VehicleState(
        t_ns=t_ns,
        source="exif",
        yaw_rad=yaw_rad,
        pitch_rad=None if xmp.angles is None else math.radians(xmp.angles.pitch_deg),
        roll_rad=None if xmp.angles is None else math.radians(xmp.angles.roll_deg),
        agl_m=xmp.agl_m,
    )


def reported(infos: list[PhotoInfo | None]) -> list[PhotoInfo | None]:
    """The photos without what their firmware writes into all of them because it does not know it: a height, a heading
    or angles (which look down with the image top to the north) that are exactly zero."""
    stated = [info.xmp for info in infos if info is not None]
    if len(stated) < 2:
        return infos
    for unknown in (Xmp(agl_m=0.0), Xmp(heading_deg=0.0), Xmp(angles=BodyAngles(0.0, 0.0, 0.0, PIX4D))):
        key = next(field.name for field in fields(Xmp) if getattr(unknown, field.name) not in (None, "", ()))
        if all(getattr(xmp, key) == getattr(unknown, key) for xmp in stated):
            note = f"{_ZERO_NAMES[key]} of exactly zero in all photos: not reported"
            infos = [None if info is None else _without(info, key, note) for info in infos]
    return infos


def yaws_apart_deg(infos: list[PhotoInfo | None]) -> float:
    """Median difference between the heading by the camera's angles and that of the flight; 0 where both are not
    stated."""
    apart = sorted(
        abs(math.remainder(info.xmp.angles.yaw_deg - info.xmp.flight_yaw_deg, 360.0))
        for info in infos
        if info is not None and info.xmp.angles is not None and info.xmp.flight_yaw_deg is not None
    )
    return apart[len(apart) // 2] if apart else 0.0


def _without(info: PhotoInfo, key: str, note: str) -> PhotoInfo:
    xmp = replace(info.xmp, **{key: None}, notes=(*info.xmp.notes, note))  # type: ignore[arg-type]
    return replace(info, xmp=xmp)


def lens_groups(photos: list[tuple[Path, PhotoInfo]]) -> list[list[tuple[Path, PhotoInfo]]]:
    """The photos that state their focal length, by lens, the most frequent one first. Focal lengths are compared as
    shares of the longer side: photos of one lens may have several sizes. Within a group they differ by EXIF_FOCAL_SIGMA
    at most."""
    known = sorted((p for p in photos if p[1].focal_px is not None), key=lambda photo: _relative_focal(photo[1]))
    groups: list[list[tuple[Path, PhotoInfo]]] = []
    for photo in known:
        if groups and _relative_focal(photo[1]) <= (1.0 + EXIF_FOCAL_SIGMA) * _relative_focal(groups[-1][0][1]):
            groups[-1].append(photo)
        else:
            groups.append([photo])
    return sorted(groups, key=len, reverse=True)


def check_lenses(where: str, groups: list[list[tuple[Path, PhotoInfo]]]) -> None:
    """Raises SourceError when it is not clear which lens is meant: one camera describes a flight. ``where``: what has
    the photos."""
    others = sum(map(len, groups[1:]))
    if others > MAX_OTHER_LENS_SHARE * sum(map(len, groups)):
        named = " and ".join(lens_text(group) for group in groups[:2])
        more = f" and {len(groups) - 2} more" if len(groups) > 2 else ""
        raise SourceError(
            f"{where}: the photos are of several lenses or zooms: {named}{more}; put those of one into a folder of "
            "its own"
        )


def lens_text(group: list[tuple[Path, PhotoInfo]]) -> str:
    """A group of photos of one lens in words."""
    path, info = group[0]
    photos = f"{len(group)} photos like {path.name}" if len(group) > 1 else path.name
    return (
        f"{photos} ({info.model or 'unknown camera'}, {info.width}x{info.height}, focal length {info.focal_px:.0f} px)"
    )


def _relative_focal(info: PhotoInfo) -> float:
    assert info.focal_px is not None
    return info.focal_px / max(info.width, info.height)


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
