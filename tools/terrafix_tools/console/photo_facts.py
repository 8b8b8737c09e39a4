"""What photos state of the flight that they are to become: the source `terrafix replay` would open, from their first
bytes and a flight.toml, and where each number comes from."""

import asyncio
import math
import tempfile
from dataclasses import replace
from pathlib import Path

from starlette.requests import Request

from terrafix.core.errors import SourceError
from terrafix.messages import Camera as StoredCamera
from terrafix.messages import Origin
from terrafix.vision.sources.description import Description, MountTable, read_description
from terrafix.vision.sources.exif import read_info
from terrafix.vision.sources.photos import UNKNOWN_TOLERANCE_DEG, Photos, reported, state_of
from terrafix_tools.console.payloads import Camera, Mount, PhotoFact, PhotoFacts, Start, Telemetry
from terrafix_tools.console.problems import Refusal
from terrafix_tools.console.settings import ServiceLimits
from terrafix_tools.console.uploads import DESCRIPTION, IMAGES, Slots, drain, parts_in_time

FLIGHT_TOML = "flight.toml"
HEAD_BYTES = 256 * 1024  # of a photo: EXIF and XMP are before them [spec: docs/console.md]


async def photo_facts(request: Request, limits: ServiceLimits, slots: Slots) -> PhotoFacts:
    """The first bytes of up to a batch of photos, and a flight.toml. Raises Refusal."""
    heads = replace(limits, image_bytes=HEAD_BYTES)
    with (
        slots.one(),
        tempfile.TemporaryDirectory(prefix="photos-") as folder,
        tempfile.TemporaryDirectory() as incoming,
    ):
        try:
            parts = await parts_in_time(request, Path(incoming), heads)
        except Refusal:
            await drain(request)
            raise
        for i, part in enumerate(part for part in parts if part.field == IMAGES):
            part.path.rename(Path(folder) / f"{i:04d}{Path(part.name).suffix.lower()}")
        for part in parts:
            if part.field == DESCRIPTION:
                part.path.rename(Path(folder) / FLIGHT_TOML)
        try:
            return await asyncio.to_thread(facts_of, Path(folder))
        except SourceError as error:
            raise Refusal(422, str(error).replace(f"{folder}/", "").replace(folder, "the photos")) from None


def facts_of(folder: Path) -> PhotoFacts:
    """Of a folder with photos, or their first bytes, and maybe a flight.toml. Raises SourceError."""
    described = folder / FLIGHT_TOML
    description = read_description(described) if described.is_file() else Description()
    problem = ""
    try:
        photos = Photos(folder)
    except SourceError as error:
        if description.camera is not None:
            raise
        problem = str(error).replace(f"{folder}: ", "")
        photos = _without_focal_length(folder, description)
    infos = reported([read_info(path) for path in sorted(folder.iterdir()) if path.name != FLIGHT_TOML])
    known = [info for info in infos if info is not None]
    states = [state for info in known if (state := state_of(info, 0)) is not None]
    heights = [state.agl_m for state in states if state.agl_m is not None]
    yaws = [state.yaw_rad for state in states if state.yaw_rad is not None]
    stored, unknown = photos.stored, ("camera", "mount") if problem else ()
    return PhotoFacts(
        width=stored.width,
        height=stored.height,
        camera=None if problem else _camera(stored),
        mount=_mount(stored) if not problem else Mount(tolerance_deg=UNKNOWN_TOLERANCE_DEG),
        telemetry=Telemetry(
            yaw_sigma_deg=description.telemetry.yaw_sigma_deg,
            agl_sigma_m=description.telemetry.agl_sigma_m,
            attitude_sigma_deg=description.telemetry.attitude_sigma_deg,
        ),
        start=_start(photos.origin()),
        height_m=round(heights[0], 2) if heights else None,
        yaw_deg=round(math.degrees(yaws[0]) % 360.0, 2) if yaws else None,
        name=description.name,
        map=Path(description.map).stem,
        facts=[PhotoFact(topic=fact.topic, text=fact.text) for fact in photos.facts() if fact.topic not in unknown],
        problem=problem,
    )


def _without_focal_length(folder: Path, description: Description) -> Photos:
    """The same photos with a camera that is not used. Raises SourceError: there is more that is wrong."""
    first = next((info for path in sorted(folder.iterdir()) if (info := read_info(path)) is not None), None)
    if first is None:
        raise SourceError("none of the photos can be read")
    size = first.width, first.height
    assumed = folder / "assumed.toml"
    lines = [f"width = {size[0]}", f"height = {size[1]}", f"fx = {size[0]}", f"fy = {size[0]}"]
    lines += [f"cx = {size[0] / 2}", f"cy = {size[1] / 2}"]
    assumed.write_text("[camera]\n" + "\n".join(lines) + "\n", encoding="utf-8")
    start = None if description.start is None else (description.start.lat_deg, description.start.lon_deg)
    try:
        return Photos(folder, start=start, camera=assumed)
    finally:
        assumed.unlink()


def _camera(stored: StoredCamera) -> Camera:
    return Camera(
        width=stored.width,
        height=stored.height,
        fx=round(stored.fx, 3),
        fy=round(stored.fy, 3),
        cx=round(stored.cx, 3),
        cy=round(stored.cy, 3),
        distortion=list(stored.distortion),
        focal_sigma=stored.focal_sigma,
    )


def _mount(stored: StoredCamera) -> Mount:
    table = MountTable.of(stored)
    return Mount(
        yaw_deg=table.yaw_deg, pitch_deg=table.pitch_deg, roll_deg=table.roll_deg, tolerance_deg=table.tolerance_deg
    )


def _start(origin: Origin) -> Start | None:
    if math.isinf(origin.start_sigma_m):
        return None
    return Start(
        lat=round(origin.lat_deg, 8),
        lon=round(origin.lon_deg, 8),
        sigma_m=origin.start_sigma_m,
        ground_amsl_m=origin.ground_amsl_m,
    )
