"""What the page says of a flight, in a real browser at three widths: whether a position is known and how it is written,
the verdict on the flight, what the autopilot has, and the words for all of it. Nothing is computed here."""

import json
import re

import pytest
from pyproj import Transformer

import browser
import page_flight as page
from browser import Browser
from console_rig import Console
from terrafix.link.integrity import fix_type
from terrafix.messages import Verdict
from terrafix_tools import flight_verdict
from terrafix_tools.console.app import PAGE
from terrafix_tools.console.events import VerdictGiven
from terrafix_tools.console.payloads import FlightState, WholeVerdict

pytestmark = [
    pytest.mark.slow,
    pytest.mark.real_time,
    pytest.mark.skipif(browser.program() is None, reason="no Chromium on this computer: the page is not tried in it"),
]
SIZES = {1400: 900, 1024: 768, 420: 860}  # px
FIRST, POSITION = "document.querySelector('.cell.first')", "document.querySelector('.cell.wide')"
IN_PART = WholeVerdict(
    verdict="trust it in part",
    trusted_s=[(0.0, 8.0)],
    trusted_files=[("IMG_0000.jpg", "IMG_0004.jpg")],
    trusted_share=0.5,
    reasons=["no map match for over 35 s"],
)


def show(window: Browser, console: Console, flight_id: str) -> None:
    window.open(f"{console.url}/page/#/flight/{flight_id}")
    window.wait("document.querySelector('.badge.link.live')")


def language(window: Browser, console: Console, name: str) -> None:
    window.open(f"{console.url}/page/#/")
    window.wait("document.querySelector('.page')")
    window.run(f"localStorage.setItem('language', '{name}')")


def assert_first_is_largest(window: Browser) -> None:
    """At every width."""
    sizes = "[...document.querySelectorAll('.cell .value')].map((e) => parseFloat(getComputedStyle(e).fontSize))"
    for width, height in SIZES.items():
        window.resize(width, height)
        first, *others = window.run(sizes)
        assert first > max(others)


def test_an_unknown_position_is_no_coordinate_and_the_map_shows_its_whole_ellipse(
    console: Console, window: Browser
) -> None:
    flight_id = page.uploaded(console)
    placed = [page.result(console, i, **page.MATCHED) for i in range(4)]
    page.store(console, flight_id, placed)
    show(window, console, flight_id)
    window.wait(f"{POSITION}.innerText.includes('placed: map match')")
    lost = [page.result(console, i, 200.0 * (i - 3), **page.LOST) for i in range(4, 8)]
    page.store(console, flight_id, lost, FlightState.RECOVERING)
    window.wait(f"{POSITION}.innerText.includes('POSITION UNKNOWN')")
    said = window.run(f"{POSITION}.innerText")
    assert "searching the whole map" in said and not re.search(r"\d\d\.\d{3}", said)
    metres = "Number(document.querySelector('.leaflet-control-scale-line').textContent.replace(/\\D/g, ''))"
    line = "document.querySelector('.leaflet-control-scale-line')"
    width = f"document.querySelector('.map').offsetHeight / {line}.offsetWidth"
    window.wait(f"{metres} * {width} > 1300")  # an ellipse of 800 m to either side, turned by 30 degrees
    assert window.errors == []


def test_a_propagated_position_says_so_and_an_unplaced_flight_has_none(console: Console, window: Browser) -> None:
    flight_id = page.uploaded(console)
    results = [page.result(console, 0, **page.MATCHED), *(page.result(console, i, **page.PROPAGATED) for i in (1, 2))]
    page.store(console, flight_id, results)
    show(window, console, flight_id)
    window.wait(f"{POSITION}.innerText.includes('propagated: odometry')")
    window.wait("document.querySelector('.frame-facts').innerText.includes('too low above the ground to match')")
    without = page.result(console, 0, source="not_placed", match="few_inliers")
    without.gps = without.ellipse = None
    nowhere = page.uploaded(console)
    page.store(console, nowhere, [without])
    show(window, console, nowhere)
    window.wait(f"{POSITION}.innerText.includes('POSITION UNKNOWN')")


def test_the_verdict_of_a_completed_flight_is_its_headline(console: Console, window: Browser) -> None:
    flight_id = page.uploaded(console)
    page.store(console, flight_id, [page.result(console, i, **page.MATCHED) for i in range(10)])
    page.completed(console, flight_id, IN_PART)
    assert console.send("GET", f"/flights/{flight_id}").json["verdict"]["verdict"] == "trust it in part"
    show(window, console, flight_id)
    said = window.run(f"{FIRST}.innerText")
    assert "TRUST IT IN PART" in said and "only IMG_0000.jpg – IMG_0004.jpg" in said
    assert "nothing matched the map for over 35 s" in said
    assert_first_is_largest(window)
    window.open(f"{console.url}/page/#/")
    window.wait("document.querySelector('.flights')")
    assert "TRUST IT IN PART" in window.run("document.querySelector('.flights').innerText")


def test_a_live_flight_shows_first_and_largest_what_the_autopilot_gets(console: Console, window: Browser) -> None:
    flight_id = page.live(console, [page.result(console, i, file="", **page.MATCHED) for i in range(8)])
    show(window, console, flight_id)
    page.health(console, flight_id)
    window.wait(f"{FIRST}.innerText.includes('3D fix ± 3.2 m')")
    assert window.run(f"document.querySelector('.cell') === {FIRST}")
    assert_first_is_largest(window)
    page.health(console, flight_id, fix="none", reason="accuracy 77 m is worse than 50 m", accuracy_m=None)
    window.wait(f"{FIRST}.innerText.includes('accuracy of 77 m, the limit is 50 m')")


def test_a_start_that_was_given_is_in_the_facts_and_on_the_map(console: Console, window: Browser) -> None:
    lat, lon = page.middle(console)
    flight_id = page.uploaded(console, start={"lat": lat, "lon": lon, "sigma_m": 25.0})
    page.store(console, flight_id, [page.result(console, 0, **page.MATCHED)])
    show(window, console, flight_id)
    window.wait("document.querySelector('#panel-overview').innerText.includes('± 25.0 m')")
    window.wait("[...document.querySelectorAll('.measured')].some((e) => e.textContent === 'Start')")


def test_a_flight_whose_photos_are_all_computed_asks_for_its_completion(console: Console, window: Browser) -> None:
    flight_id = page.uploaded(console)
    page.store(console, flight_id, [page.result(console, i, **page.MATCHED) for i in range(9)])
    show(window, console, flight_id)
    assert window.run("document.querySelector('.banner.through').hidden")
    page.store(console, flight_id, [page.result(console, 9, **page.MATCHED)])
    window.wait("!document.querySelector('.banner.through').hidden")
    window.click(".banner.through button")
    window.wait("document.querySelector('.banner.through').hidden")
    assert console.send("GET", f"/flights/{flight_id}").json["completing"]


def test_verdicts_and_events_are_told_in_words_with_file_names_in_both_languages(
    console: Console, window: Browser
) -> None:
    flight_id = page.uploaded(console)
    given = [
        VerdictGiven(
            frame_id=0, file="IMG_0000.jpg", measurement="map", verdict=verdict, detail=detail, test_ratio=None
        )
        for verdict, detail in (("accepted", "information share 1.00"), ("too_low", ""))
    ]
    page.store(console, flight_id, [page.result(console, 0, **page.MATCHED)], others=tuple(given))
    for name, expected in {
        "de": ("IMG_0000.jpg", "Kartenabgleich", "zu tief über dem Boden", "Gewicht 1.00"),
        "en": ("IMG_0000.jpg", "map match", "too low above the ground", "weight 1.00"),
    }.items():
        language(window, console, name)
        show(window, console, flight_id)
        window.click("#tab-verdicts")
        window.wait("document.querySelectorAll('#panel-verdicts tbody tr').length === 2")
        table = window.run("document.querySelector('#panel-verdicts').innerText")
        assert [words for words in expected if words not in table] == []
        assert "too_low" not in table and "information share" not in table


def test_every_verdict_and_every_reason_has_its_words() -> None:
    texts = (PAGE / "js" / "texts.js").read_text(encoding="utf-8")
    missing = [verdict for verdict in Verdict if texts.count(f"verdict_{verdict.value}: ") != 2]
    assert missing == []
    lines = (PAGE / "js" / "words.js").read_text(encoding="utf-8")
    known = set(re.findall(r'(?:same\(|\[)"([^"]+)"', lines))
    said = [fix_type.NOT_PLACED.text, fix_type.STARTED_IN_FLIGHT.text, fix_type.ONLY_DISARMED.text]
    said += [flight_verdict.START_CONTRADICTS_MAP, flight_verdict._rejected_matches({"innovation": 9, "accepted": 1})]
    rows = [flight_verdict.Row("", 99.0, source_label=label) for label in ("not_placed", "dead_reckoned")]
    rows += [
        flight_verdict.Row("", 99.0, 1.0, 1.0, sigma_e_m=s, sigma_n_m=s, anchor_age_ms=a)
        for s, a in ((99, 0), (1, -1), (1, 99_999))
    ]
    said += [flight_verdict._distrust_reason(row, 0.0, []) for row in rows]
    assert len(set(said)) == 10
    assert [text for text in said if re.sub(r"\d+(\.\d+)?", "{}", text) not in known] == []


MGRS = {  # by GEOTRANS (mgrs 1.5 of PyPI), also in the zones that are wider or narrower than six degrees
    (48.137212, 11.575512): "32U PU 91604 34759",
    (-33.8568, 151.2153): "56H LH 34900 52288",
    (60.39, 5.32): "32V KN 97230 00510",
    (78.22, 15.65): "33X WG 14813 83004",
    (0.5, -179.99): "01N AA 67148 55340",
    (-54.8, -68.3): "19F EV 45000 27239",
    (83.9, -40.0): "24X VU 88136 17033",
}


def test_positions_are_written_as_utm_mgrs_and_seconds_like_other_programs_do(
    console: Console, window: Browser
) -> None:
    window.open(f"{console.url}/page/#/")
    window.wait("document.querySelector('.page')")

    def written(name: str, *points: tuple[float, float], accuracy: float = 1.0) -> list[str]:
        given = json.dumps([{"lat": lat, "lon": lon} for lat, lon in points])
        script = (
            f"import('/page/js/coordinates.js').then((m) => {given}.map((p) => m.written(p, '{name}', {accuracy})))"
        )
        return window.run(script)

    assert written("mgrs", *MGRS) == [*MGRS.values()]
    for (lat, lon), text in zip(MGRS, written("utm", *MGRS, accuracy=0.3), strict=True):
        zone, east, north = text.split()
        epsg = (32600 if lat >= 0 else 32700) + int(zone[:-1])
        expected = Transformer.from_crs(4326, epsg, always_xy=True).transform(lon, lat)
        assert (float(east), float(north)) == pytest.approx(expected, abs=0.051)
    munich = (48.137212, 11.575512)
    assert written("dms", munich, (-0.0001, -179.99999)) == [
        "48°08′13.96″N 11°34′31.84″E",
        "0°00′00.36″S 179°59′59.96″W",
    ]
    shown = {m: written("degrees", munich, accuracy=m)[0] for m in (0.2, 1.0, 4.0, 40.0, 800.0, 20_000.0)}
    assert [len(text.split(",")[0].split(".")[1]) for text in shown.values()] == [7, 6, 5, 4, 3, 2]
    assert [written("mgrs", munich, accuracy=m)[0] for m in (40.0, 400.0)] == ["32U PU 9160 3475", "32U PU 916 347"]
    assert written("utm", munich, accuracy=40.0) == ["32U 691600 5334760"]
    assert written("mgrs", (85.0, 10.0)) == ["85.000000, 10.000000"]  # beyond the zones


def test_the_chosen_way_to_write_positions_is_copied_and_kept(console: Console, window: Browser) -> None:
    flight_id = page.uploaded(console)
    page.store(console, flight_id, [page.result(console, 0, **page.MATCHED)])
    show(window, console, flight_id)
    window.run("const s = document.querySelector('.format'); s.value = 'mgrs'; s.dispatchEvent(new Event('change'))")
    window.wait(f"/^51[A-Z] [A-Z]{{2}} \\d+ \\d+$/m.test({POSITION}.innerText)")
    window.run("navigator.clipboard.writeText = (text) => { window.copied = text; return Promise.resolve(); }")
    window.run("[...document.querySelectorAll('.tools button')].at(-1).click()")
    window.wait("window.copied")
    assert window.run("window.copied") in window.run(f"{POSITION}.innerText")
    show(window, console, flight_id)
    window.wait(f"/^51[A-Z] /m.test({POSITION}.innerText)")
    window.run("localStorage.removeItem('format')")
