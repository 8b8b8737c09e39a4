"""Checks of the documentation: links, generated tables, the index, the site, names of files, commands and options, and
no path of a private machine."""

import importlib.util
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import typer

import input_table
import project_tables
from terrafix_tools.cli import app

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
        if re.match(r"https?://|mailto:", target):
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


def site_pages() -> ModuleType:
    spec = importlib.util.spec_from_file_location("site_pages", ROOT / "scripts" / "site_pages.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_index_routes_each_role_by_at_most_five_links_and_the_site_has_every_page() -> None:
    sections = {name: pages for section in site_pages().navigation() for name, pages in section.items()}
    for role in ("Integrator", "Photo operator", "Analyst", "Developer"):
        part = (ROOT / "docs" / "README.md").read_text(encoding="utf-8").split(f"\n## {role}\n")[1].split("\n## ")[0]
        assert 1 <= part.count("](") <= 5, role
    listed = [page for pages in sections.values() for page in pages]
    assert sorted(listed) == sorted([*(page.name for page in ROOT.glob("docs/*.md")), "decisions/README.md"])


def built(folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder / "site")]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.slow
def test_the_site_is_built_and_a_broken_link_or_anchor_fails(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason="mkdocs is not installed: pip install 'terrafix[docs]'")
    for name in subprocess.check_output(["git", "ls-files"], cwd=ROOT, text=True).splitlines():
        if not name.startswith("tests/") or name.endswith(".py"):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, tmp_path / name)
    done = built(tmp_path)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "site" / "architecture.html").read_text(encoding="utf-8")
    assert 'href="link.html' in page and (tmp_path / "site" / "repository" / "CONTRIBUTING.html").is_file()
    with (tmp_path / "docs" / "link.md").open("a", encoding="utf-8") as file:
        file.write("\n[x](nothing.md) [x](autopilot.md#nothing) [x](../nothing.toml)\n")
    done = built(tmp_path)
    assert done.returncode == 1
    assert all(broken in done.stderr for broken in ("'nothing.md'", "#nothing", "nothing.toml"))


def test_the_glossary_is_linked_from_both_front_pages() -> None:
    assert "](docs/glossary.md)" in (ROOT / "README.md").read_text(encoding="utf-8")
    assert "](glossary.md)" in (ROOT / "docs" / "README.md").read_text(encoding="utf-8")


def test_the_architecture_page_is_short() -> None:
    assert len(project_tables.PAGE.read_text(encoding="utf-8").splitlines()) <= 200


def test_the_architecture_page_has_the_generated_table() -> None:
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


def test_functions_named_beside_files_on_the_architecture_page_exist() -> None:
    text = project_tables.PAGE.read_text(encoding="utf-8")
    pairs = re.findall(r"`((?:\w+/)+\w+\.py)`: `(\w+)`(?: \([^)]*\))?(?:, `(\w+)`)?", text)
    assert len(pairs) >= 15
    for name, *functions in pairs:
        file = next(ROOT / folder / name for folder in ("daemon/terrafix", "tools") if (ROOT / folder / name).is_file())
        code = file.read_text(encoding="utf-8")
        for function in filter(None, functions):
            assert re.search(rf"^(?: *(?:def|class) {function}\b|{function}\b.* = )", code, flags=re.M), (
                f"{name} has no {function}"
            )


NOT_OURS = {"validate_gpkg.py", "test_NAME.py"}  # of GDAL; a placeholder


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_source_files_named_in_the_documentation_exist(page: Path) -> None:
    if page.name == "CHANGELOG.md":  # names files as they were at the time
        return
    known = [f"/{path.relative_to(ROOT)}" for path in SOURCES if path.suffix == ".py"]
    for name in re.findall(r"`((?:\w+/)*\w+\.py)`", page.read_text(encoding="utf-8")):
        if Path(name).name not in NOT_OURS:
            assert any(path.endswith(f"/{name}") for path in known), f"{page.name} names {name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_files_and_modules_named_in_the_documentation_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"`((?:config|scripts|systemd|tests|daemon|engines|tools|docs)/[\w./-]*)`", text):
        assert (ROOT / name).exists() or re.search("AREA|NAME|NNN", name), f"{page.name} names {name}"
    for module, then in re.findall(r"python -m (terrafix[\w.]+)(.{0,100})", " ".join(text.split())):
        if "as of commit" not in then and "NAME" not in module:  # the decision names the revision in which it runs
            path = module.replace(".", "/")
            places = [ROOT / folder / path for folder in ("daemon", "engines", "tools")]
            assert any(one.with_suffix(".py").is_file() or (one / "__main__.py").is_file() for one in places), (
                f"{page.name} names {module}"
            )


def unknown_commands(text: str) -> list[str]:
    """Commands and options of `terrafix` that a page names and the command line does not have."""
    program = typer.main.get_command(app)
    unknown = []
    for words, rest in re.findall(
        r"(?:^|[`(/]|^[^`\n]* )terrafix ([a-z][a-z-]*(?: [a-z][a-z-]*)?)([^`\n#|;]*)", text, flags=re.M
    ):
        command: Any = program
        for word in words.split():
            if not hasattr(command, "get_command"):  # no group: the word is an argument
                break
            command = command.get_command(typer.Context(command), word)
            if command is None:
                unknown.append(f"terrafix {words}")
                break
        if command is None:
            continue
        options = {name for one in command.params for name in (*one.opts, *one.secondary_opts)}
        for option in re.findall(r"(?<!\S)--[a-z][a-z0-9-]*", rest):
            if option not in options:
                unknown.append(f"terrafix {words} {option}")
    return unknown


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_commands_and_options_named_in_the_documentation_exist(page: Path) -> None:
    code = "\n".join(re.findall(r"```.*?```|^    .*?$|`[^`\n]+`", page.read_text(encoding="utf-8"), flags=re.S | re.M))
    assert unknown_commands(code) == []


def test_a_command_or_an_option_that_does_not_exist_is_found() -> None:
    text = (
        "`terrafix fly`\n`terrafix map fly` `terrafix replay F --nothing`\n    .venv/bin/terrafix map build A --out B"
    )
    assert unknown_commands(text) == ["terrafix fly", "terrafix map fly", "terrafix replay --nothing"]


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
