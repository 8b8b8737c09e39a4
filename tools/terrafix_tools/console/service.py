"""The state of a running console and what its routes do."""

import asyncio
import importlib.util
import re
import shutil
from collections.abc import AsyncIterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from starlette.requests import Request
from starlette.responses import FileResponse, Response

from terrafix.core.config import load
from terrafix_tools.console import uploads
from terrafix_tools.console.access import Access
from terrafix_tools.console.areas import AreaMaps, check_area
from terrafix_tools.console.compute.description import stored_camera, stored_pixel
from terrafix_tools.console.events import Health, ProcessingBlocked, StateChanged
from terrafix_tools.console.exports import Exports
from terrafix_tools.console.feed import Feeds
from terrafix_tools.console.locating import LocatingProcess, Question
from terrafix_tools.console.maps import MapStore
from terrafix_tools.console.payloads import (
    Accepted,
    ExportChoice,
    Flight,
    FlightConfig,
    FlightKind,
    Flights,
    FlightState,
    Gps,
    Hint,
    MapState,
    NewFlight,
    ObjectGps,
    ObjectPixel,
    PhotoFacts,
    RecordingFile,
    Recordings,
    RouteArea,
    ServiceHealth,
    Steered,
    UserFix,
)
from terrafix_tools.console.photo_facts import photo_facts
from terrafix_tools.console.problems import FULL, Refusal
from terrafix_tools.console.settings import Settings
from terrafix_tools.console.store import flights
from terrafix_tools.console.store.database import Database
from terrafix_tools.console.store.flights import StoredEvent
from terrafix_tools.console.workers import Reports, Workers
from terrafix_tools.export.formats import FORMATS, Format
from terrafix_tools.export.track import FINALISED, WHICH
from terrafix_tools.finalised import TABLE

if TYPE_CHECKING:
    from terrafix_tools.console.live import LiveFlights

RECORDING = re.compile(r"[a-z0-9-]+\.(mcap|csv|json)(\.partial)?")
USED_NEXT = "used with the next frame; hint_answered tells what came of it"
USED_BY_COPY = "all images are computed; it is used with the next images, or when the flight is computed again"
MEDIA_TYPES = {".jpg": "image/jpeg", ".png": "image/png"}


class Service:
    """One console. Methods without ``async`` may be called from any thread."""

    def __init__(self, settings: Settings, database: Database, access: Access) -> None:
        self.settings, self.database, self.access = settings, database, access
        self.maps = MapStore(settings.map_folders)
        self.feeds = Feeds(self._events_after)
        self.workers = Workers(settings, Reports(self.feeds.refresh, self._died, self._failed))
        self.live = self._live_flights(settings.bus) if settings.bus is not None else None
        self._areas = AreaMaps(settings.map_folders[0], settings.sources, self._map_done)
        self._locating = LocatingProcess(settings.limits.object_requests)
        self._exports = Exports()
        self._uploads = uploads.Slots(settings.limits.uploads, "uploads")
        self._stopping = False

    def _live_flights(self, bus: str) -> "LiveFlights":
        from terrafix_tools.console.live import LiveFlights  # imports the estimator, which nothing else here needs

        return LiveFlights(self.database, bus, self._live_stored, self._live_health)

    def _events_after(self, flight_id: str, after: int) -> list[StoredEvent]:
        with self.database.read() as db:
            return flights.events_after(db, flight_id, after)

    # --- reading ----------------------------------------------------------------------------------

    def health(self, version: str) -> ServiceHealth:
        with self.database.read() as db:
            stored = flights.count(db)
        return ServiceHealth(
            status="stopping" if self._stopping else "ok",
            version=version,
            workers=self.workers.count,
            max_workers=self.settings.workers,
            waiting=self.workers.waiting,
            flights=stored,
            event_clients=self.feeds.clients,
            disk_free_mb=shutil.disk_usage(self.settings.data).free // 2**20,
            live=None if self.live is None else self.live.facts,
        )

    def config(self) -> dict[str, Any]:
        settings = self.settings
        service = {
            "host": settings.host,
            "port": settings.port,
            "tokens_required": self.access.required,
            "tls": settings.cert is not None,
            "workers": settings.workers,
            "areas": settings.sources is not None,
            "limits": vars(settings.limits),
        }
        return {"service": service, "flights": msgspec.to_builtins(load(list(settings.configs)))}

    def flights(self) -> Flights:
        with self.database.read() as db:
            return Flights(flights=flights.all_flights(db))

    def flight(self, flight_id: str) -> Flight:
        with self.database.read() as db:
            return flights.flight_of(db, flight_id)

    def flight_config(self, flight_id: str) -> FlightConfig:
        with self.database.read() as db:
            row = flights.row_of(db, flight_id)
        spec = msgspec.json.decode(row.spec)
        return FlightConfig(flight_id=flight_id, map=row.map_name, flight=spec, config=self.config()["flights"])

    def frame_image(self, flight_id: str, frame_id: int) -> Response:
        flight = self.flight(flight_id)
        headers = {"cache-control": "private, max-age=3600"}
        if flight.kind is FlightKind.LIVE:
            jpeg = None if self.live is None else self.live.frame_jpeg(flight_id, frame_id)
            if jpeg is None:
                raise Refusal(404, f"frame {frame_id} is no longer in memory; the record has it")
            return Response(jpeg, media_type="image/jpeg", headers=headers)
        with self.database.read() as db:
            image = flights.image_of(db, flight_id, frame_id)
        path = self.settings.flight(flight_id) / image.stored
        if not path.is_file():
            raise Refusal(404, f"the file of frame {frame_id} is gone from the disk of the console")
        return FileResponse(path, media_type=MEDIA_TYPES[path.suffix], headers=headers)

    def _out(self, flight: Flight) -> Path:
        """The folder with the record of a flight."""
        if flight.kind is FlightKind.BATCH:
            return self.settings.flight(flight.flight_id) / "out"
        live = None if self.live is None else self.live.current
        if live is None or live.flight_id != flight.flight_id:
            raise Refusal(404, "this flight is over; its record lies where Terrafix wrote it")
        return live.out

    def recordings(self, flight_id: str) -> Recordings:
        folder = self._out(self.flight(flight_id))
        found = [p.name for p in folder.iterdir() if p.is_file()] if folder.is_dir() else []
        # What was finalised comes first: it replaces the estimates.
        names = sorted((name for name in found if RECORDING.fullmatch(name)), key=lambda name: (name != TABLE, name))
        files = [
            RecordingFile(
                name=name, bytes=(folder / name).stat().st_size, url=f"/flights/{flight_id}/recordings/{name}"
            )
            for name in names
        ]
        return Recordings(files=files)

    def recording(self, flight_id: str, name: str) -> Path:
        if name not in [file.name for file in self.recordings(flight_id).files]:
            raise Refusal(404, f"flight {flight_id} has no file {name}")
        return self._out(self.flight(flight_id)) / name

    def export_choice(self, flight_id: str) -> ExportChoice:
        flight = self.flight(flight_id)
        batch, final = flight.kind is FlightKind.BATCH, (self._out(flight) / TABLE).is_file()

        def can(chosen: Format) -> bool:
            there = not chosen.library or importlib.util.find_spec(chosen.library) is not None
            return there and (batch or not chosen.needs_photos)

        return ExportChoice(
            formats=[name for name, chosen in FORMATS.items() if can(chosen)],
            which=[which for which in WHICH if final or which != FINALISED],
        )

    async def export(self, flight_id: str, kind: str, which: str) -> Response:
        def of_flight() -> tuple[Path, str, dict[str, Path]]:
            flight, choice = self.flight(flight_id), self.export_choice(flight_id)
            if kind not in choice.formats or which not in choice.which:
                raise Refusal(404, f"{kind}, {which}: give one of {choice.formats} and of {choice.which}")
            with self.database.read() as db:
                images = flights.images_of(db, flight_id, 0, self.settings.limits.images)
            folder, copied = self.settings.flight(flight_id), FORMATS[kind].needs_photos
            out = self._out(flight)
            if not out.is_dir():
                raise Refusal(409, "no image of this flight is computed yet; export it when there is a position")
            needed = 2 * sum(image.bytes for image in images) if copied else 0  # copies, and their zip file
            uploads.check_room(out.parent, self.settings.limits, needed)
            return out, flight.name or flight_id, {image.name: folder / image.stored for image in images}

        out, title, photos = await asyncio.to_thread(of_flight)
        return await self._exports.make(out, title, kind, which, photos)

    async def events(self, flight_id: str, after: int) -> AsyncIterator[bytes]:
        if self.feeds.clients >= self.settings.limits.event_clients:
            raise Refusal(429, f"{self.settings.limits.event_clients} event streams are the limit; close others")
        flight = await asyncio.to_thread(self.flight, flight_id)
        return self.feeds.of(flight_id).stream(min(after, flight.last_event_id))

    async def photo_facts(self, request: Request) -> PhotoFacts:
        return await photo_facts(request, self.settings.limits, self._uploads)

    # --- acting -----------------------------------------------------------------------------------

    async def create(self, new: NewFlight) -> Flight:
        flight = await asyncio.to_thread(self._create, new)
        if new.area is not None:
            self._areas.begin(flight.flight_id, new.area)
        return flight

    def _create(self, new: NewFlight) -> Flight:
        stored_camera(new)  # raises SourceError: implausible values
        if new.map is not None:
            self.maps.check_start(new.map, new.start)
        elif new.area is not None:
            check_area(new.area)
            if not self._areas.available:
                raise Refusal(422, "area: this service has no map sources; give map, or start it with --sources FILE")
        with self.database.write() as db:
            if flights.count(db) >= self.settings.limits.flights:
                raise Refusal(429, f"{self.settings.limits.flights} flights are stored; delete some")
            return flights.create(db, new)

    async def upload(self, request: Request, flight_id: str) -> Accepted:
        flight = await asyncio.to_thread(self.flight, flight_id)
        if flight.kind is FlightKind.LIVE:
            raise Refusal(409, "the frames of a live flight come from its camera")
        folder = self.settings.flight(flight_id)
        limits = self.settings.limits
        accepted = await uploads.take_batch(request, self.database, flight_id, folder, limits, self._uploads)
        await self._wake(flight_id)
        return accepted

    async def copy(self, flight_id: str, new: NewFlight) -> Flight:
        """A new flight with the images and hints of another one."""
        old = await asyncio.to_thread(self.flight, flight_id)
        if old.kind is FlightKind.LIVE or old.images.uploaded == 0:
            raise Refusal(409, "the flight has no images to copy")
        made = await self.create(new.model_copy(update={"images": old.images.uploaded}))
        folders = self.settings.flight(flight_id), self.settings.flight(made.flight_id)
        try:
            await asyncio.to_thread(uploads.copy_images, self.database, flight_id, made.flight_id, new, folders)
        except OSError as error:
            await self.delete(made.flight_id)
            raise Refusal(FULL, f"the images cannot be copied ({error.strerror})") from None
        await self._wake(made.flight_id)
        return await asyncio.to_thread(self.flight, made.flight_id)

    async def retry(self, flight_id: str) -> Flight:
        def store() -> Flight:
            with self.database.write() as db:
                return flights.retry(db, flight_id)

        flight = await asyncio.to_thread(store)
        self.workers.forgive(flight_id)
        await self.feeds.refresh(flight_id)
        for preparing, area in await asyncio.to_thread(self._maps_to_make):
            if preparing == flight_id:
                self._areas.begin(flight_id, area)
        await self._wake(flight_id)
        return flight

    async def steer(self, flight_id: str, given: Hint | UserFix) -> Steered:
        flight = await asyncio.to_thread(self.flight, flight_id)
        if flight.kind is FlightKind.LIVE and self.live is not None:
            return Steered(hint_id=0, detail=await asyncio.to_thread(self.live.steer, flight_id, given))

        def add() -> int:
            with self.database.write() as db:
                row = flights.row_of(db, flight_id)
                if row.state == FlightState.COMPLETED.value:
                    raise Refusal(409, "the flight is completed")
                if isinstance(given, UserFix):
                    flights.image_of(db, flight_id, given.frame_id)
                    _check_pixel(given.pixel.u, given.pixel.v, NewFlight.model_validate_json(row.spec))
                return flights.add_hint(db, flight_id, given)

        hint_id = await asyncio.to_thread(add)
        await self.feeds.refresh(flight_id)
        through = flight.images.processed >= flight.images.uploaded
        return Steered(hint_id=hint_id, detail=USED_BY_COPY if through else USED_NEXT)

    async def locate(self, flight_id: str, frame_id: int, pixel: ObjectPixel) -> ObjectGps:
        answer = await self._locating.ask(await asyncio.to_thread(self._question, flight_id, frame_id, pixel))
        if answer.refused:
            raise Refusal(409, answer.refused)
        return ObjectGps(
            gps=Gps(lat=round(answer.lat_deg, 8), lon=round(answer.lon_deg, 8)),
            accuracy_meters=round(answer.radius95_m, 2),
            altitude=None if answer.alt_amsl_m is None else round(answer.alt_amsl_m, 2),
            surface=answer.surface,
            consistent=answer.consistent,
        )

    def _question(self, flight_id: str, frame_id: int, pixel: ObjectPixel) -> Question:
        flight = self.flight(flight_id)
        out = self._out(flight)
        pixels = [(frame_id, (pixel.pixel_x, pixel.pixel_y))]
        pixels += [(other.frame_id, (other.pixel_x, other.pixel_y)) for other in pixel.others]
        with self.database.read() as db:
            for seen, _ in pixels:
                if not flights.has_result(db, flight_id, seen):
                    raise Refusal(404, f"flight {flight_id} has no result of frame {seen}; frame_processed tells when")
            row = flights.row_of(db, flight_id)
        if flight.kind is FlightKind.LIVE:
            map_path = None if self.live is None or self.live.current is None else self.live.current.map_path
        else:
            new = NewFlight.model_validate_json(row.spec)
            map_path = self.maps.path(row.map_name)
            for _, uv in pixels:
                _check_pixel(*uv, new)
            pixels = [(seen, stored_pixel(*uv, new)) for seen, uv in pixels]
        return Question(out=str(out), map="" if map_path is None else str(map_path), pixels=pixels)

    async def complete(self, flight_id: str) -> Flight:
        def mark() -> Flight:
            with self.database.write() as db:
                if flights.row_of(db, flight_id).kind == FlightKind.LIVE.value:
                    raise Refusal(409, "a live flight ends with its Terrafix")
                if flights.image_count(db, flight_id) == 0:
                    raise Refusal(409, "the flight has no images; upload some, or delete it")
                flights.update(db, flight_id, completing=True)
                return flights.flight_of(db, flight_id)

        flight = await asyncio.to_thread(mark)
        await self._wake(flight_id)
        return flight

    async def delete(self, flight_id: str) -> None:
        await asyncio.to_thread(self.flight, flight_id)
        await self.workers.end(flight_id)
        await self._areas.remove(flight_id)

        def remove() -> None:
            with self.database.write() as db:
                flights.delete(db, flight_id)
            shutil.rmtree(self.settings.flight(flight_id), ignore_errors=True)

        await asyncio.to_thread(remove)
        self.feeds.drop(flight_id)

    # --- life -------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Resumes what was not completed."""
        self._loop = asyncio.get_running_loop()
        if self.live is not None:
            self.live.start()
        for flight_id, area in await asyncio.to_thread(self._maps_to_make):
            self._areas.begin(flight_id, area)
        for flight in (await asyncio.to_thread(self.flights)).flights:
            if flight.kind is FlightKind.LIVE:
                continue
            pending = flight.completing or flight.images.processed < flight.images.uploaded
            if pending and flight.state is not FlightState.COMPLETED and not flight.error:
                await self._wake(flight.flight_id)

    async def stop(self) -> None:
        """In order: no more requests, streams end, processes end, the database is closed."""
        self._stopping = True
        self.feeds.close()
        if self.live is not None:
            await asyncio.to_thread(self.live.stop)
        await self._areas.stop()
        await self.workers.stop()
        await self._locating.stop()
        self.database.close()

    def _live_stored(self, flight_id: str) -> None:
        asyncio.run_coroutine_threadsafe(self.feeds.refresh(flight_id), self._loop)

    def _live_health(self, flight_id: str, found: dict[str, Any]) -> None:
        self._loop.call_soon_threadsafe(self.feeds.pass_on, flight_id, Health(facts=found))

    def _maps_to_make(self) -> list[tuple[str, RouteArea]]:
        with self.database.read() as db:
            return flights.maps_to_make(db)

    async def _map_done(self, flight_id: str, error: str) -> None:
        if error:
            await self._failed(flight_id, error)

        def store() -> None:
            with self.database.write() as db:
                state = MapState.FAILED if error else MapState.READY
                flights.update(db, flight_id, map_state=state.value, map_detail=error)

        await asyncio.to_thread(store)
        with suppress(Refusal):  # the flight was deleted meanwhile
            await self._wake(flight_id)

    async def _wake(self, flight_id: str) -> None:
        """Has the flight computed, if it has a map and anything to compute."""
        flight = await asyncio.to_thread(self.flight, flight_id)
        if flight.map.state is MapState.READY and flight.images.uploaded and not flight.error:
            await self.workers.wake(flight_id, await asyncio.to_thread(self.maps.path, flight.map.name))

    async def _died(self, flight_id: str, frame_id: int) -> None:
        def count() -> None:
            with self.database.write() as db:
                flights.count_attempt(db, flight_id, frame_id)

        with suppress(Refusal):  # the flight was deleted meanwhile
            await asyncio.to_thread(count)

    async def _failed(self, flight_id: str, why: str) -> None:
        """The flight cannot go on: it is blocked, with the reason."""

        def store() -> None:
            with self.database.write() as db:
                state = FlightState(flights.row_of(db, flight_id).state)
                changed = StateChanged(state=FlightState.BLOCKED, previous=state)
                blocked = ProcessingBlocked(reason=why, frame_id=None)
                flights.add_events(db, flight_id, "failed", [blocked, changed])
                flights.update(db, flight_id, state=FlightState.BLOCKED.value, error=why)

        with suppress(Refusal):  # the flight was deleted meanwhile
            await asyncio.to_thread(store)
            await self.feeds.refresh(flight_id)


def _check_pixel(u: float, v: float, new: NewFlight) -> None:
    """Raises Refusal: outside the images."""
    if u > new.camera.width - 0.5 or v > new.camera.height - 0.5:
        raise Refusal(422, f"the images have {new.camera.width}x{new.camera.height} pixels, from 0")
