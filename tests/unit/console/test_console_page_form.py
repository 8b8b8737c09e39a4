"""The form of the page at three widths, in a browser: tabs in one row, a short head on a telephone, texts to be read at
arm's length, image and map of the help view together, no serious finding of axe, and a flight by the keyboard alone."""

import importlib.util
from collections.abc import Iterator
from pathlib import Path

import pytest

import browser
import page_flight as page
from browser import Browser
from console_rig import Console, photo
from terrafix_tools.console.events import CandidateTile, UserInputNeeded
from terrafix_tools.console.payloads import FlightState, Gps, InputRequest, UserFix, WholeVerdict
from terrafix_tools.console.store import flights

pytestmark = [
    pytest.mark.slow,
    pytest.mark.real_time,
    pytest.mark.skipif(browser.program() is None, reason="no Chromium on this computer: the page is not tried in it"),
]
SIZES = {1400: 900, 1024: 768, 420: 860}  # px
AXE = importlib.util.find_spec("axe_core_python")
TARGET_PX = 44  # of what is touched [spec: WCAG 2.2, 2.5.5]
SERIOUS = """axe.run({resultTypes: ['violations']}).then(({violations}) =>
  violations.filter(({impact}) => ['serious', 'critical'].includes(impact))
  .map(({id, nodes}) => [id, nodes.map((node) => node.html.slice(0, 120))]))"""
SMALL_TEXTS = """[...document.querySelectorAll('body *')]
  .filter((e) => e.checkVisibility() && !e.closest('.leaflet-control') && parseFloat(getComputedStyle(e).fontSize) < 16)
  .filter((e) => [...e.childNodes].some((node) => node.nodeType === 3 && node.data.trim()))
  .map((e) => e.className + ': ' + e.textContent.slice(0, 40))"""


@pytest.fixture(scope="module")
def asking(console: Console) -> str:
    """A lost flight that asks where a frame was taken, whose image top is to the east."""
    flight_id = page.uploaded(console, name="a flight with a name that is rather long")
    lost = [page.result(console, i, **page.LOST) for i in range(3, 8)]
    page.store(console, flight_id, [*(page.result(console, i, **page.MATCHED) for i in range(3)), *lost])
    lat, lon = page.middle(console)
    places = [CandidateTile(rank=k, gps=Gps(lat=lat, lon=lon + 1e-5 * k), half_size_m=20.0) for k in range(1, 6)]
    image = f"/flights/{flight_id}/frames/4/image"
    needed = UserInputNeeded(request_id="r1", frame_id=4, image_url=image, candidate_tiles=places)
    with console.service.database.write() as db:
        flights.add_events(db, flight_id, "test", [needed])
        asked = InputRequest(request_id="r1", frame_id=4).model_dump_json()
        flights.update(db, flight_id, state=FlightState.BLOCKED.value, request=asked)
    return flight_id


@pytest.fixture(scope="module")
def live(console: Console) -> str:
    return page.live(console, [page.result(console, i, file="", **page.MATCHED) for i in range(8)])


def show(window: Browser, console: Console, flight_id: str) -> None:
    window.open(f"{console.url}/page/#/flight/{flight_id}")
    window.wait("document.querySelector('.badge.link.live')")


def test_tabs_are_in_one_row_and_the_head_of_a_telephone_is_short(
    console: Console, window: Browser, asking: str, live: str
) -> None:
    for language in ("en", "de"):
        window.open(f"{console.url}/page/#/")
        window.wait("document.querySelector('.page')")
        window.run(f"localStorage.setItem('language', '{language}')")
        for flight_id in (asking, live):
            show(window, console, flight_id)
            for width, height in SIZES.items():
                window.resize(width, height)
                tabs = window.run(
                    "(({scrollWidth, clientWidth, children}) => [scrollWidth - clientWidth, "
                    "new Set([...children].map((tab) => tab.offsetTop)).size])(document.querySelector('.tabs'))"
                )
                assert tabs == [0, 1], (language, width)
            head = "document.querySelector('.bar').offsetHeight + document.querySelector('.glance').offsetHeight"
            assert window.run(head) <= 140
            assert window.run("document.documentElement.scrollWidth") <= 420
    window.run("localStorage.removeItem('language')")


def test_a_telephone_has_the_map_above_the_fold_and_its_tools_under_the_thumb(
    console: Console, window: Browser, live: str
) -> None:
    window.resize(420, SIZES[420])
    show(window, console, live)
    stage = window.run("(({top, height}) => [top, height])(document.querySelector('.map').getBoundingClientRect())")
    assert stage[1] > 0.6 * SIZES[420]
    tools = window.run(
        "[...document.querySelectorAll('.tools button, .tools select')].map((e) => e.getBoundingClientRect())"
        ".map(({top, width, height}) => [top, width, height])"
    )
    assert all(top > SIZES[420] / 2 and min(width, height) >= TARGET_PX for top, width, height in tools)
    window.click(".more")
    assert window.run("document.querySelector('.glance').innerText.includes('above sea level')")
    window.click(".menu")
    assert window.run("[...document.querySelectorAll('.bar nav a')].every((link) => link.checkVisibility())")


def each_page(window: Browser, console: Console, *flight_ids: str) -> Iterator[str]:
    """Opens the pages of the flights, the form and the list, one after the other. -> the path of each."""
    pages = {**{f"flight/{one}": ".tabs" for one in flight_ids}, "new": "form.new", "": ".flights"}
    for path, shown in pages.items():
        window.open(f"{console.url}/page/#/{path}")
        window.wait(f"document.querySelector('{shown}')")
        yield path


@pytest.mark.parametrize("width", SIZES)
def test_no_text_is_smaller_than_16_px(console: Console, window: Browser, asking: str, live: str, width: int) -> None:
    window.resize(width, SIZES[width])
    for _ in each_page(window, console, asking, live):
        assert window.run(SMALL_TEXTS) == []


def test_the_help_view_shows_image_and_map_together_with_the_image_turned_to_north(
    console: Console, window: Browser, asking: str
) -> None:
    for width, height in SIZES.items():
        window.resize(width, height)
        show(window, console, asking)
        window.wait("!document.querySelector('.ask-banner').hidden")
        # The canvas of Leaflet is a tenth larger on each side than the map, whose height the banner has changed.
        window.wait(
            "(({clientHeight: h}) => Math.abs(document.querySelector('.map canvas').clientHeight - 1.2 * h) < 3)"
            "(document.querySelector('.map'))"
        )
        window.click(".ask-banner button")
        assert window.run("document.querySelector('#ask-title').innerText") == "Where was IMG_0004.jpg taken?"
        window.wait("document.querySelector('.ask .frame img')?.naturalWidth === 640")
        window.wait("document.querySelectorAll('.ask .place').length === 5")
        boxes = window.run(
            "['.ask .frame', '.ask-map'].map((s) => document.querySelector(s).getBoundingClientRect())"
            ".map(({top, bottom, width, height}) => [top, bottom, width, height])"
        )
        assert all(top >= 0 and bottom <= height and min(w, h) >= 200 for top, bottom, w, h in boxes), boxes
        image = window.run(
            "(({width, height}) => height / width)(document.querySelector('.ask img').getBoundingClientRect())"
        )
        assert image == pytest.approx(640 / 480, abs=0.01)  # its top, which is to the east, is on the right
    window.click(".ask .frame-view", 0.5, 0.5)
    view = "document.querySelector('.ask .frame-view')"
    across = f"document.querySelector('.ask img').getBoundingClientRect().width / {view}.clientWidth"
    widths = []  # zoomed, whole, zoomed: the first key also shows where the cross is, which takes some of the height
    for key in ("+", "-", "+"):
        for _ in range(4):
            window.press(key, key)
        widths.append(window.run(across))
    assert widths[1:] == pytest.approx([widths[2] / 1.5**4, widths[0]], rel=0.01)
    cross = (
        f"(() => {{ const c = document.querySelector('.ask .cross'); return c.offsetLeft / {view}.clientWidth; }})()"
    )
    assert window.run(cross) == pytest.approx(0.5, abs=0.02)  # zoomed around the cross
    window.click(".ask .frame-view", 0.75, 0.5)  # to the east of it: towards the top of the image
    window.click(".ask-map", 0.5, 0.5)
    window.wait("!document.querySelector('.ask-send .primary').disabled")
    window.click(".ask-send .primary")
    window.wait("!document.querySelector('dialog.ask')")
    with console.service.database.write() as db:
        fix = flights.hints_before(db, asking, 1000)[-1][1]
    assert isinstance(fix, UserFix)
    assert fix.pixel.u == pytest.approx(319.5, abs=3.0) and 100.0 < fix.pixel.v < 235.0
    assert window.errors == []


@pytest.mark.nightly
@pytest.mark.skipif(AXE is None, reason="axe-core is absent (pip install axe-core-python)")
@pytest.mark.parametrize(("theme", "width"), [("light", 1400), ("dark", 1400), ("light", 420)])
def test_axe_has_no_serious_finding(
    console: Console, window: Browser, asking: str, live: str, theme: str, width: int
) -> None:
    assert AXE is not None and AXE.origin is not None
    script = (Path(AXE.origin).parent / "axe.min.js").read_text(encoding="utf-8")
    window.dark(theme == "dark")
    window.resize(width, SIZES[width])
    over = page.uploaded(console)
    page.store(console, over, [page.result(console, i, **page.MATCHED) for i in range(10)])
    verdict = WholeVerdict(
        verdict="trust it",
        trusted_s=[(0, 18)],
        trusted_files=[(page.FILES[0], page.FILES[9])],
        trusted_share=1,
        reasons=[],
    )
    page.completed(console, over, verdict)
    for path in each_page(window, console, asking, live, over):
        window.run(f"{script}; 0")
        if path == f"flight/{live}":
            page.health(console, live)
            window.click("#tab-vehicle")
        assert window.run(SERIOUS) == [], path
        if path == f"flight/{asking}":
            window.click(".ask-banner button")
            window.wait("document.querySelector('.ask .frame img')?.naturalWidth === 640")
            assert window.run(SERIOUS) == [], "help"
    window.dark(False)


def tab_to(window: Browser, selector: str) -> None:
    """With the Tab key alone."""
    for _ in range(80):
        if window.run(f"document.activeElement?.matches({selector!r})"):
            return
        window.press("Tab")
    raise AssertionError(f"Tab does not reach {selector}: {window.run('document.activeElement?.outerHTML')}")


def test_a_photo_flight_is_made_looked_at_helped_and_completed_by_keyboard_alone(
    console: Console, window: Browser, tmp_path: Path
) -> None:
    lat, lon = page.middle(console)
    photos = []
    for i, name in enumerate(page.FILES):
        (tmp_path / name).write_bytes(photo(i, lat, lon))
        photos.append(tmp_path / name)
    window.open(f"{console.url}/page/#/")
    window.wait("document.querySelector('.page')")
    tab_to(window, ".bar nav a[href='#/new']")
    window.press("Enter")
    window.wait("document.getElementById('f-name')")
    tab_to(window, "#f-images")  # Enter opens the chooser of the system, which no test can type into
    window.choose_files("#f-images", photos)
    window.wait("document.getElementById('f-fx').value !== ''")
    tab_to(window, "#f-name")
    for letter in "keys":
        window.press(letter, letter)
    tab_to(window, "#f-complete")
    window.press(" ")  # more may follow
    tab_to(window, "form.new button.primary")
    window.press("Enter")
    window.wait("document.querySelector('.flight-name')?.textContent === 'keys'")
    flight_id = window.run("location.hash.split('/')[2]")
    window.wait("document.querySelector('.upload progress')?.value === 1")
    page.store(console, flight_id, [page.result(console, i, **page.MATCHED) for i in range(10)])
    window.wait("document.querySelector('.cell.wide').innerText.includes('placed')")
    tab_to(window, ".map")
    tab_to(window, ".frame-card .frame-view")
    window.wait("document.querySelector('.frame-card img')?.naturalWidth > 0")  # before that its keys mean nothing
    for key in ("ArrowRight", "ArrowDown", "+", "Enter"):
        window.press(key, key if key == "+" else "")
    window.wait("document.querySelector('.toast')")  # no position of a pixel without a record: an answer all the same
    tab_to(window, "#tab-overview")
    window.press("ArrowRight")
    assert window.run("document.activeElement.id") == "tab-verdicts"
    window.press("ArrowLeft")
    tab_to(window, "#panel-overview .actions button:last-of-type")
    window.press("Enter")
    window.wait("document.querySelector('dialog.ask .frame img')?.naturalWidth === 640")
    for key in ("ArrowRight", "Enter"):
        window.press(key)
    tab_to(window, ".ask-map")
    window.press("Enter")
    tab_to(window, ".ask-send .primary")
    window.press("Enter")
    window.wait("!document.querySelector('dialog.ask')")
    tab_to(window, ".banner.through button")
    window.press("Enter")
    window.wait("document.querySelector('.cell.first').innerText.includes('being solved')")
    assert console.send("GET", f"/flights/{flight_id}").json["completing"]
