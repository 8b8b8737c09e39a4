"""The page in a real browser, over HTTP: a flight from its photos to its track, the position of a pixel, the help that
a lost flight asks for, and a connection that is lost and found again."""

import json
import time
from pathlib import Path

import pytest
from pyproj import Geod

import browser
from browser import Browser
from console_flight import AGL_M, CAMERA, GROUND, distance_m, lat_lon, make_map, place_of, write_images
from console_rig import Console, batch, settings
from terrafix_tools.console.events import CandidateTile, UserInputNeeded
from terrafix_tools.console.payloads import Gps, InputRequest, UserFix
from terrafix_tools.console.store import flights

pytestmark = [
    pytest.mark.slow,
    pytest.mark.real_time,
    pytest.mark.skipif(browser.program() is None, reason="no Chromium on this computer: the page is not tried in it"),
]
COMPUTED_S = 120.0  # longest wait for ten frames; processes of others may take the processors


def enter(window: Browser, field: str, value: object) -> None:
    window.run(f"document.getElementById('f-{field}').value = {json.dumps(str(value))}")


def test_photos_become_a_track_and_a_pixel_gets_its_position(tmp_path: Path, window: Browser) -> None:
    maps = tmp_path / "own"
    make_map(maps)
    images = write_images(tmp_path, range(10), GROUND)
    with Console(settings(tmp_path, workers=1, maps=(maps,))) as console:
        window.open(f"{console.url}/page/#/new")
        window.wait("document.querySelector('#f-map option')")
        window.choose_files("#f-images", [path for _, path in images])
        window.wait("document.getElementById('f-width').value === '640'")
        lat, lon = lat_lon(place_of(0))
        given = {"fx": CAMERA.fx, "lat": lat, "lon": lon, "agl_m": AGL_M, "yaw_deg": 90, "name": "north field"}
        for field, value in {**given, "map": "ground"}.items():
            enter(window, field, value)
        window.click("form.new button.primary")
        window.wait("document.querySelector('.flight-name')?.textContent === 'north field'")
        window.wait("document.querySelector('.upload progress')?.value === 1")
        window.wait("document.querySelector('.cell:last-of-type .value')?.textContent === 'IMG_0009.jpg'", COMPUTED_S)

        flight_id = window.run("location.hash.split('/')[2]")
        found = console.send("GET", f"/flights/{flight_id}/results?refined=true&from=9").json["results"][0]
        assert distance_m((found["gps"]["lat"], found["gps"]["lon"]), place_of(9)) < 15.0
        shown = f"{found['gps']['lat']:.5f}, {found['gps']['lon']:.5f}"  # an ellipse of some metres
        window.wait(f"document.querySelector('.cell.wide .value').textContent === {json.dumps(shown)}")
        assert "map match" in window.run("document.querySelector('.cell.wide .below').textContent")
        ellipse = found["ellipse"]
        first_line = window.run("document.querySelector('.glance').innerText")
        assert f"{ellipse['semi_major_m']:.1f} × {ellipse['semi_minor_m']:.1f} m" in first_line

        window.wait("document.querySelector('.frame img').naturalWidth === 640")
        window.click(".frame img", 0.75, 0.5)  # image up is east: to the south of the middle
        window.wait("document.querySelector('#panel-objects td')", 30.0)
        cells = window.run("[...document.querySelectorAll('#panel-objects td')].map((cell) => cell.innerText)")
        spot = tuple(float(part) for part in cells[1].split(", "))
        south_m = 160.0 / CAMERA.fx * AGL_M
        assert distance_m((spot[0], spot[1]), place_of(9) - (0.0, south_m)) < float(cells[2].split()[0]) + 5.0
        assert window.errors == []


def test_a_route_instead_of_a_map_has_its_corridor_fetched(tmp_path: Path, window: Browser) -> None:
    sources = tmp_path / "sources.toml"
    sources.write_text("")  # none covers the route: the flight is created all the same
    images = [tmp_path / name for _, name, _ in batch(0)]
    for path, (_, _, content) in zip(images, batch(0), strict=True):
        path.write_bytes(content)
    with Console(settings(tmp_path, sources=sources)) as console:
        window.open(f"{console.url}/page/#/new")
        window.wait("document.getElementById('f-route')")
        window.choose_files("#f-images", images)
        window.wait("document.getElementById('f-width').value === '640'")
        for field, value in {"fx": 500, "corridor_m": 250, "route": "48.15, 14.35\n48.16 east"}.items():
            enter(window, field, value)
        window.click("form.new button.primary")
        window.wait("document.querySelector('form.new .error[role=alert]').textContent.includes('48.16 east')")
        enter(window, "route", "48.15, 14.35\n\n 48.16 14.37 ")
        window.click("form.new button.primary")
        window.wait("location.hash.startsWith('#/flight/')")
        flight_id = window.run("location.hash.split('/')[2]")
        with console.service.database.read() as db:
            area = json.loads(flights.row_of(db, flight_id).spec)["area"]
        assert area["waypoints"] == [{"lat": 48.15, "lon": 14.35}, {"lat": 48.16, "lon": 14.37}]
        assert area["corridor_m"] == 250.0


def test_sizes_of_batches_and_distances_of_the_page(tmp_path: Path, window: Browser) -> None:
    with Console(settings(tmp_path)) as console:
        window.open(f"{console.url}/page/#/")
        window.wait("document.querySelector('.page')")
        sizes = window.run(
            "import('/page/js/upload.js').then((m) => [10, 50, 51, 99, 358].map((n) => m.batchSizes(n)))"
        )
        assert [sum(batches) for batches in sizes] == [10, 50, 51, 99, 358]
        assert [len(batches) for batches in sizes] == [1, 1, 2, 2, 8]
        assert all(10 <= size <= 50 for batches in sizes for size in batches)

        here, there = {"lat": 48.15, "lon": 14.35}, {"lat": 48.16, "lon": 14.37}
        words = f"{json.dumps(here)}, {json.dumps(there)}"
        found = window.run(f"import('/page/js/geo.js').then((m) => [m.distance({words}), m.bearing({words})])")
        azimuth_deg, _, expected_m = Geod(ellps="WGS84").inv(14.35, 48.15, 14.37, 48.16)
        assert found[0] == pytest.approx(expected_m, abs=0.05)
        assert found[1] == pytest.approx(azimuth_deg, abs=0.02)


def test_the_page_asks_for_the_token_and_offers_a_viewer_nothing_to_do(tmp_path: Path, window: Browser) -> None:
    tokens, secret = tmp_path / "tokens.toml", "a-viewer-with-a-long-token"
    tokens.write_text(f'[tokens]\nscreen = {{role = "viewer", token = "{secret}"}}\n')
    tokens.chmod(0o600)
    with Console(settings(tmp_path, tokens=tokens)) as console:
        window.open(f"{console.url}/page/#/new")
        window.wait("document.getElementById('token')")
        for given, then in (("x" * 24, ".error:not(:empty)"), (secret, ".page")):
            window.run(f"document.getElementById('token').value = {json.dumps(given)}")
            window.click("form button.primary")
            window.wait(f"document.querySelector({json.dumps(then)})")
        assert window.run("document.querySelector('h1').textContent") == "Flights"  # not the form of a new one
        links = window.run("[...document.querySelectorAll('.bar a.button')].map((link) => link.textContent)")
        assert links == ["Flights"]
        assert secret not in window.run("document.cookie + JSON.stringify({...localStorage, ...sessionStorage})")
        window.run("[...document.querySelectorAll('.bar button')].at(-1).click()")  # sign out
        window.wait("document.getElementById('token')")


def asking_flight(console: Console, *, with_places: bool = True) -> tuple[str, list[Gps], UserInputNeeded]:
    """A flight with ten images that asks where frame 4 was taken, its candidates, and the event that has them, which is
    already there ``with_places``."""
    flight_id = console.create(name="lost")
    assert console.upload(flight_id, batch(0)).status == 202
    west, south, east, north = console.send("GET", "/maps").json["maps"][0]["bounds"]
    places = [Gps(lat=south + (north - south) * k / 6, lon=west + (east - west) * k / 6) for k in range(1, 6)]
    tiles = [CandidateTile(rank=k, gps=gps, half_size_m=20.0) for k, gps in enumerate(places, start=1)]
    image = f"/flights/{flight_id}/frames/4/image"
    needed = UserInputNeeded(request_id="r1", frame_id=4, image_url=image, candidate_tiles=tiles)
    with console.service.database.write() as db:
        if with_places:
            flights.add_events(db, flight_id, "test", [needed])
        asked = InputRequest(request_id="r1", frame_id=4).model_dump_json()
        flights.update(db, flight_id, state="blocked", request=asked)
    return flight_id, places, needed


def test_a_pixel_and_a_place_on_the_map_answer_a_flight_that_asks(tmp_path: Path, window: Browser) -> None:
    with Console(settings(tmp_path)) as console:
        flight_id, places, needed = asking_flight(console, with_places=False)
        window.open(f"{console.url}/page/#/flight/{flight_id}")
        window.wait("document.querySelector('.ask-banner button')")
        window.click(".ask-banner button")
        window.wait("document.querySelector('.ask .soft')")
        with console.service.database.write() as db:  # the places come after the request, while its view is open
            flights.add_events(db, flight_id, "test", [needed])
        hint = {"lat": places[0].lat, "lon": places[0].lon}
        assert (
            console.send("POST", f"/flights/{flight_id}/hint", hint).status == 202
        )  # and the stream reads what is new
        window.wait("document.querySelectorAll('.ask .place').length === 5")
        window.wait("document.querySelector('.ask .frame img').naturalWidth === 640")
        assert window.run("document.querySelector('.ask-send .primary').disabled")
        window.press("3")  # the map shows the third place
        window.click(".ask .frame img", 0.25, 0.5)
        window.click(".ask-map", 0.5, 0.5)
        window.wait("!document.querySelector('.ask-send .primary').disabled")
        window.click(".ask-send .primary")
        window.wait("!document.querySelector('dialog.ask')")
        with console.service.database.write() as db:
            _, (_, fix) = flights.hints_before(db, flight_id, 1000)
        assert isinstance(fix, UserFix) and fix.frame_id == 4
        assert fix.pixel.u == pytest.approx(159.5, abs=2.0) and fix.pixel.v == pytest.approx(239.5, abs=2.0)
        assert distance_of(fix, places[2]) < 1.0
        assert window.errors == []


def distance_of(fix: UserFix, place: Gps) -> float:
    """In thousandths of a degree of arc at the equator, some 100 m."""
    return 1000.0 * max(abs(fix.lat - place.lat), abs(fix.lon - place.lon))


def test_a_lost_connection_is_shown_and_the_stream_goes_on_where_it_was(tmp_path: Path, window: Browser) -> None:
    chosen = settings(tmp_path)
    with Console(chosen) as console:
        flight_id, *_ = asking_flight(console)
        port = int(console.url.rpartition(":")[2])
        window.open(f"{console.url}/page/#/flight/{flight_id}")
        window.wait("document.querySelector('.badge.link.live')")
    window.wait("!document.querySelector('.banner.lost').hidden")
    window.wait("document.querySelector('.glance').classList.contains('stale')")
    assert "Connection lost" in window.run("document.querySelector('.banner.lost').textContent")
    time.sleep(0.1)
    with Console(settings(tmp_path, port=port)) as console:
        window.wait("document.querySelector('.badge.link.live') && document.querySelector('.banner.lost').hidden")
        window.wait("!document.querySelector('.glance').classList.contains('stale')")
        window.click("#tab-log")
        lines = "document.querySelectorAll('#panel-log li').length"
        window.wait(f"{lines} === 1")  # the event of before, once
        assert not window.run("document.querySelector('#panel-log time')")  # nobody knows when it was
