"""A Terrafix that runs on this computer, as a flight of the console."""

import json
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zmq

from console_rig import Console, settings
from flight_records import estimate, frame
from map_matches import with_search
from terrafix import messages as m
from terrafix.core.config import Config
from terrafix.processes import PROCESSES
from terrafix.runtime import run_dir
from terrafix.runtime.bus import Publisher
from terrafix.runtime.observer import COUNTED
from terrafix.runtime.run_dir import OwnedRunDir, RunDir
from terrafix.runtime.run_spec import spec_of
from terrafix_tools.console import live
from terrafix_tools.console.store import flights

pytestmark = pytest.mark.real_time
WAIT_S = 30.0
SAID = m.SourceFacts(t_ns=0, facts=(m.Fact("clock", "by arrival"),))


@pytest.fixture
def owned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> OwnedRunDir:
    shm = tmp_path / "shm"
    shm.mkdir()
    monkeypatch.setattr(run_dir, "SHM", shm)
    monkeypatch.setattr(live, "LOOK_S", 0.02)
    spec = spec_of(PROCESSES, Config(), tmp_path / "place.gpkg", tmp_path / "out")
    made = OwnedRunDir(spec=msgspec.json.encode(spec))
    made.run_dir.set_epoch(0)
    return made


class LiveProcesses:
    """Processes that publish a frame with its estimate and match every 20 ms. ``lost``: a search asks for help."""

    def __init__(self, run: RunDir) -> None:
        self._run = run
        self.lost = threading.Event()
        self._stop = threading.Event()
        self.intervals_s: list[float] = []
        self.counted = 0
        self._thread = threading.Thread(target=self._fly)
        self._thread.start()

    def _fly(self) -> None:
        with zmq.Context() as context:
            publishers: dict[type[m.Message], Publisher] = {
                kind: Publisher(context, self._run.address(name))
                for name, kind in {"vision": m.Frame, "anchor": m.MapMatch, "estimator": m.NavEstimate}.items()
            }
            publishers[m.SearchPlaces] = publishers[m.MapMatch]
            publishers[m.Frame].publish(SAID)
            before_s, i = time.monotonic(), 0
            while not self._stop.wait(0.02):
                located = estimate(i, 1.0 * i, 0.0)
                match = m.MapMatch(t_ns=located.t_ns, frame_id=i, verdict=m.Verdict.ACCEPTED, matcher="gradient")
                searches: list[m.Message] = []
                if self.lost.is_set():
                    match = with_search(msgspec.structs.replace(match, verdict=m.Verdict.LOST), step=m.SearchStep.ASK)
                    searches = [m.SearchPlaces(t_ns=0, frame_id=i, tiles=None, places=[(48.1, 11.2)], half_size_m=90.0)]
                for message in (frame(i), *searches, match, located):
                    publishers[type(message)].publish(message)
                now_s = time.monotonic()
                self.intervals_s.append(now_s - before_s)
                before_s, i = now_s, i + 1
            self.counted = sum(p.subscriptions(kind) for p in publishers.values() for kind in COUNTED)
            for publisher in publishers.values():
                publisher.close()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()


@pytest.fixture
def flying(owned: OwnedRunDir) -> Iterator[LiveProcesses]:
    running = LiveProcesses(owned.run_dir)
    yield running
    running.stop()
    owned.remove()


def soon(found: Callable[[], Any]) -> Any:
    """The first result that is not empty."""
    end = time.monotonic() + WAIT_S
    while not (result := found()):
        assert time.monotonic() < end
        time.sleep(0.02)
    return result


def test_a_live_flight_has_results_events_health_and_an_end(
    owned: OwnedRunDir, flying: LiveProcesses, tmp_path: Path
) -> None:
    chosen = settings(tmp_path / "data", bus=str(owned.run_dir.path))
    with Console(chosen) as console:
        (flight,) = soon(lambda: console.send("GET", "/flights").json["flights"])
        flight_id = flight["flight_id"]
        assert (flight["kind"], flight["map"]["name"], flight["name"]) == ("live", "place", "out")
        names = [name for _, name, _ in console.events(flight_id, 0, 6)]
        assert set(names) <= {"frame_processed", "health"} and "frame_processed" in names
        soon(lambda: console.send("GET", "/health").json["live"])
        live = console.send("GET", "/health").json["live"]
        assert live["position"]["source"] == "satellite_anchored"
        assert live["source"] == [{"topic": "clock", "text": "by arrival"}]  # said before
        result = console.send("GET", f"/flights/{flight_id}/results?limit=1").json["results"][0]
        assert (result["match"], result["gps"]["lat"]) == ("accepted", pytest.approx(48.0, abs=1e-3))
        for path in ("images/batch", "complete"):
            assert console.send("POST", f"/flights/{flight_id}/{path}").status == 409
        seen = console.send("GET", f"/flights/{flight_id}").json["last_event_id"]
    with Console(chosen) as console:  # the same flight goes on, with the next ids
        soon(lambda: console.send("GET", f"/flights/{flight_id}").json["last_event_id"] > seen)
        owned.run_dir.spec.unlink()
        soon(lambda: console.send("GET", f"/flights/{flight_id}").json["state"] == "completed")
        with console.service.database.read() as db:
            events = flights.events_after(db, flight_id, 0, 100_000)
        assert [e.event_id for e in events] == [*range(1, len(events) + 1)]
        frames = [e.data for e in events if e.name == "frame_processed"]
        assert len(frames) == len(set(frames))
    flying.stop()
    assert flying.counted == 0  # it is not taken for the recorder


def test_a_flight_that_ended_without_a_service_is_completed_by_the_next_one(
    owned: OwnedRunDir, flying: LiveProcesses, tmp_path: Path
) -> None:
    chosen = settings(tmp_path / "data", bus=str(owned.run_dir.path))
    with Console(chosen) as console:
        (flight,) = soon(lambda: console.send("GET", "/flights").json["flights"])
        path = f"/flights/{flight['flight_id']}"
        soon(lambda: console.send("GET", path).json["last_event_id"] > 0)
    owned.run_dir.spec.unlink()
    with Console(chosen) as console:
        soon(lambda: console.send("GET", path).json["state"] == "completed")
        with console.service.database.read() as db:
            names = [e.name for e in flights.events_after(db, flight["flight_id"], 0, 100_000)]
        assert names[-2:] == ["flight_completed", "state_changed"]


def test_a_live_flight_that_is_lost_shows_the_places_of_its_search(
    owned: OwnedRunDir, flying: LiveProcesses, tmp_path: Path
) -> None:
    with Console(settings(tmp_path / "data", bus=str(owned.run_dir.path))) as console:
        (flight,) = soon(lambda: console.send("GET", "/flights").json["flights"])
        path = f"/flights/{flight['flight_id']}"
        soon(lambda: console.send("GET", path).json["last_event_id"] > 0)
        flying.lost.set()
        request = soon(lambda: console.send("GET", path).json["request"])
        with console.service.database.read() as db:
            events = flights.events_after(db, flight["flight_id"], 0, 100_000)
        (needed,) = [json.loads(e.data) for e in events if e.name == "user_input_needed"]
        assert needed["request_id"] == request["request_id"]
        assert needed["candidate_tiles"] == [{"rank": 1, "gps": {"lat": 48.1, "lon": 11.2}, "half_size_m": 90.0}]


def test_a_hint_goes_the_way_of_the_command(
    owned: OwnedRunDir, flying: LiveProcesses, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[Any] = []
    monkeypatch.setattr(live, "send_hint", lambda *given: sent.append(given) or "hint agrees, 3 m from the estimate")
    with Console(settings(tmp_path / "data", bus=str(owned.run_dir.path))) as console:
        (flight,) = soon(lambda: console.send("GET", "/flights").json["flights"])
        path = f"/flights/{flight['flight_id']}/hint"
        answer = console.send("POST", path, {"lat": 1.5, "lon": 2.5, "radius_m": 700})
        assert (answer.status, answer.json["detail"]) == (202, "hint agrees, 3 m from the estimate")
        assert sent == [(1.5, 2.5, 700.0, str(owned.run_dir.path))]


def test_a_console_that_hangs_does_not_slow_down_the_flight(
    owned: OwnedRunDir, flying: LiveProcesses, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The thread that reads the bus stops reading while 200 frames are published."""
    hang = threading.Event()
    monkeypatch.setattr(live.LiveFlights, "_take", lambda *_: hang.wait(WAIT_S))
    with Console(settings(tmp_path / "data", bus=str(owned.run_dir.path))) as console:
        soon(lambda: console.send("GET", "/flights").json["flights"])
        first = len(flying.intervals_s)
        soon(lambda: len(flying.intervals_s) >= first + 200)
        hang.set()
    alone = flying.intervals_s[:first] or flying.intervals_s
    assert sorted(flying.intervals_s[first:])[100] < 3 * sorted(alone)[len(alone) // 2] + 0.02
