"""Photos on their way into the console, in a browser: what the form takes from them, the forms in which they come,
an upload that is cancelled, broken off and gone on with, and a flight that is computed again. Nothing is computed."""

import json
import zipfile
from pathlib import Path

import pytest

import browser
import page_flight as page
from browser import Browser
from console_rig import Console, batch, photo
from terrafix_tools.console.store import flights

pytestmark = [
    pytest.mark.slow,
    pytest.mark.real_time,
    pytest.mark.skipif(browser.program() is None, reason="no Chromium on this computer: the page is not tried in it"),
]
NAMES = [f"DJI_{number:04d}.JPG" for number in (7, 8, 10, 11, 12, 40, 41, 42, 99, 100)]  # gaps are normal
UPLOADED_S = 180.0


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory, console: Console) -> list[Path]:
    """Ten, over the middle of the map."""
    lat, lon = page.middle(console)
    folder = tmp_path_factory.mktemp("DCIM")
    for i, name in enumerate(NAMES):
        (folder / name).write_bytes(photo(i, lat, lon))
    return [folder / name for name in NAMES]


def value(window: Browser, field: str) -> str:
    return str(window.run(f"document.getElementById('f-{field}').value"))


def note(window: Browser, field: str) -> str:
    return str(window.run(f"document.getElementById('from-{field}').textContent"))


def begin(window: Browser, console: Console, path: str = "new") -> None:
    window.open(f"{console.url}/page/#/{path}")
    window.wait("document.getElementById('f-name')")


def create(window: Browser, console: Console) -> str:
    """Sends the form -> id of the flight."""
    window.click("form.new button.primary")
    window.wait("location.hash.startsWith('#/flight/')")
    return str(window.run("location.hash.split('/')[2]"))


def names_of(console: Console, flight_id: str) -> list[str]:
    with console.service.database.read() as db:
        return [image.name for image in flights.images_of(db, flight_id, 0, 2000)]


def count_of(flight_id: str) -> str:
    """Script: how many images the service has."""
    return f"fetch('/flights/{flight_id}').then((r) => r.json()).then((f) => f.images.uploaded)"


def uploaded(window: Browser, flight_id: str, count: int = len(NAMES)) -> None:
    window.wait(f"{count_of(flight_id)}.then((n) => n === {count})", UPLOADED_S)


def test_the_form_takes_what_photos_state_says_from_where_and_what_is_typed_wins(
    console: Console, window: Browser, photos: list[Path]
) -> None:
    lat, lon = page.middle(console)
    begin(window, console)
    window.choose_files("#f-images", photos)
    window.wait("document.getElementById('f-fx').value !== ''")
    assert (value(window, "width"), value(window, "height")) == ("640", "480")
    assert float(value(window, "fx")) == pytest.approx(24 / 43.267 * 800, rel=1e-3)
    assert "FocalLengthIn35mmFilm" in note(window, "fx")
    assert (float(value(window, "lat")), float(value(window, "lon"))) == pytest.approx((lat, lon), abs=1e-6)
    assert "GPS of the first photo" in note(window, "lat")
    assert window.run("document.getElementById('f-agl_m').placeholder") == "92.4"
    assert "RelativeAltitude" in note(window, "agl_m")
    assert "DateTimeOriginal of 10 of 10" in window.run("document.querySelector('form.new details').textContent")
    window.run("const f = document.getElementById('f-agl_m'); f.value = 120; f.dispatchEvent(new Event('input'))")
    assert note(window, "agl_m") == "changed by you"
    flight_id = create(window, console)
    uploaded(window, flight_id)
    assert names_of(console, flight_id) == NAMES
    spec = console.send("GET", f"/flights/{flight_id}/config").json["flight"]
    assert (spec["images"], spec["height_m"], spec["override"]) == (10, 120.0, True)
    assert (spec["camera"]["focal_sigma"], spec["mount"]["tolerance_deg"]) == (0.03, 9.0)
    with console.service.database.read() as db:
        assert all('"agl_m":120.0' in str(image.state) for image in flights.images_of(db, flight_id, 0))
    assert window.errors == []


def test_a_zip_a_folder_and_a_flight_folder_give_the_same_photos_as_files(
    console: Console, window: Browser, photos: list[Path], tmp_path: Path
) -> None:
    packed = tmp_path / "photos.zip"
    with zipfile.ZipFile(packed, "w") as archive:
        for i, path in enumerate(photos):
            archive.write(path, f"100MEDIA/{path.name}", zipfile.ZIP_DEFLATED if i % 2 else zipfile.ZIP_STORED)
        archive.writestr("__MACOSX/100MEDIA/._DJI_0007.JPG", b"no photo")
    flight = tmp_path / "field"
    (flight / "frames").mkdir(parents=True)
    rows = ["file,t_s,agl_m"]
    for i, path in enumerate(photos):
        (flight / "frames" / path.name).write_bytes(batch(i, 1)[0][2])  # states nothing
        rows.append(f"{path.name},{i * 1.5},77")
    lat, lon = page.middle(console)
    (flight / "frames.csv").write_text("\n".join(rows) + "\n")
    (flight / "flight.toml").write_text(
        'name = "north field"\n[camera]\nwidth=640\nheight=480\nfx=480\nfy=480\ncx=320\ncy=240\n'
        f"[start]\nlat_deg={lat}\nlon_deg={lon}\nsigma_m=4\n"
    )
    for given in (packed, photos[0].parent, flight):
        begin(window, console)
        window.drop("form.new .drop", [given])
        window.wait("document.getElementById('f-fx').value !== ''")
        said = note(window, "agl_m")
        flight_id = create(window, console)
        uploaded(window, flight_id)
        assert names_of(console, flight_id) == NAMES
    assert said == "of each photo, from frames.csv"
    stored = console.send("GET", f"/flights/{flight_id}").json
    assert (stored["name"], stored["start"]["sigma_m"]) == ("north field", 4.0)
    with console.service.database.read() as db:
        images = flights.images_of(db, flight_id, 0)
    assert [image.t_ns for image in images] == [round(i * 1.5e9) for i in range(10)]
    assert '"agl_m":77.0' in str(images[0].state)
    assert window.errors == []


MANY = 1000


@pytest.mark.nightly  # 45 s
def test_a_thousand_photos_are_cancelled_warned_of_and_gone_on_with_after_a_reload(
    console: Console, window: Browser, tmp_path: Path
) -> None:
    content = batch(0, 1)[0][2]
    many = [tmp_path / f"IMG_{number}.jpg" for number in range(MANY)]
    for path in many:
        path.write_bytes(content)
    begin(window, console)
    window.choose_files("#f-images", many)
    window.wait("document.getElementById('f-width').value === '640'", UPLOADED_S)
    window.run("const f = document.getElementById('f-fx'); f.value = 500; f.dispatchEvent(new Event('input'))")
    flight_id = create(window, console)
    window.wait(f"{count_of(flight_id)}.then((n) => n >= 100)", UPLOADED_S)
    leave = "!dispatchEvent(new Event('beforeunload', {cancelable: true}))"
    assert window.run(leave), "leaving the page is warned of"
    window.click(".upload button")
    window.wait("document.querySelector('.upload').innerText.includes('Cancelled')")
    assert not window.run(leave)
    assert 100 <= window.run(count_of(flight_id)) < MANY
    window.open(f"{console.url}/page/#/flight/{flight_id}")
    window.wait("document.querySelector('.banner.through')?.innerText.includes('of 1,000 photos are here')")
    window.choose_files("#more", many)
    uploaded(window, flight_id, MANY)
    assert names_of(console, flight_id) == [path.name for path in many]


def test_a_flight_is_computed_again_with_changes_from_its_own_form(console: Console, window: Browser) -> None:
    lat, lon = page.middle(console)
    flight_id = page.uploaded(console, name="field", start={"lat": lat, "lon": lon, "sigma_m": 7.0}, height_m=80.0)
    window.open(f"{console.url}/page/#/flight/{flight_id}")
    window.wait("document.querySelector('.actions a.button')")
    window.click(".actions a.button")
    window.wait("document.getElementById('f-sigma_m')?.value === '7'")
    assert (value(window, "name"), value(window, "fx"), value(window, "agl_m")) == ("field", "500", "80")
    assert note(window, "fx") == "as before"
    window.run("const f = document.getElementById('f-fx'); f.value = 510; f.dispatchEvent(new Event('input'))")
    made = create(window, console)
    assert made != flight_id and names_of(console, made) == names_of(console, flight_id)
    spec = console.send("GET", f"/flights/{made}/config").json["flight"]
    assert (spec["camera"]["fx"], spec["start"]["sigma_m"], spec["images"]) == (510.0, 7.0, 10)
    assert window.errors == []


def test_a_failed_flight_is_tried_again(console: Console, window: Browser) -> None:
    flight_id = page.uploaded(console)
    with console.service.database.write() as db:
        flights.update(db, flight_id, state="blocked", error="its process died 5 times in a row (exit code 1)")
    window.open(f"{console.url}/page/#/flight/{flight_id}")
    window.wait("document.querySelector('.banner.through button')")
    window.click(".banner.through button")
    window.wait("document.querySelector('.banner.failed').hidden")
    assert console.send("GET", f"/flights/{flight_id}").json["error"] == ""


def test_names_are_ordered_by_the_page_as_by_the_service(console: Console, window: Browser) -> None:
    names = ["b 2.jpg", "IMG_10.jpg", "IMG_9.jpg", "IMG_009.jpg", "101MEDIA DJI_0001.JPG", "100MEDIA DJI_0999.JPG"]
    names += ["20240101_120000123456789.jpg", "20240101_120000123456790.jpg", "Flug Süd 3.jpg", "IMG_9a.jpg"]
    window.open(f"{console.url}/page/#/")
    window.wait("document.querySelector('.page')")
    script = f"import('/page/js/photos.js').then((m) => {json.dumps(names)}.sort(m.compareNames))"
    assert window.run(script) == sorted(names, key=flights.order_of)
