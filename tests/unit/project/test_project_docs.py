"""Documentation that cannot rot in silence: links, tables, the index, and no word of somebody's own machine."""

import re
from pathlib import Path

import pytest

import project_tables

ROOT = Path(__file__).resolve().parents[3]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
SOURCES = sorted(
    path
    for folder in ("daemon", "engines", "tools", "tests", "config", "systemd", "scripts", "docs", ".ci")
    for path in (ROOT / folder).rglob("*")
    if path.is_file() and "__pycache__" not in path.parts
)
# Folders of a person's or a machine's own: no path below them means anything to a stranger.
OWN_FOLDERS = re.compile(r"(?<![\w.~])/(?:home|root|Users|work|workspace|mnt)/[A-Za-z]")


def anchors(page: Path) -> set[str]:
    """The targets of a page's headings, as GitHub names them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"https?://", target):
            continue
        file, _, heading = target.partition("#")
        linked = (page.parent / file).resolve() if file else page
        assert linked.exists(), f"{page.name} links to {target}"
        assert not heading or heading in anchors(linked), f"{page.name} links to {target}: no such heading"


def test_the_index_has_every_page() -> None:
    index = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    for page in (ROOT / "docs").glob("*.md"):
        assert page.name == "README.md" or f"]({page.name})" in index, f"docs/README.md does not name {page.name}"


def test_the_architecture_page_has_the_tables_of_the_code() -> None:
    text = project_tables.PAGE.read_text(encoding="utf-8")
    assert text == project_tables.page(text), "run: .venv/bin/python tests/rigs/project_tables.py"


def test_files_named_in_the_architecture_exist() -> None:
    text = project_tables.PAGE.read_text(encoding="utf-8")
    for name in re.findall(r"`((?:\w+/)+\w+\.py)`", text):
        assert any((ROOT / folder / name).is_file() for folder in ("daemon/terrafix", "engines", "tools")), name


def test_every_fact_about_autopilots_names_its_test_and_every_such_test_is_named() -> None:
    named = set(re.findall(r"`(test_\w+)`", (ROOT / "docs" / "autopilot-facts.md").read_text(encoding="utf-8")))
    tests = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    there = set(re.findall(r"^def (test_\w+)", tests, flags=re.M))
    assert named <= there, sorted(named - there)
    facts = {name for name in there if name.startswith("test_fact_")}
    assert facts <= named, sorted(facts - named)


def test_no_path_of_a_machine_of_ours() -> None:
    for path in [*SOURCES, *PAGES, ROOT / "pyproject.toml", ROOT / "requirements.lock"]:
        try:
            text = path.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue  # a picture
        found = OWN_FOLDERS.search(text)
        assert found is None, f"{path.relative_to(ROOT)}: {found and found[0]}"
