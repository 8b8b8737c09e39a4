"""Batches of images: read from the request into files, checked by their headers, given to the flight as a whole."""

import asyncio
import hashlib
import math
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import msgspec
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.requests import ClientDisconnect, Request

from terrafix.core.errors import SourceError
from terrafix.core.state_folder import flush_to_disk
from terrafix.messages import VehicleState
from terrafix.vision.sources.exif import PhotoInfo, read_info
from terrafix.vision.sources.images import stated_size
from terrafix.vision.sources.photos import (
    EXIF_STEP_S,
    UNTIMED_STEP_S,
    check_lenses,
    in_time_order,
    lens_groups,
    reported,
    state_of,
)
from terrafix.vision.sources.table import Row, read_table
from terrafix_tools.console.payloads import MAX_IMAGE_PX, MIN_IMAGE_PX, Accepted, NewFlight
from terrafix_tools.console.problems import FULL, Refusal
from terrafix_tools.console.settings import ServiceLimits
from terrafix_tools.console.store import flights
from terrafix_tools.console.store.database import Database
from terrafix_tools.console.store.flights import StoredImage

IMAGES, TELEMETRY = "images", "telemetry"  # names of the parts
DESCRIPTION = "description"  # a flight.toml, of POST /photos
NAME = re.compile(r"[^./\\\x00-\x1f\x7f][^/\\\x00-\x1f\x7f]{0,199}")
# First bytes of what is taken, with the suffix that the stored file gets: the name that was sent decides nothing.
FORMATS = {b"\xff\xd8\xff": ".jpg", b"\x89PNG\r\n\x1a\n": ".png"}
HEADER_BYTES = 256 * 1024  # of an image that are read for its size: EXIF with a thumbnail is before it [spec: < 64 kB]
TELEMETRY_BYTES = 64 * 1024
SLACK_BYTES = 64 * 1024  # of a body beside its images: headers of the parts
DRAIN_BYTES, DRAIN_S = 512 * 2**20, 10.0  # of a refused body that is still read [spec: an upload of 50 images of 10 MB]


@dataclass
class Part:
    """A part of the body that was read: ``path`` of its content."""

    field: str
    name: str
    path: Path
    bytes: int = 0
    sha256: str = ""


class _Reader:
    """Callbacks of the parser, which bounds the headers. Every part goes to a file of its own as it arrives."""

    def __init__(self, folder: Path, limits: ServiceLimits) -> None:
        self._folder, self._limits = folder, limits
        self.parts: list[Part] = []
        self._name = bytearray()
        self._value = bytearray()
        self._disposition = ""
        self._file: BinaryIO | None = None
        self._sum = hashlib.sha256()
        self.ended = False

    def on_header_field(self, data: bytes, start: int, end: int) -> None:
        self._name += data[start:end]

    def on_header_value(self, data: bytes, start: int, end: int) -> None:
        self._value += data[start:end]

    def on_header_end(self) -> None:
        if self._name.lower() == b"content-disposition":
            self._disposition = self._value.decode("latin-1")  # as parse_options_header encodes it again
        self._name.clear()
        self._value.clear()

    def on_headers_finished(self) -> None:
        _, options = parse_options_header(self._disposition)
        field = options.get(b"name", b"").decode("utf-8", errors="replace")
        name = options.get(b"filename", b"").decode("utf-8", errors="replace")
        self._disposition = ""
        if field not in (IMAGES, TELEMETRY, DESCRIPTION):
            raise Refusal(422, f"a part is named {field[:40]!r}; send '{IMAGES}' for each image, and '{TELEMETRY}'")
        most = self._limits.batch[1]
        if field == IMAGES and sum(part.field == IMAGES for part in self.parts) == most:
            raise Refusal(422, f"more than {most} images; send them in batches")
        if field != IMAGES and any(part.field == field for part in self.parts):
            raise Refusal(422, f"two parts '{field}'; send one")
        if field == IMAGES and not NAME.fullmatch(name):
            raise Refusal(422, f"{name[:100]!r} is no name of an image; it has no '/', and begins with no '.'")
        part = Part(field, name, self._folder / str(len(self.parts)))
        self.parts.append(part)
        self._file, self._sum = part.path.open("wb"), hashlib.sha256()

    def on_part_data(self, data: bytes, start: int, end: int) -> None:
        assert self._file is not None
        part, chunk = self.parts[-1], memoryview(data)[start:end]
        part.bytes += len(chunk)
        most = self._limits.image_bytes if part.field == IMAGES else TELEMETRY_BYTES
        if part.bytes > most:
            raise Refusal(413, f"{part.name or part.field}: larger than {most} bytes")
        self._sum.update(chunk)
        self._file.write(chunk)

    def on_part_end(self) -> None:
        assert self._file is not None
        self._file.close()
        self.parts[-1].sha256 = self._sum.hexdigest()

    def on_end(self) -> None:
        self.ended = True

    def close(self) -> None:
        if self._file is not None:
            self._file.close()


@contextmanager
def incoming(folder: Path) -> Iterator[Path]:
    """A folder for the parts of one upload, on the disk of the flight; removed at the end."""
    folder.mkdir(parents=True, exist_ok=True)
    path = Path(tempfile.mkdtemp(dir=folder, prefix="incoming-"))
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


async def read_parts(request: Request, folder: Path, limits: ServiceLimits) -> list[Part]:
    """The parts of a multipart/form-data body, as files in ``folder``. Raises Refusal."""
    kind, options = parse_options_header(request.headers.get("content-type", ""))
    boundary = options.get(b"boundary", b"")
    if kind != b"multipart/form-data" or not boundary:
        raise Refusal(415, "send the images as multipart/form-data (curl -F images=@FILE ...)")
    reader = _Reader(folder, limits)
    try:
        parser = MultipartParser(
            boundary,
            callbacks={
                "on_header_field": reader.on_header_field,
                "on_header_value": reader.on_header_value,
                "on_header_end": reader.on_header_end,
                "on_headers_finished": reader.on_headers_finished,
                "on_part_data": reader.on_part_data,
                "on_part_end": reader.on_part_end,
                "on_end": reader.on_end,
            },
        )
        most, taken = limits.batch[1] * limits.image_bytes + TELEMETRY_BYTES + SLACK_BYTES, 0
        async for chunk in request.stream():
            taken += len(chunk)
            if taken > most:
                raise Refusal(413, f"the body is larger than {most} bytes")
            parser.write(chunk)
        parser.finalize()
    except FormParserError as error:
        raise Refusal(422, f"the body is not valid multipart/form-data ({error})") from None
    except ClientDisconnect:
        raise Refusal(400, "the connection ended before the body did") from None
    except OSError as error:
        raise Refusal(FULL, f"the upload cannot be stored ({error.strerror})") from None
    finally:
        reader.close()
    if not reader.ended:
        raise Refusal(422, "the body is not valid multipart/form-data (it ends too early)")
    return reader.parts


def check_room(folder: Path, limits: ServiceLimits, needed_bytes: int = 0) -> None:
    """Raises Refusal (507): the disk is almost full."""
    free = shutil.disk_usage(folder).free
    if free < limits.disk_reserve_bytes + needed_bytes:
        raise Refusal(FULL, f"{free // 2**20} MB are free on the disk of the console; delete flights or free space")


def check_image(part: Part, new: NewFlight) -> str:
    """-> the suffix for its format. Only the header is read. Raises Refusal: another format, or another size."""
    with part.path.open("rb") as file:
        head = file.read(HEADER_BYTES)
    suffix = next((suffix for magic, suffix in FORMATS.items() if head.startswith(magic)), None)
    size = stated_size(head) if suffix is not None else None
    if suffix is None or size is None:
        raise Refusal(422, f"{part.name}: not a JPEG or PNG image")
    (width, height), (least_w, least_h), (most_w, most_h) = size, MIN_IMAGE_PX, MAX_IMAGE_PX
    if not (least_w <= width <= most_w and least_h <= height <= most_h):
        raise Refusal(
            422, f"{part.name}: {width}x{height} pixels; images have {least_w}x{least_h} to {most_w}x{most_h}"
        )
    if size != (new.camera.width, new.camera.height):
        camera = f"{new.camera.width}x{new.camera.height}"
        raise Refusal(422, f"{part.name}: {width}x{height} pixels, the camera of this flight has {camera}")
    return suffix


def store_batch(database: Database, flight_id: str, folder: Path, parts: list[Part], limits: ServiceLimits) -> Accepted:
    """Checks a batch and gives it to the flight: every image, or none. ``folder``: of the flight. Raises Refusal."""
    images = [part for part in parts if part.field == IMAGES]
    least, most = limits.batch
    if not least <= len(images) <= most:
        raise Refusal(422, f"{len(images)} images; a batch has {least} to {most}, sent as parts '{IMAGES}'")
    names = [part.name for part in images]
    flights.check_order(None, names)
    with database.read() as db:
        row = flights.row_of(db, flight_id)
        new = NewFlight.model_validate_json(row.spec)
        known = flights.repeated_batch(db, flight_id, [(part.name, part.sha256) for part in images])
    if known is not None:
        return Accepted(frames=known, repeated=True)
    suffixes = [check_image(part, new) for part in images]
    table = next((part for part in parts if part.field == TELEMETRY), None)
    rows = None if table is None else _telemetry(table, names)
    infos = reported([read_info(part.path) for part in images])
    named = [(Path(part.name), info) for part, info in zip(images, infos, strict=True) if info is not None]
    try:
        check_lenses("the batch", lens_groups(named))
    except SourceError as error:
        raise Refusal(422, str(error)) from None
    try:
        for part in images:
            flush_to_disk(part.path)
        (folder / IMAGES).mkdir(exist_ok=True)
        with database.write() as db:
            row = flights.row_of(db, flight_id)
            if row.completing:
                raise Refusal(409, "the flight is being completed; create another one")
            if row.error:
                raise Refusal(409, f"the flight cannot go on: {row.error}")
            flights.check_order(flights.last_name(db, flight_id), names)
            first = flights.image_count(db, flight_id)
            if first + len(images) > limits.images:
                raise Refusal(409, f"a flight has at most {limits.images} images; complete it and create another one")
            before = flights.images_of(db, flight_id, first - 1, 1)
            last_ns = before[0].t_ns if before else None
            if rows is not None:
                times = _table_times(rows, names, last_ns)
            else:
                photos = [(Path(part.name), info) for part, info in zip(images, infos, strict=True)]
                times = _photo_times(photos, _begin_ns(infos[0], folder, before))
            batch = []
            for frame_id, (part, suffix, info, t_ns) in enumerate(
                zip(images, suffixes, infos, times, strict=True), start=first
            ):
                stored = f"{IMAGES}/{frame_id:06d}{suffix}"
                os.replace(part.path, folder / stored)
                state = rows[part.name].state if rows is not None else _state(info, t_ns)
                state = _completed(state, new, t_ns)
                text = None if state is None else msgspec.json.encode(state).decode()
                batch.append(StoredImage(frame_id, part.name, stored, part.bytes, part.sha256, t_ns, text))
            flush_to_disk(folder / IMAGES)
            return flights.add_images(db, flight_id, batch)
    except OSError as error:
        raise Refusal(FULL, f"the upload cannot be stored ({error.strerror})") from None


def _telemetry(part: Part, names: list[str]) -> dict[str, Row]:
    """The table of a batch by image. Raises Refusal: it is not valid, or does not fit the images."""
    try:
        rows = {row.file: row for row in read_table(part.path, TELEMETRY, with_file=True)}
    except SourceError as error:
        raise Refusal(422, str(error).replace(str(part.path), TELEMETRY)) from None
    if set(rows) != set(names):
        raise Refusal(
            422, f"{TELEMETRY}: its rows are those of {len(rows)} other files; one row for each image of the batch"
        )
    return rows


def _table_times(rows: dict[str, Row], names: list[str], last_ns: int | None) -> list[int]:
    times = [rows[name].t_ns for name in names]
    for name, t_ns, before in zip(names, times, [last_ns, *times], strict=False):
        if before is not None and t_ns <= before:
            raise Refusal(409, f"{TELEMETRY}: t_s of {name} is not later than that of the image before")
    return times


def _begin_ns(first: PhotoInfo | None, folder: Path, before: list[StoredImage]) -> int:
    """Time of the first photo of a batch: 0 in a flight without images, else after the image ``before`` by what the
    camera states, or by a second."""
    if not before:
        return 0
    newest, step_s = read_info(folder / before[0].stored), UNTIMED_STEP_S
    if newest is not None and newest.taken is not None and first is not None and first.taken is not None:
        stated_s = (first.taken - newest.taken).total_seconds()
        step_s = stated_s if stated_s > 0.0 else step_s
    return before[0].t_ns + round(step_s * 1e9)


def _photo_times(photos: list[tuple[Path, PhotoInfo | None]], begin_ns: int) -> list[int]:
    """Times of photos in the order of their names, in ns: as the camera stated them, else one a second."""
    timed = {path.name: t_s for path, _, t_s in in_time_order(photos)}
    times: list[int] = []
    for path, _ in photos:
        t_ns = begin_ns + round(timed[path.name] * 1e9)
        if times and t_ns <= times[-1]:  # named in another order than taken
            t_ns = times[-1] + round(EXIF_STEP_S * 1e9)
        times.append(t_ns)
    return times


def _state(info: PhotoInfo | None, t_ns: int) -> VehicleState | None:
    return None if info is None else state_of(info, t_ns)


def _completed(state: VehicleState | None, new: NewFlight, t_ns: int) -> VehicleState | None:
    """``state`` with height and heading of the flight where the image has none, or where they override it."""
    agl_m = new.height_m
    yaw_rad = None if new.yaw_deg is None else math.remainder(math.radians(new.yaw_deg), math.tau)
    if state is None:
        if agl_m is None and yaw_rad is None:
            return None
        return VehicleState(t_ns=t_ns, source="operator", agl_m=agl_m, yaw_rad=yaw_rad)
    return msgspec.structs.replace(
        state,
        agl_m=agl_m if agl_m is not None and (new.override or state.agl_m is None) else state.agl_m,
        yaw_rad=yaw_rad if yaw_rad is not None and (new.override or state.yaw_rad is None) else state.yaw_rad,
    )


def copy_images(database: Database, flight_id: str, to: str, new: NewFlight, folders: tuple[Path, Path]) -> None:
    """Gives the images of a flight, and its hints, to another one that has none. ``folders``: of both. Files are
    linked: they are never written again."""
    source, target = folders
    (target / IMAGES).mkdir(parents=True, exist_ok=True)
    with database.write() as db:
        found = flights.images_of(db, flight_id, 0, flights.image_count(db, flight_id) + 1)
        copies = []
        for image in found:
            state = None if image.state is None else msgspec.json.decode(image.state, type=VehicleState)
            state = _completed(state, new, image.t_ns)
            text = None if state is None else msgspec.json.encode(state).decode()
            os.link(source / image.stored, target / image.stored)
            copies.append(replace(image, state=text, attempts=0))
        flights.add_images(db, to, copies)
        flights.copy_hints(db, flight_id, to)


class Slots:
    """At most so many at once; more are refused, not queued."""

    def __init__(self, most: int, what: str) -> None:
        self._most, self._what, self._used = most, what, 0

    @contextmanager
    def one(self) -> Iterator[None]:
        if self._used >= self._most:
            raise Refusal(429, f"{self._most} {self._what} at once are the limit; try again later")
        self._used += 1
        try:
            yield
        finally:
            self._used -= 1


async def take_batch(
    request: Request, database: Database, flight_id: str, folder: Path, limits: ServiceLimits, slots: Slots
) -> Accepted:
    """The whole way of a batch from the request into the flight. ``folder``: of the flight."""
    try:
        with slots.one(), incoming(folder) as temporary:
            check_room(folder, limits)
            parts = await parts_in_time(request, temporary, limits)
            return await asyncio.to_thread(store_batch, database, flight_id, folder, parts, limits)
    except Refusal:
        await drain(request)
        raise


async def parts_in_time(request: Request, folder: Path, limits: ServiceLimits) -> list[Part]:
    """As ``read_parts``, within the longest time of an upload."""
    try:
        async with asyncio.timeout(limits.upload_s):
            return await read_parts(request, folder, limits)
    except TimeoutError:
        raise Refusal(408, f"the upload took longer than {limits.upload_s:g} s; send smaller batches") from None


async def drain(request: Request) -> None:
    """Reads what is left of a body that is refused: a client that still sends would not read the answer."""
    left = DRAIN_BYTES
    with suppress(ClientDisconnect, RuntimeError, TimeoutError):  # RuntimeError: the body was read to its end
        async with asyncio.timeout(DRAIN_S):
            async for chunk in request.stream():
                left -= len(chunk)
                if left < 0:
                    return
