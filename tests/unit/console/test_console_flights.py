"""Flights over HTTP, from their first image to their completion, computed by the processes of the console, or by a Dask
cluster: the results and events of this computer, also when a worker dies."""

import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from console_flight import AGL_M, CAMERA, ELSEWHERE, GROUND, distance_m, lat_lon, make_map, place_of, write_images
from console_rig import WAIT_FOR_RESULT_S as WAIT_S
from console_rig import Console, Served, Watched, settings
from map_cluster import LocalCluster, local_cluster
from terrafix_tools.console.client import ConsoleClient
from terrafix_tools.console.payloads import NewFlight, ObjectPixel, PixelPoint, UserFix
from terrafix_tools.mission.file import read_mission

pytestmark = pytest.mark.slow  # processes, but no clock: the tests wait as long as it takes

FRAMES = range(10, 20)
KILLED_AT = 8  # event, of a flight of some 50
NEW: dict[str, Any] = {
    "camera": {"width": 640, "height": 480, "fx": 380.0, "cx": 319.5, "cy": 239.5, "distortion": [0, 0, 0, 0]},
    "map": "ground",
    "height_m": AGL_M,
    "yaw_deg": 90.0,
}


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the map of GROUND."""
    folder = tmp_path_factory.mktemp("maps")
    make_map(folder)
    return folder


def test_a_lost_flight_asks_goes_on_by_a_user_fix_and_is_refined_at_its_end(tmp_path: Path, maps: Path) -> None:
    with Console(settings(tmp_path, workers=1, maps=(maps,))) as console:
        client = ConsoleClient(console.url)
        flight_id = client.create(NewFlight.model_validate(NEW)).flight_id
        elsewhere = write_images(tmp_path, range(10), ELSEWHERE)
        (accepted,) = client.upload(flight_id, elsewhere)
        assert accepted.frames == [*range(10)]
        watched = Watched(client, flight_id)
        assert watched.until("state_changed")["state"] == "recovering"
        needed = watched.until("user_input_needed")
        assert 1 <= len(needed["candidate_tiles"]) <= 5
        assert console.send("GET", needed["image_url"]).body == elsewhere[needed["frame_id"]][1].read_bytes()
        assert watched.until("processing_blocked")["frame_id"] == needed["frame_id"]
        watched.until("frame_processed", frame_id=9)
        flight = client.flight(flight_id)
        assert flight.state.value == "blocked" and flight.request is not None
        assert flight.request.request_id == needed["request_id"]

        lat, lon = lat_lon(place_of(9))
        centre = PixelPoint(u=CAMERA.cx, v=CAMERA.cy)
        steered = client.user_fix(flight_id, UserFix(frame_id=9, pixel=centre, lat=lat, lon=lon))
        list(client.upload(flight_id, write_images(tmp_path, range(10, 20), GROUND)))
        answered = watched.until("hint_answered")
        assert (answered["hint_id"], answered["verdict"]) == (steered.hint_id, "accepted")
        watched.until("search_expanded", status="found")
        watched.until("frame_processed", frame_id=19)
        assert client.flight(flight_id).state.value == "processing"

        found = client.results(flight_id, first=19).results[0]
        assert found.gps is not None and distance_m((found.gps.lat, found.gps.lon), place_of(19)) < 15.0
        spot = client.locate(flight_id, 19, ObjectPixel(pixel_x=419.5, pixel_y=239.5))  # image up is east
        south_m = 100.0 / CAMERA.fx * AGL_M
        assert distance_m((spot.gps.lat, spot.gps.lon), place_of(19) - (0.0, south_m)) < spot.accuracy_meters + 5.0

        assert client.complete(flight_id).completing
        statistics = watched.until("flight_completed")["statistics"]
        assert (statistics["frames"], statistics["hints"]) == (20, 1) and statistics["refined"] > 0
        assert watched.until("state_changed")["state"] == "completed"
        assert [event.event_id for event in watched.seen] == [*range(1, len(watched.seen) + 1)]
        assert {event.name for event in watched.seen} >= {"frame_refined", "verdict_given"}
        names = [file["name"] for file in console.send("GET", f"/flights/{flight_id}/recordings").json["files"]]
        assert names == ["finalised.csv", "estimates.csv", "finalised.json", "flight.mcap", "summary.json"]
        record = console.send("GET", f"/flights/{flight_id}/recordings/flight.mcap")
        assert record.body.startswith(b"\x89MCAP")
        refined = [r for r in client.results(flight_id, refined=True).results if r.refined]
        track = tmp_path / "track.waypoints"
        track.write_bytes(console.send("GET", f"/flights/{flight_id}/waypoints").body)
        newest = [(r.gps.lat, r.gps.lon) for r in client.results(flight_id, refined=True).results if r.gps]
        assert [(item.lat_deg, item.lon_deg) for item in read_mission(track).items] == newest
        assert len(refined) == statistics["refined"]
        applied = [event for event in watched.seen if event.name == "user_fix_applied"]
        assert applied or [e for e in watched.seen if e.data.get("measurement") == "user_fix"], "gated as a measurement"


def stored(client: ConsoleClient, flight_id: str) -> list[Any]:
    """Results, refined results, fragments and events of a completed flight, without the name of the flight."""
    events = [(event.name, event.data) for event in client.events(flight_id)]
    results = [client.results(flight_id, refined=refined).results for refined in (False, True)]
    for named in [*results[0], *results[1]]:
        assert named.frame_uid == f"{flight_id}/{named.frame_id}"
        named.frame_uid = ""
    for _, data in events:
        assert data.pop("frame_uid", f"{flight_id}/{data.get('frame_id')}") == f"{flight_id}/{data.get('frame_id')}"
    return [results, client.flight(flight_id).fragments, events]


@dataclass(frozen=True)
class Undisturbed:
    """A flight over GROUND from its images to its completion, which no one disturbs."""

    new: NewFlight
    images: list[tuple[str, Path]]
    expected: list[Any]


@pytest.fixture(scope="module")
def undisturbed(maps: Path, tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    folder = tmp_path_factory.mktemp("undisturbed")
    lat, lon = lat_lon(place_of(FRAMES[0]))
    new = NewFlight.model_validate({**NEW, "start": {"lat": lat, "lon": lon}})
    images = write_images(folder, FRAMES, GROUND)
    with Console(settings(folder, workers=1, maps=(maps,))) as console:
        client = ConsoleClient(console.url)
        flight_id = client.create(new).flight_id
        list(client.upload(flight_id, images))
        client.complete(flight_id)
        expected = stored(client, flight_id)
    assert len(expected[0][0]) == len(FRAMES)
    return Undisturbed(new, images, expected)


def test_a_completed_flight_is_solved_as_a_whole_and_that_is_its_refined_result(undisturbed: Undisturbed) -> None:
    (_, refined), _, events = undisturbed.expected
    (statistics,) = [data["statistics"] for name, data in events if name == "flight_completed"]
    assert statistics["finalised"] == len(FRAMES) and not statistics["not_finalised"]
    assert {result.refined_by for result in refined} == {"finalised"}
    assert all(len(r.orientation or []) == 4 and len(r.covariance or []) == 36 and r.m_per_unit for r in refined)
    stages = [data["stage"] for name, data in events if name == "finalise_progress"]
    assert {"read", "smooth"} <= {*stages} and len(stages) <= 30


def killed_at(data: Path, maps: Path, flight: Undisturbed) -> Iterator[Any]:
    """Kills the service after some events, and ends the next one in order."""
    served = Served(data, maps=(maps,))
    flight_id = served.client.create(flight.new).flight_id
    list(served.client.upload(flight_id, flight.images))
    served.client.complete(flight_id)
    for event in served.client.events(flight_id):
        if event.event_id >= KILLED_AT:
            break
    served.process.kill()
    served.process.wait()
    served = Served(data, maps=(maps,))
    yield stored(served.client, flight_id)
    served.process.send_signal(signal.SIGTERM)
    yield served.process.wait(timeout=60)


def test_a_service_that_is_killed_goes_on_at_the_image_where_it_was(
    tmp_path: Path, maps: Path, undisturbed: Undisturbed
) -> None:
    ((results, refined), fragments, events), exit_code = killed_at(tmp_path, maps, undisturbed)
    (expected, _), _, _ = undisturbed.expected
    assert exit_code == 0
    first, second = fragments  # odometry begins anew where the process has ended; nothing before is computed again
    assert first.first_frame == 0 and first.last_frame + 1 == second.first_frame == second.fragment_id > 0
    assert results[: second.first_frame] == expected[: second.first_frame]
    assert len(results) == len(expected) and [r.frame_id for r in results] == [*range(len(FRAMES))]
    for found, undisturbed_one in zip(results, expected, strict=True):
        assert (
            found.gps is not None
            and distance_m((found.gps.lat, found.gps.lon), place_of(FRAMES[found.frame_id])) < 10.0
        )
        assert found.heading == pytest.approx(undisturbed_one.heading, abs=3.0) and found.heading_sigma < 10.0
    assert {result.refined_by for result in refined} == {"finalised"}, "the record is that of the whole flight"
    assert [data["frame_id"] for name, data in events if name == "frame_processed"] == [*range(len(FRAMES))]


def computing(cluster: LocalCluster) -> list[int]:
    """Indices of the workers that have a child process."""
    parents = {int(path.read_text().rpartition(")")[2].split()[1]) for path in Path("/proc").glob("[0-9]*/stat")}
    return [i for i, worker in enumerate(cluster.workers) if worker.pid in parents]


def flown_by(cluster: LocalCluster, data: Path, maps: Path, flight: Undisturbed) -> list[Any]:
    """Of the cluster, the first worker that has the flight is killed."""
    with Console(settings(data, workers=1, maps=(maps,), scheduler=cluster.address)) as console:
        client = ConsoleClient(console.url)
        flight_id = client.create(flight.new).flight_id
        list(client.upload(flight_id, flight.images))
        client.complete(flight_id)
        for event in client.events(flight_id):
            if event.event_id == KILLED_AT:
                (busy,) = computing(cluster)
                cluster.workers[busy].kill()
                cluster.workers[busy].wait()
        assert [worker.poll() for worker in cluster.workers].count(None) == 1
        return stored(client, flight_id)


@pytest.mark.nightly
def test_a_cluster_whose_worker_is_killed_gives_the_results_and_events_of_this_computer(
    tmp_path: Path, maps: Path, undisturbed: Undisturbed
) -> None:
    (tmp_path / "cluster").mkdir()
    with local_cluster(tmp_path / "cluster", workers=2) as cluster:
        assert flown_by(cluster, tmp_path / "there", maps, undisturbed) == undisturbed.expected
        until = time.monotonic() + WAIT_S
        while computing(cluster):
            assert time.monotonic() < until, "the program ends with its flight"
            time.sleep(0.05)


def test_the_map_of_a_route_is_made_from_the_sources_and_a_route_beyond_them_blocks_the_flight(
    tmp_path: Path, maps: Path
) -> None:
    sources = tmp_path / "sources.toml"
    sources.write_text(f'[[source]]\npath = "{maps / "ground.tif"}"\nlicence = "own"\n')
    with Console(settings(tmp_path / "data", sources=sources)) as console:
        client = ConsoleClient(console.url)
        route = [lat_lon(place_of(i)) for i in (0, 3)]
        created = []
        for shift_deg in (0.0, 5.0):
            waypoints = [{"lat": lat + shift_deg, "lon": lon} for lat, lon in route]
            area = {"waypoints": waypoints, "corridor_m": 100}
            created.append(client.create(NewFlight.model_validate({**NEW, "map": None, "area": area})))
        assert [flight.map.state.value for flight in created] == ["preparing", "preparing"]
        end = time.monotonic() + WAIT_S
        while client.flight(created[1].flight_id).map.state.value == "preparing":
            assert time.monotonic() < end
            time.sleep(0.2)
        near, far = (client.flight(flight.flight_id) for flight in created)
        assert near.map.state.value == "ready" and near.state.value == "processing"
        info = console.send("GET", f"/maps/{near.map.name}").json
        west, south, east, north = info["bounds"]
        assert west < route[0][1] < east and south < route[0][0] < north
        assert far.map.state.value == "failed" and far.state.value == "blocked" and "map" in far.error
        events = console.events(far.flight_id, 0, 2)
        assert [name for _, name, _ in events] == ["processing_blocked", "state_changed"]
        client.delete(near.flight_id)
        assert console.send("GET", f"/maps/{near.map.name}").status == 404
