"""A Terrafix that runs on this computer, as a flight of the console: read from the bus, steered as by `terrafix hint`.

One thread reads the bus as an observer. Its publishers drop what does not fit into its queue and never wait for it."""

import json
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import msgspec

from terrafix.core.clock import now_ns
from terrafix.core.errors import TerrafixError
from terrafix.core.flight_id import live_flight_id
from terrafix.core.frames import SharedFrameStore
from terrafix.core.initial_position import SEARCH_START_SIGMA_M
from terrafix.messages import Frame, HintVerdict, MapMatch, Message, NavEstimate, Origin, Refinement, SearchPlaces
from terrafix.processes import PROCESSES
from terrafix.runtime.observer import Observer
from terrafix.runtime.run_dir import RunDir, live_runs
from terrafix.runtime.run_spec import Spec
from terrafix_tools.console.compute.observed import FlightObserver
from terrafix_tools.console.compute.steering import fix_message
from terrafix_tools.console.events import FlightCompleted
from terrafix_tools.console.payloads import FlightState, Hint, Start, UserFix, WholeVerdict
from terrafix_tools.console.store import flights
from terrafix_tools.console.store.database import Database
from terrafix_tools.flight_verdict import verdict_of
from terrafix_tools.hint.send import RADIUS_M
from terrafix_tools.hint.send import hint as send_hint
from terrafix_tools.log.edit import origin_of
from terrafix_tools.status.facts import facts
from terrafix_tools.status.processes import process_states
from terrafix_tools.status.state import KINDS, Status

AUTO = "auto"  # instead of a run folder: the only one that runs here
READ: tuple[type[Message], ...] = (*KINDS, HintVerdict, Refinement, SearchPlaces)
POLL_MS = 100
LOOK_S = 2.0  # between two looks for a run
HEALTH_S = 1.0
WAITING_FRAMES = 3  # frames that may wait for their map match: the anchor leaves out those that it has no time for
KEPT_EVENTS = 100_000  # of one live flight; older ones are deleted [spec: an hour at 10 Hz]
PRUNE_EVERY = 1000  # frames
JPEG_QUALITY = 80


@dataclass
class LiveRun:
    """A run that is followed. ``waiting``: messages of the newest frames, by frame."""

    run: RunDir
    flight_id: str
    out: Path
    map_path: Path | None
    observer: FlightObserver
    status: Status
    waiting: OrderedDict[int, list[Message]] = field(default_factory=OrderedDict)
    frames: int = 0
    has_start: bool = False  # the record says where it begins


def run_to_follow(bus: str) -> RunDir | None:
    """The run folder ``bus`` while its supervisor runs, or with AUTO the only one; None: there is none (yet)."""
    runs = live_runs() if bus == AUTO else live_runs(Path(bus).parent)
    if bus != AUTO:
        runs = [run for run in runs if run.path == Path(bus)]
    return runs[0] if len(runs) == 1 and runs[0].spec.is_file() and runs[0].epoch_ns is not None else None


def flight_id_of(run: RunDir) -> str:
    """The same for one run, whichever service follows it."""
    return live_flight_id(run.epoch_ns or 0)


class LiveFlights:
    """Follows the runs on this computer, one after the other. ``stored(flight_id)`` and ``health(flight_id, facts)``
    are called in the thread that reads the bus."""

    def __init__(
        self,
        database: Database,
        bus: str,
        stored: Callable[[str], None],
        health: Callable[[str, dict[str, Any]], None],
    ) -> None:
        self._database, self._bus = database, bus
        self._stored, self._health = stored, health
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="live", daemon=True)
        self._hints = threading.Lock()
        self.current: LiveRun | None = None
        self.facts: dict[str, Any] | None = None

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def steer(self, flight_id: str, given: Hint | UserFix) -> str:
        """Sends a hint, waits for its result and returns it as text. Raises TerrafixError: no run, or no answer; a fix
        that cannot be used."""
        live = self.current
        if live is None or live.flight_id != flight_id:
            raise TerrafixError("this flight is over")
        with self._hints:  # the bus takes one operator at a time
            if isinstance(given, Hint):
                return send_hint(given.lat, given.lon, given.radius_m, str(live.run.path))
            camera = origin_of(live.out).camera
            pixel = (given.pixel.u, given.pixel.v)
            message = fix_message(given, pixel, camera, live.observer.estimates, now_ns())
            if message is None:
                raise TerrafixError("that frame has no attitude, or the pixel shows no ground; choose another")
            radius_m = min(max(message.radius_m, RADIUS_M[0]), RADIUS_M[1])
            fix = message.frame_id, message.sigma_m
            return send_hint(message.lat_deg, message.lon_deg, radius_m, str(live.run.path), fix)

    def frame_jpeg(self, flight_id: str, frame_id: int) -> bytes | None:
        """The pixels of a frame that is still in the ring of the run."""
        live = self.current
        if live is None or live.flight_id != flight_id:
            return None
        store = SharedFrameStore(live.run.frames)
        try:
            image = store.get(frame_id)
        finally:
            store.close()
        if image is None:
            return None
        done, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        return jpeg.tobytes() if done else None

    # --- the thread -------------------------------------------------------------------------------

    def _follow(self) -> None:
        with self._database.read() as db:
            unfinished = flights.unfinished_live(db)
        while not self._stop.wait(LOOK_S if self.current is None else 0.0):
            run = run_to_follow(self._bus)
            followed = "" if run is None else flight_id_of(run)
            for flight_id in unfinished - {followed}:  # they ended while no service followed them
                self._complete_missed(flight_id)
            unfinished &= {followed}
            if run is not None and self._follow_run(run):
                unfinished = set()

    def _follow_run(self, run: RunDir) -> bool:
        """Follows a run until it ends. -> False: it had ended already."""
        try:
            spec = msgspec.json.decode(run.spec.read_bytes(), type=Spec)
        except OSError:
            return False
        live = self._begin(run, spec)
        self.current = live
        next_health_s = time.monotonic() + HEALTH_S
        with Observer(run, READ, PROCESSES) as observer:
            while run.spec.exists() and not self._stop.is_set():
                messages = observer.receive(POLL_MS)
                if messages:
                    self._take(live, messages)
                if time.monotonic() >= next_health_s:
                    next_health_s = time.monotonic() + HEALTH_S
                    self._read_start(live)
                    self.facts = facts(live.status, process_states(run, now_ns()), now_ns())
                    self._health(live.flight_id, self.facts)
        if not run.spec.exists():
            self._complete(live)
        self.current = self.facts = None
        return True

    def _begin(self, run: RunDir, spec: Spec) -> LiveRun:
        flight_id, epoch_ns = flight_id_of(run), run.epoch_ns
        observer = FlightObserver(lambda frame_id: f"/flights/{flight_id}/frames/{frame_id}/image")
        observer.origin_ns, observer.flight_id = epoch_ns or 0, flight_id
        map_path = None if spec.map_path is None else Path(spec.map_path)
        with self._database.write() as db:
            flights.create_live(
                db,
                flight_id,
                name=Path(spec.out_dir).name,
                map_name="" if map_path is None else map_path.stem,
                created_at=datetime.now(UTC).isoformat(timespec="milliseconds"),
            )
        live = LiveRun(run, flight_id, Path(spec.out_dir), map_path, observer, Status(now_ns()))
        live.observer.resume(self._state_of(flight_id))
        return live

    def _read_start(self, live: LiveRun) -> None:
        """Stores the start that the source of the run gave, as soon as the record has it."""
        if live.has_start:
            return
        try:
            origin = origin_of(live.out)
        except TerrafixError:
            return  # not written yet
        live.has_start = True
        if origin.start_sigma_m > SEARCH_START_SIGMA_M:
            return  # the middle of the map, which is searched
        start = Start(lat=origin.lat_deg, lon=origin.lon_deg, sigma_m=origin.start_sigma_m)
        with self._database.write() as db:
            flights.update(db, live.flight_id, spec=json.dumps({"start": start.model_dump()}))

    def _state_of(self, flight_id: str) -> FlightState:
        with self._database.read() as db:
            return FlightState(flights.row_of(db, flight_id).state)

    def _take(self, live: LiveRun, messages: list[Message]) -> None:
        """Stores what is known of the frames that are complete."""
        done: list[list[Message]] = []
        for message in messages:
            live.status.take(now_ns(), message)
            if isinstance(message, (Frame, NavEstimate, MapMatch)):
                self._collect(live, message, done)
            elif not isinstance(message, Origin):
                live.observer.take([message])
        if not done:
            return
        with self._database.write() as db:
            for of_frame in done:
                live.observer.take(of_frame)
                outcome = live.observer.frame_done()
                assert outcome.result is not None
                flights.store_outcome(db, live.flight_id, f"frame {outcome.result.frame_id}", outcome)
                live.frames += 1
                if live.frames % PRUNE_EVERY == 0:
                    flights.forget_events(db, live.flight_id, KEPT_EVENTS)
        self._stored(live.flight_id)

    @staticmethod
    def _collect(live: LiveRun, message: Frame | NavEstimate | MapMatch, done: list[list[Message]]) -> None:
        """Adds a message to those of its frame, and to ``done`` the messages of frames that nothing follows for."""
        waiting = live.waiting
        if isinstance(message, Frame):
            waiting[message.frame_id] = [message]
        elif message.frame_id in waiting:
            waiting[message.frame_id].append(message)
            kinds = [type(m) for m in waiting[message.frame_id]]
            if isinstance(message, NavEstimate) and MapMatch in kinds:
                done.append(waiting.pop(message.frame_id))
        while len(waiting) > WAITING_FRAMES:
            done.append(waiting.popitem(last=False)[1])

    def _complete_missed(self, flight_id: str) -> None:
        """Of a flight whose end no service has seen only the number of stored frames is known."""
        with self._database.write() as db:
            statistics = {"frames": flights.result_count(db, flight_id)}
            flights.complete(db, flight_id, FlightCompleted(statistics=statistics))
        self._stored(flight_id)

    def _complete(self, live: LiveRun) -> None:
        try:
            verdict = WholeVerdict.model_validate(verdict_of(live.out).as_json())
        except TerrafixError:  # its record was moved, or was never written
            verdict = None
        with self._database.write() as db:
            for of_frame in live.waiting.values():
                live.observer.take(of_frame)
                outcome = live.observer.frame_done()
                assert outcome.result is not None
                flights.store_outcome(db, live.flight_id, f"frame {outcome.result.frame_id}", outcome)
            flights.complete(db, live.flight_id, live.observer.completed(verdict))
        self._stored(live.flight_id)
