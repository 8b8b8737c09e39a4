"""Checks of the documentation: links, generated tables, the index, and no path of a private machine."""

import re
from pathlib import Path

import pytest

import input_table
import project_tables

ROOT = Path(__file__).resolve().parents[3]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
SOURCES = sorted(
    path
    for folder in ("daemon", "engines", "tools", "tests", "config", "systemd", "scripts", "docs", ".ci")
    for path in (ROOT / folder).rglob("*")
    if path.is_file() and "__pycache__" not in path.parts
)
# Private folders of a user or a machine: paths below them are meaningless to other readers.
OWN_FOLDERS = re.compile(r"(?<![\w.~])/(?:home|root|Users|work|workspace|mnt)/[A-Za-z]")


def anchors(page: Path) -> set[str]:
    """The targets of a page's headings, as GitHub names them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_in_the_documentation_have_a_target(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"https?://", target):
            continue
        file, _, heading = target.partition("#")
        linked = (page.parent / file).resolve() if file else page
        assert linked.exists(), f"{page.name} links to {target}"
        assert not heading or heading in anchors(linked), f"{page.name} links to {target}: no such heading"


def test_the_documentation_index_links_every_page() -> None:
    index = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    for page in (ROOT / "docs").glob("*.md"):
        assert page.name == "README.md" or f"]({page.name})" in index, f"docs/README.md does not name {page.name}"
    for folder in {page.parent for page in (ROOT / "docs").glob("*/**/*.md")}:
        linked = f"]({(folder / 'README.md').relative_to(ROOT / 'docs')})"
        assert linked in index, f"docs/README.md does not name {folder.name}/README.md"


@pytest.mark.parametrize(
    "folder", sorted({page.parent for page in (ROOT / "docs").glob("*/**/*.md")}), ids=lambda p: p.name
)
def test_the_index_of_a_folder_has_every_page_of_it(folder: Path) -> None:
    index = (folder / "README.md").read_text(encoding="utf-8")
    for page in folder.glob("*.md"):
        assert page.name == "README.md" or f"]({page.name})" in index, f"{folder.name}/README.md: no {page.name}"


def test_decisions_are_numbered_without_gaps_and_have_that_number_in_their_title() -> None:
    pages = sorted((ROOT / "docs" / "decisions").glob("[0-9]*.md"))
    for number, page in enumerate(pages, start=1):
        assert re.fullmatch(rf"{number:03d}-[a-z0-9-]+\.md", page.name), page.name
        assert page.read_text(encoding="utf-8").startswith(f"# {number:03d} "), page.name


def test_the_glossary_is_linked_from_both_front_pages() -> None:
    assert "](docs/glossary.md)" in (ROOT / "README.md").read_text(encoding="utf-8")
    assert "](glossary.md)" in (ROOT / "docs" / "README.md").read_text(encoding="utf-8")


def test_the_architecture_page_is_short() -> None:
    assert len(project_tables.PAGE.read_text(encoding="utf-8").splitlines()) <= 200


def test_the_architecture_page_has_the_generated_tables() -> None:
    text = project_tables.PAGE.read_text(encoding="utf-8")
    assert text == project_tables.page(text), "run: .venv/bin/python tests/rigs/project_tables.py"


def test_the_page_of_inputs_has_the_generated_tables_and_every_row_names_tests_that_exist() -> None:
    text = input_table.PAGE.read_text(encoding="utf-8")
    assert text == input_table.page(text), "run: .venv/bin/python tests/rigs/input_table.py"
    for row in (row for rows in input_table.TABLES.values() for row in rows):
        file, names = row.tests
        source = (ROOT / "tests" / "unit" / file).read_text(encoding="utf-8")
        assert names, f"{row.quantity}: no test holds this row"
        for name in names:
            assert f"def {name}(" in source, f"{row.quantity}: {file} has no {name}"


def test_files_named_on_the_architecture_page_exist() -> None:
    text = project_tables.PAGE.read_text(encoding="utf-8")
    for name in re.findall(r"`((?:\w+/)+\w+\.py)`", text):
        assert any((ROOT / folder / name).is_file() for folder in ("daemon/terrafix", "engines", "tools")), name


NOT_OURS = {"validate_gpkg.py", "test_NAME.py"}  # of GDAL; a placeholder


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_source_files_named_in_the_documentation_exist(page: Path) -> None:
    if page.name == "CHANGELOG.md":  # names files as they were at the time
        return
    known = [f"/{path.relative_to(ROOT)}" for path in SOURCES if path.suffix == ".py"]
    for name in re.findall(r"`((?:\w+/)*\w+\.py)`", page.read_text(encoding="utf-8")):
        if Path(name).name not in NOT_OURS:
            assert any(path.endswith(f"/{name}") for path in known), f"{page.name} names {name}"


def test_names_of_the_code_in_contributing_exist() -> None:
    page = re.sub(r"```.*?```", "", (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"), flags=re.S)
    code = "".join(path.read_text(encoding="utf-8") for path in SOURCES if path.suffix in (".py", ".toml"))
    words = set(re.findall(r"\w+", code))
    for name in re.findall(r"`([A-Za-z_]\w*(?:\.[a-z_]\w*)?)(?:\(.*?\))?`", page):
        if not name.endswith((".py", ".md")):
            assert set(name.split(".")) <= words, name


def test_lines_of_prose_in_the_documentation_are_at_most_160_characters_long() -> None:
    for page in (ROOT / "docs").glob("**/*.md"):
        for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), start=1):
            assert len(line) <= 160 or line.startswith(("|", "  |")), f"{page.name}, line {number}"


def test_every_autopilot_fact_names_an_existing_test_and_every_fact_test_is_named() -> None:
    named = set(re.findall(r"`(test_\w+)`", (ROOT / "docs" / "autopilot-facts.md").read_text(encoding="utf-8")))
    tests = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    there = set(re.findall(r"^def (test_\w+)", tests, flags=re.M))
    assert named <= there, sorted(named - there)
    facts = {name for name in there if name.startswith("test_fact_")}
    assert facts <= named, sorted(facts - named)


def test_no_file_contains_a_path_of_a_private_machine() -> None:
    for path in [*SOURCES, *PAGES, ROOT / "pyproject.toml", ROOT / "requirements.lock"]:
        try:
            text = path.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue  # a picture
        found = OWN_FOLDERS.search(text)
        assert found is None, f"{path.relative_to(ROOT)}: {found and found[0]}"
