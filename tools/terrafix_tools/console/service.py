"""The state of a running console and what its routes do."""

import asyncio
import shutil
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import msgspec
from starlette.requests import Request

from terrafix.core.config import load
from terrafix_tools.console import uploads
from terrafix_tools.console.access import Access
from terrafix_tools.console.compute.description import stored_camera, stored_pixel
from terrafix_tools.console.compute.locating import Question
from terrafix_tools.console.events import ProcessingBlocked, StateChanged
from terrafix_tools.console.feed import Feeds
from terrafix_tools.console.locating import LocatingProcess
from terrafix_tools.console.maps import MapStore
from terrafix_tools.console.payloads import (
    Accepted,
    Flight,
    Flights,
    FlightState,
    Hint,
    MapState,
    NewFlight,
    ObjectGps,
    ObjectPixel,
    RecordingFile,
    Recordings,
    ServiceHealth,
    Steered,
    UserFix,
)
from terrafix_tools.console.problems import Refusal
from terrafix_tools.console.settings import Settings
from terrafix_tools.console.store import flights
from terrafix_tools.console.store.database import Database
from terrafix_tools.console.store.flights import StoredEvent
from terrafix_tools.console.workers import Reports, Workers

RECORDS = ("flight.mcap", "estimates.csv", "summary.json")
MEDIA_TYPES = {".jpg": "image/jpeg", ".png": "image/png"}


class Service:
    """One console. Methods without ``async`` may be called from any thread."""

    def __init__(self, settings: Settings, database: Database, access: Access) -> None:
        self.settings, self.database, self.access = settings, database, access
        self.maps = MapStore(settings.map_folders)
        self.feeds = Feeds(self._events_after)
        self.workers = Workers(settings, Reports(self.feeds.refresh, self._died, self._failed))
        self._locating = LocatingProcess(settings.limits.object_requests)
        self._uploads = uploads.Slots(settings.limits.uploads, "uploads")
        self._stopping = False

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

    def frame_image(self, flight_id: str, frame_id: int) -> tuple[Path, str]:
        """-> file and media type."""
        with self.database.read() as db:
            image = flights.image_of(db, flight_id, frame_id)
        path = self.settings.flight(flight_id) / image.stored
        return path, MEDIA_TYPES[path.suffix]

    def recordings(self, flight_id: str) -> Recordings:
        self.flight(flight_id)
        folder = self.settings.flight(flight_id) / "out"
        names = sorted(p.name for p in folder.iterdir() if p.is_file()) if folder.is_dir() else []
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
        return self.settings.flight(flight_id) / "out" / name

    async def events(self, flight_id: str, after: int) -> AsyncIterator[bytes]:
        if self.feeds.clients >= self.settings.limits.event_clients:
            raise Refusal(429, f"{self.settings.limits.event_clients} event streams are the limit; close others")
        flight = await asyncio.to_thread(self.flight, flight_id)
        return self.feeds.of(flight_id).stream(min(after, flight.last_event_id))

    # --- acting -----------------------------------------------------------------------------------

    def create(self, new: NewFlight) -> Flight:
        if new.map is None:
            raise Refusal(422, "area: this service has no map sources; start it with --sources FILE")
        stored_camera(new)  # raises SourceError: implausible values
        self.maps.check_start(new.map, new.start)
        with self.database.write() as db:
            if flights.count(db) >= self.settings.limits.flights:
                raise Refusal(429, f"{self.settings.limits.flights} flights are stored; delete some")
            flight_id = flights.create(db, new, new.map, MapState.READY)
            return flights.flight_of(db, flight_id)

    async def upload(self, request: Request, flight_id: str) -> Accepted:
        await asyncio.to_thread(self.flight, flight_id)
        folder = self.settings.flight(flight_id)
        return await uploads.take_batch(request, self.database, flight_id, folder, self.settings.limits, self._uploads)

    async def steer(self, flight_id: str, given: Hint | UserFix) -> Steered:
        def add() -> int:
            with self.database.write() as db:
                row = flights.row_of(db, flight_id)
                if row.state == FlightState.COMPLETED.value:
                    raise Refusal(409, "the flight is completed")
                if isinstance(given, UserFix):
                    flights.image_of(db, flight_id, given.frame_id)
                return flights.add_hint(db, flight_id, given)

        return Steered(hint_id=await asyncio.to_thread(add), detail="used with the next frame; hint_answered tells")

    async def locate(self, flight_id: str, frame_id: int, pixel: ObjectPixel) -> ObjectGps:
        def look() -> tuple[NewFlight, Path]:
            with self.database.read() as db:
                row = flights.row_of(db, flight_id)
                flights.image_of(db, flight_id, frame_id)
                if not flights.has_result(db, flight_id, frame_id):
                    raise Refusal(409, f"frame {frame_id} has no result yet; frame_processed tells when")
                return NewFlight.model_validate_json(row.spec), self.maps.path(row.map_name)

        new, map_path = await asyncio.to_thread(look)
        if pixel.pixel_x > new.camera.width - 0.5 or pixel.pixel_y > new.camera.height - 0.5:
            raise Refusal(422, f"the images have {new.camera.width}x{new.camera.height} pixels, from 0")
        answer = await self._locating.ask(
            Question(
                out=str(self.settings.flight(flight_id) / "out"),
                map=str(map_path),
                frame_id=frame_id,
                pixel=stored_pixel(pixel.pixel_x, pixel.pixel_y, new),
            )
        )
        if answer.refused:
            raise Refusal(409, answer.refused)
        return ObjectGps(
            gps=Gps(lat=round(answer.lat_deg, 8), lon=round(answer.lon_deg, 8)),
            accuracy_meters=round(answer.radius95_m, 2),
            altitude=None if answer.alt_amsl_m is None else round(answer.alt_amsl_m, 2),
            surface=answer.surface,
        )

    async def complete(self, flight_id: str) -> Flight:
        def mark() -> Flight:
            with self.database.write() as db:
                flights.row_of(db, flight_id)
                flights.update(db, flight_id, completing=True)
                return flights.flight_of(db, flight_id)

        flight = await asyncio.to_thread(mark)
        await self._wake(flight_id)
        return flight

    async def delete(self, flight_id: str) -> None:
        await asyncio.to_thread(self.flight, flight_id)
        await self.workers.end(flight_id)

        def remove() -> None:
            with self.database.write() as db:
                flights.delete(db, flight_id)
            shutil.rmtree(self.settings.flight(flight_id), ignore_errors=True)

        await asyncio.to_thread(remove)
        self.feeds.drop(flight_id)

    # --- life -------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Resumes what was not completed."""
        for flight in (await asyncio.to_thread(self.flights)).flights:
            pending = flight.completing or flight.images.processed < flight.images.uploaded
            if pending and flight.state is not FlightState.COMPLETED and not flight.error:
                await self._wake(flight.flight_id)

    async def stop(self) -> None:
        """In order: no more requests, streams end, processes end, the database is closed."""
        self._stopping = True
        self.feeds.close()
        await self.workers.stop()
        await self._locating.stop()
        self.database.close()

    async def _wake(self, flight_id: str) -> None:
        """Has the flight computed, if it has a map and anything to compute."""
        flight = await asyncio.to_thread(self.flight, flight_id)
        if flight.map.state is MapState.READY and flight.images.uploaded and not flight.error:
            await self.workers.wake(flight_id, await asyncio.to_thread(self.maps.path, flight.map.name))

    async def _died(self, flight_id: str, frame_id: int) -> None:
        def count() -> None:
            with self.database.write() as db:
                flights.count_attempt(db, flight_id, frame_id)

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

        await asyncio.to_thread(store)
        await self.feeds.refresh(flight_id)
