"""Exports of a flight over HTTP and in the page: formats, positions, names; several files come as a zip file."""

import io
import time
import zipfile
from pathlib import Path

import pytest

import browser
import page_flight as page
from browser import Browser
from console_rig import Console, batch
from flight_records import ORIGIN, PERIOD_NS, estimate, frame, write_record
from origins import origin_of
from terrafix import messages as m
from terrafix_tools.export.formats import FORMATS
from terrafix_tools.export.track import WHICH
from terrafix_tools.finalised import FinalRow, write

pytestmark = pytest.mark.slow  # each export is a process
NAME = "north: field/7"
CAMERA = m.Camera(width=640, height=480, fx=500.0, fy=500.0, cx=319.5, cy=239.5)


@pytest.fixture(scope="module")
def recorded(console: Console) -> str:
    """A flight whose ten photos were computed, and whose last one has no position."""
    flight_id = page.uploaded(console, name=NAME)
    out = console.service.settings.flight(flight_id) / "out"
    out.mkdir()
    messages: list[m.Message] = [origin_of(CAMERA)]
    for i, name in enumerate(page.FILES):
        messages += [frame(i, name), *([estimate(i, 20.0 * i, 0.0)] if i < 9 else [])]
    write_record(out / "flight-000.mcap", messages)
    return flight_id


def send(console: Console, flight_id: str, kind: str, which: str = "best") -> tuple[str, bytes]:
    """-> name and content of the file."""
    answer = console.send("GET", f"/flights/{flight_id}/exports/{kind}?which={which}")
    assert answer.status == 200, answer.body
    return answer.headers["content-disposition"], answer.body


def test_a_track_has_the_name_of_the_flight_and_of_its_photos(console: Console, recorded: str) -> None:
    name, content = send(console, recorded, "gpx", "immediate")
    assert "north- field-7-immediate.gpx" in name.replace("%20", " ")
    assert b"<name>north- field-7</name>" in content and content.count(b"<trkpt") == 9
    assert b"<name>IMG_0000.jpg</name>" in content


def test_what_is_several_files_is_a_zip_file(console: Console, recorded: str) -> None:
    for kind, names in {
        "photos": page.FILES[:9],
        "shp": [f"north- field-7-best.{x}" for x in ("dbf", "prj", "shp", "shx")],
    }.items():
        name, content = send(console, recorded, kind)
        assert ".zip" in name
        with zipfile.ZipFile(io.BytesIO(content)) as packed:
            found = [Path(one).name for one in packed.namelist()]
            assert set(names) <= set(found)
            sizes = [info.file_size for info in packed.infolist()]
        if kind == "photos":
            assert all(tagged > len(photo) for tagged, (_, _, photo) in zip(sizes, batch(0), strict=False))
    folder, end_s = console.service.settings.flight(recorded), time.monotonic() + 10.0
    while list(folder.glob("export-*")) and time.monotonic() < end_s:  # removed when it is sent
        time.sleep(0.02)
    assert list(folder.glob("export-*")) == []


def test_the_finalised_positions_are_offered_when_there_are_some(console: Console, recorded: str) -> None:
    path = f"/flights/{recorded}/exports"
    assert console.send("GET", path).json["which"] == [one for one in WHICH if one != "finalised"]
    refused = console.send("GET", f"{path}/csv?which=finalised")
    assert refused.status == 404 and "refined" in refused.json["detail"]
    out = console.service.settings.flight(recorded) / "out"
    lat, lon = ORIGIN.to_wgs84(5.0, 5.0)
    identity = "1 0 0 0"
    cov = " ".join("1" if i % 7 == 0 else "0" for i in range(36))
    row = FinalRow(page.FILES[0], 0.0, lat, lon, 600.0, 1.0, 1.0, 0.0, 1.0, 90.0, identity, cov)
    rows = [row, *(FinalRow(name, i * PERIOD_NS / 1e9) for i, name in enumerate(page.FILES) if i)]
    write(out, rows, {"flights": []})
    try:
        assert console.send("GET", path).json["which"] == list(WHICH)
        _, content = send(console, recorded, "csv")
        assert content.decode().splitlines()[1].startswith("IMG_0000.jpg,0.000,48.0000")
        assert len(content.splitlines()) == 2
    finally:
        for file in out.glob("finalised.*"):
            file.unlink()


def test_what_cannot_be_exported_is_refused_in_words(console: Console, recorded: str) -> None:
    empty = page.uploaded(console, name="empty")
    for flight_id, kind, which, status, words in (
        (empty, "csv", "best", 409, "no image of this flight is computed yet"),
        (recorded, "csv", "refined", 409, "no frame has a position that is refined"),
        (recorded, "dwg", "best", 404, "give one of"),
        ("none", "csv", "best", 404, "no flight 'none'"),
    ):
        answer = console.send("GET", f"/flights/{flight_id}/exports/{kind}?which={which}")
        assert answer.status == status and words in answer.json["detail"], answer.body
        assert "/out" not in answer.json["detail"]


def test_every_format_and_choice_has_its_words_in_the_page() -> None:
    from test_console_page import texts

    for table in texts().values():
        assert {f"export_{name}" for name in (*FORMATS, *WHICH)} <= set(table)


@pytest.mark.real_time
@pytest.mark.skipif(browser.program() is None, reason="no Chromium on this computer: the page is not tried in it")
def test_the_export_tab_saves_the_file_by_its_name(
    console: Console, window: Browser, recorded: str, tmp_path: Path
) -> None:
    window.downloads(tmp_path)
    window.open(f"{console.url}/page/#/flight/{recorded}")
    window.wait("document.querySelector('#tab-export')")
    window.click("#tab-export")
    window.wait("document.querySelector('#export-format').options.length > 10")
    window.run("document.querySelector('#export-format').value = 'odm'")
    window.click("#panel-export .primary")
    window.wait("document.querySelector('.toast')?.innerText.includes('geo.txt')")
    end_s = time.monotonic() + 10.0
    while not (tmp_path / "geo.txt").is_file() and time.monotonic() < end_s:
        time.sleep(0.05)
    assert (tmp_path / "geo.txt").read_text(encoding="utf-8").startswith("EPSG:4326\nIMG_0000.jpg 11.0")
    window.run("document.querySelector('#export-which').value = 'refined'")
    window.click("#panel-export .primary")
    window.wait("document.querySelector('.toast.bad')?.innerText.includes('no frame has a position that is refined')")
    assert [error for error in window.errors if "409" not in error] == []
