"""Flights over HTTP on recorded frames: every flow of the console, from the start of the service to its end.

A file of frames.csv is uploaded by a number of its own, so that frames of one flight can be flown in another order."""

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from console_rig import Served, Watched
from terrafix.core.geodesy import LocalFrame
from terrafix_tools.console.client import ConsoleClient
from terrafix_tools.console.payloads import (
    Flight,
    FrameResult,
    Hint,
    NewFlight,
    ObjectGps,
    ObjectPixel,
    PixelPoint,
    UserFix,
)

pytestmark = pytest.mark.slow

ROUTE = (0, 48, 60, 84, 100)  # frames of village-1 whose places are the waypoints
CORRIDOR_M = 100.0
ON_ROUTE, OFF_ROUTE = range(37, 100, 6), range(240, 320, 8)  # frames that show the corridor, and none of it
BEGIN, RETURN = range(0, 40, 4), range(176, 220, 4)  # frames on the route; from beside it back to its beginning
PERIOD_S, GAP_S = 0.5, 5.0  # between frames of the flight [s], and where some are left out
GAP_FRAMES = 20
TRUTH_M = 20.0  # a position within this is right: the truth has 5 to 10 m
HEADING_DEG = 20.0  # ... and a heading: those of the truth are 5 to 15 degrees off the map, known headings or not
WRONG_HINT = 276  # frame some 400 m from ON_ROUTE
CAMERA = {"width": 1280, "height": 720, "fx": 684.0, "fy": 684.0, "cx": 640.0, "cy": 360.0}
MIDDLE = PixelPoint(u=639.5, v=359.5)


@dataclass
class RecordedVillage:
    """village-1: rows of frames.csv and truth.csv."""

    folder: Path
    rows: list[dict[str, str]]
    truth: list[dict[str, str]]

    @classmethod
    def read(cls, folder: Path) -> "RecordedVillage":
        tables = [
            list(csv.DictReader(io.StringIO((folder / name).read_text("utf-8"))))
            for name in ("frames.csv", "truth.csv")
        ]
        return cls(folder, *tables)

    def place(self, frame: int) -> tuple[float, float]:
        """Latitude and longitude, degrees."""
        return float(self.truth[frame]["lat_deg"]), float(self.truth[frame]["lon_deg"])

    def new(self, corridor_m: float, start: int | None) -> NewFlight:
        waypoints = [dict(zip(("lat", "lon"), self.place(frame), strict=True)) for frame in ROUTE]
        new: dict[str, Any] = {
            "camera": CAMERA,
            "telemetry": {"yaw_sigma_deg": 3.0, "agl_sigma_m": 3.0},
            "area": {"waypoints": waypoints, "corridor_m": corridor_m},
        }
        if start is not None:
            new["start"] = dict(zip(("lat", "lon"), self.place(start), strict=True))
        return NewFlight.model_validate(new)


@dataclass
class HttpFlight:
    """A flight over HTTP. ``frames``: recorded frame of each uploaded one."""

    recorded: RecordedVillage
    client: ConsoleClient
    flight_id: str
    frames: list[int] = field(default_factory=list)
    watched: Watched = field(init=False)
    _t_s: float = 0.0

    def __post_init__(self) -> None:
        self.watched = Watched(self.client, self.flight_id)

    def upload(self, frames: Sequence[int], *, headings: bool = True) -> list[int]:
        """-> ids of the frames."""
        images, rows = [], {"": "file,t_s,yaw_deg,pitch_deg,roll_deg,agl_m"}
        for frame in frames:
            step = frame - self.frames[-1] if self.frames else GAP_FRAMES
            self._t_s += PERIOD_S * step if 0 < step < GAP_FRAMES else GAP_S
            row, name = self.recorded.rows[frame], f"frame_{len(self.frames):04d}.jpg"
            rows[name] = f"{name},{self._t_s},{row['yaw_deg'] if headings else ''},,,{row['agl_m']}"
            images.append((name, self.recorded.folder / "frames" / row["file"]))
            self.frames.append(frame)
        (accepted,) = self.client.upload(self.flight_id, images, rows)
        return accepted.frames

    def error_m(self, result: FrameResult) -> float:
        assert result.gps is not None
        frame = LocalFrame(*self.recorded.place(self.frames[result.frame_id]))
        return float(np.hypot(*frame.to_local(result.gps.lat, result.gps.lon)))

    def heading_error_deg(self, result: FrameResult) -> float:
        assert result.heading is not None
        true_deg = float(self.recorded.truth[self.frames[result.frame_id]]["yaw_deg"])
        return abs((result.heading - true_deg + 180.0) % 360.0 - 180.0)

    def results(self, *, refined: bool = False) -> list[FrameResult]:
        return self.client.results(self.flight_id, refined=refined).results

    def events(self, *names: str) -> list[tuple[str, Any]]:
        """Name and data of those that were seen."""
        return [(event.name, event.data) for event in self.watched.seen if event.name in names]

    def finish(self) -> Any:
        """-> statistics of the completed flight."""
        assert self.client.complete(self.flight_id).completing
        statistics = self.watched.until("flight_completed")["statistics"]
        assert self.watched.until("state_changed")["state"] == "completed"
        return statistics


@pytest.fixture(scope="module")
def recorded(data_set: Callable[[str], Path]) -> RecordedVillage:
    return RecordedVillage.read(data_set("flights/village-1"))


@pytest.fixture(scope="module")
def sources(data_set: Callable[[str], Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of map sources, with the map of village-1."""
    path = tmp_path_factory.mktemp("sources") / "sources.toml"
    path.write_text(f'[[source]]\npath = "{data_set("maps/village-2014-01.tif")}"\nlicence = "own"\n')
    return path


@dataclass
class Helped:
    """What was seen of a flight that knew neither its start nor its headings, began beside the map and was helped."""

    flown: HttpFlight
    health: Any
    created: Flight
    map_info: Any
    accepted: list[list[int]]
    lost: Flight
    image: bytes
    spot: ObjectGps
    statistics: Any
    recordings: list[str]
    exit_code: int
    results: list[FrameResult]
    refined: list[FrameResult]


@pytest.fixture(scope="module")
def helped(recorded: RecordedVillage, sources: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Helped]:
    served = Served(tmp_path_factory.mktemp("helped"), sources=sources)
    try:
        yield help_flight(served, recorded)
    finally:
        served.process.kill()
        served.process.wait()


def help_flight(served: Served, recorded: RecordedVillage) -> Helped:
    client = served.client
    health = served.get("/health").json
    created = client.create(recorded.new(CORRIDOR_M, None))
    flown = HttpFlight(recorded, client, created.flight_id)
    accepted = [flown.upload(OFF_ROUTE, headings=False)]  # while the map is made
    needed = flown.watched.until("user_input_needed")
    flown.watched.until("frame_processed", frame_id=len(OFF_ROUTE) - 1)
    lost = client.flight(created.flight_id)
    lat, lon = recorded.place(OFF_ROUTE[-1])
    client.user_fix(created.flight_id, UserFix(frame_id=len(OFF_ROUTE) - 1, pixel=MIDDLE, lat=lat, lon=lon))
    accepted.append(flown.upload(ON_ROUTE, headings=False))
    flown.watched.until("frame_processed", frame_id=len(flown.frames) - 1)
    spot = client.locate(created.flight_id, len(flown.frames) - 1, ObjectPixel(pixel_x=MIDDLE.u, pixel_y=MIDDLE.v))
    statistics = flown.finish()
    map_info = served.get(f"/maps/{lost.map.name}").json
    files = served.get(f"/flights/{created.flight_id}/recordings").json["files"]
    image = served.get(needed["image_url"]).body
    results = flown.results(), flown.results(refined=True)
    return Helped(
        flown,
        health,
        created,
        map_info,
        accepted,
        lost,
        image,
        spot,
        statistics,
        [file["name"] for file in files],
        served.stop(),
        *results,
    )


def test_the_service_begins_without_flights_and_with_its_map_sources(helped: Helped) -> None:
    assert (helped.health["status"], helped.health["flights"], helped.health["max_workers"]) == ("ok", 0, 1)


def test_a_flight_is_created_at_once_and_the_map_of_its_route_is_made_meanwhile(helped: Helped) -> None:
    assert (helped.created.state, helped.created.map.state) == ("processing", "preparing")
    assert helped.lost.map.state == "ready"
    west, south, east, north = helped.map_info["bounds"]
    for frame in ROUTE:
        lat, lon = helped.flown.recorded.place(frame)
        assert south < lat < north and west < lon < east
    height_m = LocalFrame(south, west).to_local(north, east)[1]
    assert height_m < 400.0  # the corridor, not the whole source of 1.2 km
    assert helped.map_info["gsd_m"] == pytest.approx(0.243, abs=0.01)


def test_images_are_uploaded_while_the_map_is_made(helped: Helped) -> None:
    assert helped.accepted == [[*range(10)], [*range(10, 21)]]
    assert helped.lost.images.uploaded == 10


def test_a_flight_beside_its_map_searches_all_of_it_and_asks_for_help(helped: Helped) -> None:
    flow = helped.flown.events("search_expanded", "state_changed", "user_input_needed", "processing_blocked")
    names = [name for name, _ in flow]
    assert names[:5] == [
        "search_expanded",
        "state_changed",
        "user_input_needed",
        "processing_blocked",
        "state_changed",
    ]
    assert (flow[0][1]["status"], flow[1][1]["state"], flow[4][1]["state"]) == ("whole_map", "recovering", "blocked")
    request = helped.lost.request
    assert request is not None and helped.lost.state == "blocked"
    needed = flow[2][1]
    assert (needed["request_id"], needed["frame_id"]) == (request.request_id, request.frame_id)
    file = helped.flown.recorded.rows[OFF_ROUTE[needed["frame_id"]]]["file"]
    assert helped.image == (helped.flown.recorded.folder / "frames" / file).read_bytes()
    tiles = needed["candidate_tiles"]
    assert [tile["rank"] for tile in tiles] == [1, 2, 3, 4, 5]
    west, south, east, north = helped.map_info["bounds"]
    assert all(south < tile["gps"]["lat"] < north and west < tile["gps"]["lon"] < east for tile in tiles)
    assert all(60.0 < tile["half_size_m"] < 120.0 for tile in tiles)  # half the diagonal of an image from 99 m: 106 m
    off_map = [result for result in helped.results if result.frame_id < len(OFF_ROUTE)]
    assert off_map and all(result.gps is None and result.source == "not_placed" for result in off_map)  # no false claim


def test_a_user_fix_is_accepted_and_the_search_ends_at_the_place(helped: Helped) -> None:
    ((_, answered),) = helped.flown.events("hint_answered")
    assert (answered["hint_id"], answered["verdict"]) == (1, "accepted")
    found = [event for name, event in helped.flown.events("search_expanded") if event["status"] == "found"]
    assert len(found) == 1 and found[0]["frame_id"] >= len(OFF_ROUTE)
    late = [result for result in helped.results if result.frame_id > found[0]["frame_id"]]
    assert len(late) >= 5 and all(helped.flown.error_m(result) < TRUTH_M for result in late)
    assert {result.source for result in late} == {"satellite_anchored"}


def test_headings_that_no_image_states_are_found_by_the_sweep(helped: Helped) -> None:
    (found,) = [event for name, event in helped.flown.events("search_expanded") if event["status"] == "found"]
    late = [result for result in helped.results if result.frame_id > found["frame_id"]]
    assert max(helped.flown.heading_error_deg(result) for result in late) < HEADING_DEG


def test_the_position_of_a_pixel_is_that_of_the_ground(helped: Helped) -> None:
    frame = LocalFrame(*helped.flown.recorded.place(ON_ROUTE[-1]))
    away_m = float(np.hypot(*frame.to_local(helped.spot.gps.lat, helped.spot.gps.lon)))
    assert away_m < TRUTH_M and 5.0 < helped.spot.accuracy_meters < 60.0


def test_a_completed_flight_is_refined_as_a_whole_and_has_its_record(helped: Helped) -> None:
    assert (helped.statistics["frames"], helped.statistics["hints"]) == (21, 1)
    refined = [result for result in helped.refined if result.refined]
    assert len(refined) == helped.statistics["refined"] >= len(ON_ROUTE) - 1
    late = [result for result in refined if result.frame_id > len(OFF_ROUTE)]
    assert all(helped.flown.error_m(result) < TRUTH_M for result in late)
    assert helped.recordings[0] == "finalised.csv"  # what is best of a flight comes first
    assert {"estimates.csv", "flight.mcap", "summary.json"} < set(helped.recordings)
    ids = [event.event_id for event in helped.flown.watched.seen]
    assert ids == [*range(1, len(ids) + 1)]


def test_the_service_ends_in_order(helped: Helped) -> None:
    assert helped.exit_code == 0


@pytest.mark.nightly
def test_a_flight_that_is_stopped_goes_on_and_a_fragment_is_merged_by_a_match_in_the_background(
    recorded: RecordedVillage, sources: Path, tmp_path: Path
) -> None:
    """The first photos follow the route; the next ones begin beside the map, unconnected, and come back to it."""
    served = Served(tmp_path, sources=sources)
    try:
        flown = HttpFlight(recorded, served.client, served.client.create(recorded.new(CORRIDOR_M, BEGIN[0])).flight_id)
        flown.upload(BEGIN)
        flown.watched.until("frame_processed", frame_id=2)
        assert served.stop() == 0
        served = Served(tmp_path, sources=sources, port=served.port)
        flown.upload(RETURN)
        statistics = flown.finish()
        results, fragments = flown.results(), served.client.flight(flown.flight_id).fragments
        assert served.stop() == 0
    finally:
        served.process.kill()
        served.process.wait()
    normal = results[: len(BEGIN)]
    assert {(result.source, result.match) for result in normal} == {("satellite_anchored", "accepted")}
    assert all(flown.error_m(result) < TRUTH_M for result in normal)
    first, second = fragments
    assert (first.first_frame, first.last_frame, first.joined) == (0, len(BEGIN) - 1, True)
    ((_, merged),) = flown.events("chunk_merged")
    assert merged["fragment_id"] == second.fragment_id and merged["frames"] >= 3
    assert (second.merged_at_frame, second.joined) == (merged["frame_id"], True)
    before = [r for r in results if r.fragment_id == second.fragment_id and r.frame_id < merged["frame_id"]]
    assert len(before) >= 2 and not any(result.joined for result in before)
    assert all(flown.error_m(result) < TRUTH_M for result in results if result.frame_id >= merged["frame_id"])
    assert (statistics["frames"], statistics["merged"]) == (len(BEGIN) + len(RETURN), 1)
    ids = [event.event_id for event in flown.watched.seen]
    assert ids == [*range(1, len(ids) + 1)]


@pytest.mark.nightly
def test_a_search_around_a_wrong_hint_widens_until_it_has_the_place(
    recorded: RecordedVillage, sources: Path, tmp_path: Path
) -> None:
    served = Served(tmp_path, sources=sources)
    try:
        flown = HttpFlight(recorded, served.client, served.client.create(recorded.new(3 * CORRIDOR_M, None)).flight_id)
        lat, lon = recorded.place(WRONG_HINT)
        served.client.hint(flown.flight_id, Hint(lat=lat, lon=lon, radius_m=100.0))
        flown.upload(range(48, 108, 6))
        flown.finish()
        results = flown.results()
        assert served.stop() == 0
    finally:
        served.process.kill()
        served.process.wait()
    steps = [(event["status"], event["grid_size"]) for _, event in flown.events("search_expanded")]
    assert steps[-1][0] == "found" and {status for status, _ in steps[:-1]} <= {"widen", "whole_map"}
    sizes = [size for status, size in steps[:-1] if status == "widen"]
    assert sizes and sizes == sorted(sizes) and set(sizes) <= {1, 4, 9, 16, 25}
    assert [event["state"] for _, event in flown.events("state_changed")] == ["recovering", "processing", "completed"]
    assert flown.error_m(results[-1]) < TRUTH_M and results[-1].source == "satellite_anchored"
