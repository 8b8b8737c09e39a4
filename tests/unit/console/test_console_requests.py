"""Requests to the console: what is taken, and what is refused with a problem that says why."""

import asyncio
import json
import random
import socket
import sqlite3
import struct
import subprocess
import sys
import time
import zlib
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from console_rig import BOUNDARY, CAMERA, NEW, Answer, Console, batch, jpeg, multipart, photo, settings
from small_disk import small_disk
from terrafix.core.errors import SourceError
from terrafix.vision.sources.description import ATTITUDE_SIGMA_DEG
from terrafix.vision.sources.photos import STATED_TILT_SIGMA_DEG
from terrafix_tools.console import uploads, workers
from terrafix_tools.console.compute.source import UploadedImages
from terrafix_tools.console.new_flight import new_flight
from terrafix_tools.console.openapi import schema
from terrafix_tools.console.settings import ServiceLimits
from terrafix_tools.console.store import flights
from terrafix_tools.console.store.database import FILE
from terrafix_tools.installation import install_command

FORM = {"content-type": f"multipart/form-data; boundary={BOUNDARY}"}
AT_60 = {"lat": 60, "lon": 0}


def assert_refused(answer: Answer, status: int, *words: str) -> None:
    assert answer.status == status, answer.body
    assert answer.headers["content-type"] == "application/problem+json"
    assert set(answer.json) == {"type", "title", "status", "detail", "errors"}
    assert answer.json["status"] == status
    for word in words:
        assert word in answer.json["detail"]


def png_header(width: int, height: int) -> bytes:
    """A PNG that states a size and ends where its pixels would begin."""
    head = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    checked = struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))
    return b"\x89PNG\r\n\x1a\n" + checked + struct.pack(">I", 9) + b"IDAT"


def test_a_flight_is_created_listed_read_and_deleted(console: Console) -> None:
    answer = console.send("POST", "/flights", {**NEW, "name": "north field"})
    assert answer.status == 201
    flight = answer.json
    assert flight["state"] == "processing" and flight["kind"] == "batch" and flight["last_event_id"] == 0
    assert flight["map"] == {"name": "small", "state": "ready", "detail": ""}
    assert answer.headers["location"] == f"/flights/{flight['flight_id']}"
    assert console.send("GET", answer.headers["location"]).json == flight
    assert flight in console.send("GET", "/flights").json["flights"]
    config = console.send("GET", f"{answer.headers['location']}/config").json
    assert config["flight"]["camera"]["fx"] == CAMERA["fx"] and config["flight"]["telemetry"]["yaw_sigma_deg"] == 5.0
    assert (config["map"], config["config"]) == ("small", console.send("GET", "/config").json["flights"])
    assert_refused(console.send("GET", f"/flights/{'0' * 16}/config"), 404)
    assert console.send("DELETE", answer.headers["location"]).status == 204
    assert_refused(console.send("GET", answer.headers["location"]), 404, flight["flight_id"])


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"map": "no-such"}, "no-such"),
        ({"map": None}, "map or area"),
        ({"camera": {**CAMERA, "width": 639}}, "width"),
        ({"camera": {**CAMERA, "height": 4169}}, "height"),
        ({"camera": {"width": 640, "height": 480}}, "fx, or focal_mm"),
        ({"camera": {**CAMERA, "fx": 1.0}}, "fx"),
        ({"start": {"lat": 91, "lon": 0}}, "start.lat"),
        ({"start": {"lat": 10, "lon": 20}}, "no imagery at the start"),
        ({"colour": "red"}, "colour"),
        ({"name": "x" * 101}, "name"),
        ({"height_m": "high"}, "height_m"),
        ({"map": None, "area": {"waypoints": [{"lat": 0, "lon": 0}, {"lat": 0, "lon": 1}]}}, "no map sources"),
        # A degree at 60 is 55.66 km: (5.5 * 55.66 + 40) * 40, and (9 * 55.66 + 40) * 40
        ({"map": None, "area": {"waypoints": [AT_60, {**AT_60, "lon": 5.5}], "corridor_m": 20_000}}, "no map sources"),
        ({"map": None, "area": {"waypoints": [AT_60, {**AT_60, "lon": 9}], "corridor_m": 20_000}}, "21,638 km2"),
    ],
)
def test_a_flight_that_is_not_valid_is_refused_with_the_field(
    console: Console, changes: dict[str, Any], word: str
) -> None:
    answer = console.send("POST", "/flights", {**NEW, **changes})
    assert_refused(answer, 404 if changes.get("map") else 422, word)


def test_images_become_frames_in_the_order_of_their_names_over_batches_whatever_gaps_they_have(
    console: Console,
) -> None:
    flight_id = console.create()
    first = console.upload(flight_id, batch(20))
    assert (first.status, first.json) == (202, {"frames": [*range(10)], "repeated": False})
    assert_refused(console.upload(flight_id, batch(5, 12)), 409, "IMG_0005.jpg", "IMG_0029.jpg")
    assert console.upload(flight_id, batch(98, 12)).json["frames"] == [*range(10, 22)]
    images = {"uploaded": 22, "processed": 0, "expected": None, "last_name": "IMG_0109.jpg"}
    assert console.send("GET", f"/flights/{flight_id}").json["images"] == images
    image = console.send("GET", f"/flights/{flight_id}/frames/11/image")
    assert image.body == jpeg(99) and image.headers["content-type"] == "image/jpeg"
    assert image.headers["x-content-type-options"] == "nosniff"
    assert_refused(console.send("GET", f"/flights/{flight_id}/frames/22/image"), 404)


def test_a_batch_that_is_sent_again_has_the_same_frames_and_is_not_stored_twice(console: Console) -> None:
    flight_id = console.create()
    sent = batch(1)
    assert console.upload(flight_id, sent).json["repeated"] is False
    console.upload(flight_id, batch(11))
    again = console.upload(flight_id, sent)
    assert (again.status, again.json) == (202, {"frames": [*range(10)], "repeated": True})
    other = [*sent[:9], (*sent[9][:2], jpeg(99))]
    assert_refused(console.upload(flight_id, other), 409, "IMG_0010.jpg")
    assert console.send("GET", f"/flights/{flight_id}").json["images"]["uploaded"] == 20


@pytest.mark.parametrize(
    ("parts", "status", "word"),
    [
        (batch(1, 9), 422, "9 images"),
        (batch(1, 51, b"x"), 422, "50"),
        ([*batch(1, 9), ("images", "IMG_0008.jpg", jpeg())], 409, "IMG_0008.jpg does not come after IMG_0009.jpg"),
        ([*batch(1, 9), ("images", "IMG_0009.jpg", jpeg())], 409, "does not come after"),
        ([*batch(1, 9), ("images", "../../IMG_0010.jpg", jpeg())], 422, "no name of an image"),
        ([*batch(1, 9), ("images", "a/IMG_0010.jpg", jpeg())], 422, "no name of an image"),
        ([*batch(1, 9), ("images", ".IMG_0010.jpg", jpeg())], 422, "no name of an image"),
        ([*batch(1, 9), ("images", "IMG_0010.jpg", b"")], 422, "not a JPEG or PNG"),
        ([*batch(1, 9), ("images", "IMG_0010.jpg", b"GIF89a" + jpeg())], 422, "not a JPEG or PNG"),
        ([*batch(1, 9), ("images", "IMG_0010.jpg", b"\xff\xd8\xff" + b"\x00" * 99)], 422, "not a JPEG or PNG"),
        ([*batch(1, 9), ("images", "IMG_0010.png", png_header(100_000, 100_000))], 422, "IMG_0010.png"),
        ([*batch(1, 9), ("images", "IMG_0010.png", png_header(6253, 4168))], 422, "6253x4168"),
        ([*batch(1, 9), ("images", "IMG_0010.jpg", jpeg(0, 800, 600))], 422, "the camera of this flight has 640x480"),
        ([*batch(1, 10), ("other", "x", b"")], 422, "'other'"),
        ([("other", "x", b""), ("images", "IMG_0001.jpg", b"x" * 20_000_000)], 422, "'other'"),  # refused early
        ([*batch(1, 10), ("telemetry", "t.csv", b"file,t_s\nIMG_0001.jpg,0\n")], 422, "one row for each image"),
        ([*batch(1, 10), ("telemetry", "t.csv", b"file,t_s\nIMG_0001.jpg,zero\n")], 422, "telemetry row 2"),
    ],
)
def test_a_batch_that_is_not_valid_is_refused_as_a_whole(
    console: Console, parts: list[tuple[str, str, bytes]], status: int, word: str
) -> None:
    flight_id = console.create()
    assert_refused(console.upload(flight_id, parts), status, word)
    assert console.send("GET", f"/flights/{flight_id}").json["images"]["uploaded"] == 0
    folder = console.service.settings.flight(flight_id)
    assert [path for path in folder.rglob("*") if path.is_file()] == []


def test_a_body_that_is_no_multipart_or_is_cut_is_refused(console: Console) -> None:
    path = f"/flights/{console.create()}/images/batch"
    whole = multipart(batch(1))
    assert_refused(console.send("POST", path, whole, {"content-type": "image/jpeg"}), 415)
    assert_refused(console.send("POST", path, whole[:-30], FORM), 422, "ends too early")
    assert_refused(console.send("POST", path, b"no parts", FORM), 422)
    assert_refused(console.send("POST", path, b"", FORM), 422)


@pytest.mark.parametrize("head", [b"X: " + b"a" * 5000 + b"\r\n", b"X: a\r\n" * 9, b"X" * 100_000])
def test_a_part_with_too_many_or_too_long_headers_is_refused(console: Console, head: bytes) -> None:
    path = f"/flights/{console.create()}/images/batch"
    body = b"--" + BOUNDARY.encode() + b"\r\n" + head
    assert_refused(console.send("POST", path, body, FORM), 422, "eader")


def test_names_and_tokens_beyond_latin_1_are_no_failure_of_the_service(console: Console) -> None:
    path = f"/flights/{console.create()}/images/batch"
    body = multipart([("\u6c34", "IMG_0001.jpg", jpeg())])
    assert_refused(console.send("POST", path, body, FORM), 422)
    answer = console.send("POST", "/session", {"token": "\u6c34"})
    assert (answer.status, answer.json["required"]) == (200, False)
    assert "set-cookie" not in answer.headers


def test_an_image_whose_file_is_gone_is_not_found(console: Console) -> None:
    flight_id = console.create()
    console.upload(flight_id, batch(1))
    path = f"/flights/{flight_id}/frames/3/image"
    assert console.send("GET", path).status == 200
    for file in console.service.settings.flight(flight_id).rglob("*.jpg"):
        file.unlink()
    assert_refused(console.send("GET", path), 404)


def test_times_and_states_of_a_table_are_those_of_the_images(console: Console) -> None:
    flight_id = console.create(yaw_deg=90.0)
    rows = "".join(f"IMG_{n:04d}.jpg,{2.5 * n},,,,{100 + n}\n" for n in range(1, 11))
    table = ("telemetry", "t.csv", f"file,t_s,yaw_deg,pitch_deg,roll_deg,agl_m\n{rows}".encode())
    assert console.upload(flight_id, [*batch(1), table]).status == 202
    with console.service.database.read() as db:
        stored = uploads.flights.images_of(db, flight_id, 0)
    assert [image.t_ns for image in stored] == [round(2.5e9 * n) for n in range(1, 11)]
    assert stored[2].state is not None and '"agl_m":103.0' in stored[2].state
    assert '"yaw_rad":1.5707' in stored[2].state
    earlier = ("telemetry", "t.csv", b"file,t_s\n" + b"".join(b"IMG_%04d.jpg,%d\n" % (n, n) for n in range(11, 21)))
    assert_refused(console.upload(flight_id, [*batch(11), earlier]), 409, "not later")


def test_a_completed_flight_takes_no_images_and_an_empty_one_is_not_completed(console: Console) -> None:
    flight_id = console.create()
    assert_refused(console.send("POST", f"/flights/{flight_id}/complete"), 409, "no images")
    console.upload(flight_id, batch(1))
    assert console.send("POST", f"/flights/{flight_id}/complete").json["completing"] is True
    assert_refused(console.upload(flight_id, batch(11)), 409, "being completed")
    with console.service.database.write() as db:
        flights.update(db, flight_id, state="completed")
    assert_refused(console.send("POST", f"/flights/{flight_id}/hint", {"lat": 1.0, "lon": 2.0}), 409, "is completed")


def test_a_fix_needs_a_frame_and_hints_are_numbered(console: Console) -> None:
    flight_id = console.create()
    fix = {"frame_id": 3, "pixel": {"u": 10, "v": 20}, "lat": 1.0, "lon": 2.0}
    assert_refused(console.send("POST", f"/flights/{flight_id}/user-fix", fix), 404, "no frame 3")
    console.upload(flight_id, batch(1))
    assert console.send("POST", f"/flights/{flight_id}/user-fix", fix).json["hint_id"] == 1
    assert console.send("POST", f"/flights/{flight_id}/hint", {"lat": 1.0, "lon": 2.0}).json["hint_id"] == 2
    outside = {**fix, "pixel": {"u": 640, "v": 20}}
    assert_refused(console.send("POST", f"/flights/{flight_id}/user-fix", outside), 422, "640x480")
    asked = console.send("POST", f"/flights/{flight_id}/frames/3/object-to-gps", {"pixel_x": 1, "pixel_y": 1})
    assert_refused(asked, 404, "no result of frame 3")


def test_maps_have_bounds_and_tiles(console: Console) -> None:
    info = console.send("GET", "/maps/small").json
    assert console.send("GET", "/maps").json == {"maps": [info]}
    west, south, east, north = info["bounds"]
    assert west < east and south < north and info["gsd_m"] == pytest.approx(0.5, rel=1e-3)
    assert_refused(console.send("GET", "/maps/other"), 404)
    assert_refused(console.send("GET", "/maps/small/tiles/3/8/0.png"), 404, "0 to 7")
    assert_refused(console.send("GET", "/maps/..%2F..%2Fetc%2Fpasswd"), 404)
    tile = console.send("GET", "/maps/small/tiles/0/0/0.png")
    assert tile.status == 200 and tile.body.startswith(b"\x89PNG") and tile.headers["content-type"] == "image/png"


def test_errors_of_http_itself_are_problems_too(console: Console) -> None:
    assert_refused(console.send("GET", "/no/such/path"), 404)
    assert_refused(console.send("PATCH", "/flights"), 405)
    assert_refused(console.send("POST", "/flights", b"{not json", {"content-type": "application/json"}), 422)
    assert_refused(console.send("POST", "/flights", b"[" * 100_000, {"content-type": "application/json"}), 400)
    assert_refused(console.send("POST", "/flights", b" " * 3_000_000, {"content-type": "application/json"}), 413)
    chunks = iter([b" " * console.service.settings.limits.body_bytes, json.dumps(NEW).encode()])
    assert_refused(console.send("POST", "/flights", chunks, {"content-type": "application/json"}), 400)
    assert_refused(console.send("GET", "/flights/UPPER"), 422)
    assert console.send("GET", "/page/..%2f..%2fcli.py").status == 404


def test_limits_on_flights_and_images_are_refusals(tmp_path: Path) -> None:
    limits = ServiceLimits(flights=1, images=15)
    with Console(settings(tmp_path, limits=limits)) as console:
        flight_id = console.create()
        assert_refused(console.send("POST", "/flights", NEW), 429, "1 flights")
        console.upload(flight_id, batch(1))
        assert_refused(console.upload(flight_id, batch(11)), 409, "at most 15")


def test_a_full_disk_refuses_uploads_and_leaves_the_flight_as_it_was(tmp_path: Path) -> None:
    with Console(settings(tmp_path, limits=ServiceLimits(disk_reserve_bytes=2**60))) as console:
        flight_id = console.create()
        assert_refused(console.upload(flight_id, batch(1)), 507, "free")
        assert console.send("GET", f"/flights/{flight_id}").json["images"]["uploaded"] == 0


def test_a_disk_that_fills_amid_an_upload_costs_that_upload_and_nothing_else(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 40) as disk:
        with Console(settings(disk.folder, limits=ServiceLimits(disk_reserve_bytes=0))) as console:
            flight_id = console.create()
            assert console.upload(flight_id, batch(1)).status == 202
            for free_bytes in (0, 4096, 8192, 40960, 81920):
                disk.fill(free_bytes)
                assert_refused(console.upload(flight_id, batch(11)), 507)
                assert console.send("GET", f"/flights/{flight_id}").json["images"]["uploaded"] == 10
                disk.free()
            disk.fill()
            assert_refused(console.send("POST", "/flights", NEW), 507)
            disk.free()
            assert console.upload(flight_id, batch(11)).status == 202
            assert console.send("GET", f"/flights/{flight_id}").json["images"]["uploaded"] == 20
            stored = sorted((disk.folder / "flights" / flight_id / "images").iterdir())
            assert [path.read_bytes() for path in stored] == [content for _, _, content in (*batch(1), *batch(11))]
        with closing(sqlite3.connect(disk.folder / FILE)) as database:
            assert database.execute("PRAGMA integrity_check").fetchall() == [("ok",)]


def test_an_upload_that_is_too_slow_makes_room_for_others(tmp_path: Path) -> None:
    with Console(settings(tmp_path, limits=ServiceLimits(uploads=1, upload_s=0.2))) as console:
        path, body = f"/flights/{console.create()}/images/batch", multipart(batch(1))
        host, port = console.url.removeprefix("http://").split(":")
        head = f"POST {path} HTTP/1.1\r\nHost: {host}\r\nContent-Type: multipart/form-data; boundary={BOUNDARY}\r\n"
        with socket.create_connection((host, int(port)), timeout=20.0) as slow:
            slow.sendall(f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body[:100])
            time.sleep(0.3)
            slow.sendall(body[100:])
            assert slow.recv(100).startswith(b"HTTP/1.1 408")


VALUES = [None, True, -1, 0, 1e308, "NaN", "", "\u0000", "x" * 300, [], {}, [[[]]], {"lat": {}}, 2**70, -1e-320]


def test_no_random_body_or_path_makes_the_service_fail(console: Console) -> None:
    """Every path and method of the interface with random fields, parameters and bodies."""
    rng = random.Random(4)
    flight_id = console.create()
    fields = ["camera", "map", "area", "start", "frame_id", "pixel", "lat", "lon", "radius_m", "pixel_x", "token"]
    for path, methods in schema()["paths"].items():
        for method in methods:
            for _ in range(6):
                filled = path.replace("{flight_id}", rng.choice([flight_id, "x", "%00", "..%2f.."]))
                for name in ("{frame_id}", "{name}", "{z}", "{x}", "{y}"):
                    filled = filled.replace(name, rng.choice(["0", "-1", "99999999999999999999", "%ff", "a.mcap"]))
                body = {key: rng.choice(VALUES) for key in rng.sample(fields, 4)}
                if filled.endswith("/events") or (method == "delete" and flight_id in filled):
                    continue
                answer = console.send(method.upper(), filled, body if method == "post" else None)
                assert answer.status < 500, (method, filled, body, answer.body)


@pytest.mark.slow
def test_the_service_itself_loads_nothing_that_computes_flights_or_builds_maps() -> None:
    heavy = "gtsam onnxruntime rasterio pymavlink"
    code = f"import sys, terrafix_tools.console.serve; print([m for m in '{heavy}'.split() if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.slow
def test_without_the_console_extra_one_line_states_what_to_install(tmp_path: Path) -> None:
    code = "import sys; sys.modules['fastapi'] = None; from terrafix_tools.cli import main; main()"
    words = [sys.executable, "-c", code, "serve", "--data", str(tmp_path)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert done.stderr == f"terrafix: this command needs fastapi; install it: {install_command('console')}\n"


@pytest.mark.parametrize(("second", "begin_s"), [(40, 40.0), (3, 10.0)])
def test_a_further_batch_begins_when_its_camera_says_or_later(console: Console, second: int, begin_s: float) -> None:
    flight_id = console.create()
    for first, at in ((0, 0), (10, second)):
        parts = [("images", f"IMG_{first + i:04d}.jpg", photo(at + i)) for i in range(10)]
        assert console.upload(flight_id, parts).status == 202
    with console.service.database.read() as db:
        assert flights.images_of(db, flight_id, 10, 1)[0].t_ns == begin_s * 1e9


def facts(console: Console, parts: list[tuple[str, str, bytes]]) -> Answer:
    return console.send("POST", "/photos", multipart(parts), FORM)


def test_photos_state_what_replay_takes_from_them_and_where_it_comes_from(console: Console) -> None:
    # Their first bytes are enough.
    heads = [("images", f"DJI_{i:04d}.JPG", photo(i, 23.5, 121.0)[:-2000]) for i in (3, 9)]
    found = facts(console, heads).json
    assert (found["width"], found["height"]) == (640, 480)
    assert found["camera"]["fx"] == pytest.approx(24 / 43.267 * 800, rel=1e-3)
    assert (found["start"]["lat"], found["start"]["lon"]) == (23.5, 121.0)
    assert (found["height_m"], found["yaw_deg"], found["mount"]["tolerance_deg"]) == (92.4, 91.0, 9.0)
    said = {fact["topic"]: fact["text"] for fact in found["facts"]}
    assert "FocalLengthIn35mmFilm" in str(found["facts"]) and "GPS of the first photo" in said["start"]
    assert "RelativeAltitude" in said["height"] and "DateTimeOriginal of 2 of 2" in said["clock"]
    table = b"name = 'field'\nmap = 'maps/town.gpkg'\n[camera]\nwidth=640\nheight=480\nfx=500\nfy=500\ncx=320\ncy=240\n"
    described = facts(console, [*heads, ("description", "flight.toml", table)]).json
    assert (described["name"], described["map"], described["camera"]["fx"]) == ("field", "town", 500.0)


def test_photos_without_a_focal_length_state_the_rest_and_why(console: Console) -> None:
    found = facts(console, [("images", "a.jpg", jpeg())]).json
    assert (found["width"], found["camera"], found["start"]) == (640, None, None)
    assert "no photo says its focal length" in found["problem"]
    assert_refused(facts(console, [("images", "a.jpg", b"no photo")]), 422)
    assert_refused(facts(console, [("description", "flight.toml", b"x = [")]), 422)


def test_a_copy_has_the_images_and_hints_of_a_flight_and_its_own_settings(console: Console) -> None:
    flight_id = console.create(height_m=80.0)
    console.upload(flight_id, batch(1))
    hint = {"lat": 48.0, "lon": 14.0}
    fix = {"frame_id": 6, "pixel": {"u": 1, "v": 2}, "lat": 48.0, "lon": 14.0}
    for path, body in (("hint", hint), ("user-fix", fix)):
        assert console.send("POST", f"/flights/{flight_id}/{path}", body).status == 202
    new = {**NEW, "camera": {**CAMERA, "fx": 510.0}, "height_m": 95.0, "override": True}
    made = console.send("POST", f"/flights/{flight_id}/copy", new)
    assert made.status == 201
    copy = made.json
    assert copy["flight_id"] != flight_id
    assert copy["images"] == {"uploaded": 10, "processed": 0, "expected": 10, "last_name": "IMG_0010.jpg"}
    assert console.send("GET", f"/flights/{copy['flight_id']}/frames/4/image").body == jpeg(5)
    with console.service.database.read() as db:
        states = [image.state for image in flights.images_of(db, copy["flight_id"], 0)]
        assert all(state is not None and '"agl_m":95.0' in state for state in states)
        assert flights.has_hints_before(db, copy["flight_id"], 6)
    with console.service.database.write() as db:
        assert len(flights.hints_before(db, copy["flight_id"], 6)) == 1
        assert len(flights.hints_before(db, copy["flight_id"], 0)) == 1
    assert console.send("DELETE", f"/flights/{flight_id}").status == 204
    assert console.send("GET", f"/flights/{copy['flight_id']}/frames/4/image").body == jpeg(5)
    assert_refused(console.send("POST", f"/flights/{console.create()}/copy", NEW), 409, "no images")


def test_a_flight_that_failed_is_tried_again_and_no_other(console: Console) -> None:
    flight_id = console.create()
    console.upload(flight_id, batch(1))
    assert_refused(console.send("POST", f"/flights/{flight_id}/retry"), 409, "copy")
    with console.service.database.write() as db:
        flights.count_attempt(db, flight_id, 3)
        flights.update(db, flight_id, state="blocked", error="its process died")
    answer = console.send("POST", f"/flights/{flight_id}/retry")
    assert (answer.status, answer.json["state"], answer.json["error"]) == (202, "processing", "")
    with console.service.database.read() as db:
        assert flights.image_of(db, flight_id, 3).attempts == 0


def test_a_flight_is_given_up_after_deaths_in_a_row_without_a_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failed: list[str] = []

    async def nothing(*_: object) -> None: ...

    async def fails(_flight_id: str, why: str) -> None:
        failed.append(why)

    async def die() -> None:
        computing = workers.Workers(settings(tmp_path), workers.Reports(nothing, nothing, fails))
        for stored in [0] * (workers.MAX_DEATHS - 1) + [1] + [0] * (workers.MAX_DEATHS - 2):
            await computing._died("f", tmp_path, workers._Running(None, stored=stored), 1)  # type: ignore[arg-type]
        assert failed == []
        await computing._died("f", tmp_path, workers._Running(None), 1)  # type: ignore[arg-type]

    monkeypatch.setattr(workers, "RESTART_S", 0.0)
    asyncio.run(die())
    assert len(failed) == 1 and "died 5 times in a row" in failed[0]


def test_what_was_finalised_is_the_first_of_the_files_of_a_flight(console: Console) -> None:
    flight_id = console.create()
    out = console.service.settings.flight(flight_id) / "out"
    out.mkdir(parents=True)
    for name in ("estimates.csv", "finalised.csv", "flight.mcap"):
        (out / name).write_bytes(b"x")
    files = console.send("GET", f"/flights/{flight_id}/recordings").json["files"]
    assert [file["name"] for file in files] == ["finalised.csv", "estimates.csv", "flight.mcap"]


def test_a_flight_whose_process_dies_five_times_in_a_row_is_given_up_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    monkeypatch.setattr(workers, "RESTART_S", 0.0)
    with Console(settings(tmp_path, workers=1)) as running:
        flight_id = running.create()
        running.upload(flight_id, batch(1))
        until, path = time.monotonic() + 30.0, f"/flights/{flight_id}"
        while not (flight := running.send("GET", path).json)["error"] and time.monotonic() < until:
            time.sleep(0.01)
    assert (flight["state"], flight["error"]) == ("blocked", "its process died 5 times in a row (exit code 1)")


def test_a_flight_is_created_from_any_flight_toml_of_a_pinhole_camera(tmp_path: Path) -> None:
    camera = "[camera]\nwidth=640\nheight=480\nfx=500\nfy=500\ncx=320\ncy=240\n"
    (tmp_path / "flight.toml").write_text(camera + "[telemetry]\nyaw_sigma_deg=4\n[start]\nlat_deg=5\nlon_deg=6\n")
    new = new_flight(tmp_path / "flight.toml", "town", None, 1000.0, None, "")
    assert (new.camera.fx, new.telemetry.yaw_sigma_deg, new.telemetry.attitude_sigma_deg) == (500.0, 4.0, None)
    (tmp_path / "flight.toml").write_text(camera + 'model="fisheye"\ndistortion=[0, 0, 0, 0]\n')
    with pytest.raises(SourceError, match="pinhole cameras only"):
        new_flight(tmp_path / "flight.toml", "town", None, 1000.0, None, "")


def test_the_tilt_of_photos_is_known_less_well_than_that_of_a_table(console: Console, tmp_path: Path) -> None:
    sigmas = {}
    rows = b"file,t_s,yaw_deg\n" + b"".join(b"IMG_%04d.jpg,%d,90\n" % (i, i) for i in range(10))
    for name, parts in {
        "photos": [("images", f"IMG_{i:04d}.jpg", photo(i, 23.5, 121.0)) for i in range(10)],
        "table": [*batch(0), ("telemetry", "frames.csv", rows)],
    }.items():
        flight_id = console.create()
        assert console.upload(flight_id, parts).status == 202
        source = UploadedImages(
            console.service.database,
            flight_id,
            tmp_path,
            wait=lambda: None,
            begins=lambda _: None,
            steer=lambda *_: None,
        )
        sigmas[name] = source.origin().attitude_sigma_deg
    assert sigmas == {"photos": STATED_TILT_SIGMA_DEG, "table": ATTITUDE_SIGMA_DEG}


def test_the_first_bytes_of_as_many_photos_as_a_batch_has_are_taken_and_no_more(console: Console) -> None:
    def heads(size: int) -> list[tuple[str, str, bytes]]:
        content = photo(0, 23.5, 121.0).ljust(size, b"\0")
        return [("images", f"DJI_{i:04d}.JPG", content) for i in range(50)]

    assert facts(console, heads(256 * 1024)).json["width"] == 640
    refused = facts(console, heads(256 * 1024 + 1))
    assert refused.status == 413 and "DJI_0000.JPG" in refused.json["detail"]
