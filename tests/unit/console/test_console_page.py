"""The files of the page: complete, of this host alone, in two languages, and with the libraries that are stated."""

import hashlib
import json
import re
from pathlib import Path

import pytest

from console_rig import Console, settings
from terrafix_tools.console.app import PAGE

SCRIPTS = sorted((PAGE / "js").glob("*.js"))
OWN = [PAGE / "index.html", PAGE / "style.css", PAGE / "icon.svg", *SCRIPTS]
NAMESPACE = "http://www.w3.org/2000/svg"


def texts() -> dict[str, dict[str, str]]:
    """-> texts by language and key."""
    source = (PAGE / "js" / "texts.js").read_text(encoding="utf-8")
    found = {}
    for name in ("EN", "DE"):
        body = source.partition(f"const {name} = {{")[2].partition("\n};")[0]
        pairs = re.findall(r'(\w+): ("(?:[^"\\]|\\.)*")', body)
        found[name] = {key: json.loads(text) for key, text in pairs}
        assert len(found[name]) == len(pairs), "a key stands twice"
    return found


def test_everything_that_the_page_names_is_there() -> None:
    html = (PAGE / "index.html").read_text(encoding="utf-8")
    named = re.findall(r'(?:src|href)="([^"]+)"', html)
    assert "js/main.js" in named and "vendor/leaflet/leaflet.js" in named
    assert [name for name in named if not (PAGE / name).is_file()] == []
    imported = {(PAGE / "js" / name) for s in SCRIPTS for name in re.findall(r'from "\./([^"]+)"', s.read_text())}
    assert imported | {PAGE / "js" / "main.js"} == set(SCRIPTS)  # none is missing, and none is left over


@pytest.mark.parametrize("path", OWN, ids=lambda path: path.name)
def test_the_page_names_no_other_host_and_takes_no_text_for_html(path: Path) -> None:
    text = path.read_text(encoding="utf-8").replace(NAMESPACE, "")
    assert re.findall(r"https?://\S+|[\"'(]//\S+", text) == []
    assert re.findall(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function", text) == []


def test_libraries_are_those_of_npm_that_are_stated() -> None:
    stated = json.loads((PAGE / "vendor" / "vendor.json").read_text())
    files = [path for path in (PAGE / "vendor").rglob("*") if path.is_file() and path.name != "vendor.json"]
    sums = {f"{path.parent.name}/{path.name}": hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    assert sums == {f"{name}/{f}": s for name, entry in stated.items() for f, s in entry["sha256"].items()}
    for name, entry in stated.items():
        assert sorted(Path(f).name for f in entry["files"]) == sorted(entry["sha256"])
        assert entry["integrity"].startswith("sha512-") and entry["licence"]
        assert "LICENSE" in entry["sha256"], f"the licence of {name} is delivered with it"


def test_every_text_is_there_in_both_languages_with_the_same_places_for_values() -> None:
    english, german = texts()["EN"], texts()["DE"]
    assert english.keys() == german.keys()
    places = re.compile(r"\{\d\}")
    assert [k for k in english if sorted(places.findall(english[k])) != sorted(places.findall(german[k]))] == []
    used = {key for path in SCRIPTS for key in re.findall(r'\bt\("(\w+)"', path.read_text(encoding="utf-8"))}
    assert len(used) > 100 and used - english.keys() == set()


def luminance(colour: str) -> float:
    """Relative luminance of #rgb or #rrggbb (WCAG 2.2)."""
    digits = colour[1:] if len(colour) == 7 else "".join(2 * c for c in colour[1:])
    parts = [int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    red, green, blue = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def contrast(one: str, other: str) -> float:
    dark, light = sorted((luminance(one), luminance(other)))
    return (light + 0.05) / (dark + 0.05)


@pytest.mark.parametrize("theme", [":root {", ':root[data-theme="dark"] {', ':root:not([data-theme="light"]) {'])
def test_texts_are_readable_in_sunlight(theme: str) -> None:
    style = (PAGE / "style.css").read_text(encoding="utf-8")
    colours = dict(re.findall(r"--([\w-]+): (#[0-9a-f]+)", style.partition(theme)[2].partition("}")[0]))
    texts_on = {"card": ("ink", "soft", "good", "warn", "bad"), "bg": ("ink", "soft"), "accent": ("accent-ink",)}
    pairs = [
        *((text, ground) for ground, of in texts_on.items() for text in of),
        ("bad", "bad-bg"),
        ("warn", "warn-bg"),
    ]
    found = {pair: contrast(colours[pair[0]], colours[pair[1]]) for pair in pairs}
    assert {pair: ratio for pair, ratio in found.items() if ratio < 7.0} == {}  # AAA
    assert min(contrast(colours[name], colours["card"]) for name in ("edge", "accent", "focus")) >= 3.0


def test_the_page_is_served_with_a_policy_that_allows_this_host_alone(tmp_path: Path) -> None:
    with Console(settings(tmp_path)) as console:
        page = console.send("GET", "/page/")
        assert page.status == 200 and page.body == (PAGE / "index.html").read_bytes()
        policy = dict(part.strip().split(" ", 1) for part in page.headers["content-security-policy"].split(";"))
        assert policy["default-src"] == "'none'" and policy["script-src"] == policy["connect-src"] == "'self'"
        allowed = {"'self'", "'none'", "'unsafe-inline'", "data:", "blob:"}
        assert {word for sources in policy.values() for word in sources.split()} <= allowed
        kinds = {
            path: console.send("GET", f"/page/{path}").headers["content-type"] for path in ("js/main.js", "style.css")
        }
        assert kinds["js/main.js"].startswith("text/javascript") and kinds["style.css"].startswith("text/css")
