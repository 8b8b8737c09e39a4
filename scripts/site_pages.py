"""Hooks of mkdocs (mkdocs.yml): the navigation is that of docs/README.md, and files that pages link to outside of docs/
are part of the site, below repository/."""

import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
LINK = re.compile(r"\]\(([^)\s#]+)(#[^)\s]*)?\)")


def navigation() -> list[dict[str, list[str]]]:
    """-> sections of docs/README.md with the pages that each links to first, in order."""
    sections: list[dict[str, list[str]]] = []
    seen: set[str] = set()
    for part in (DOCS / "README.md").read_text(encoding="utf-8").split("\n## ")[1:]:
        pages = [file for file, anchor in LINK.findall(part) if not anchor and (DOCS / file).is_file()]
        new = [file for file in dict.fromkeys(pages) if file not in seen and not file.startswith("..")]
        seen.update(new)
        sections.append({part.partition("\n")[0]: new})
    return [{"Documentation": ["README.md"]}, *sections]


def target(page: Path, link: str) -> Path | None:
    """The file or folder outside of docs/ that a link of a page names, below the repository; None: another link."""
    path = (page.parent / link).resolve()
    inside = path.is_relative_to(DOCS) or not path.is_relative_to(ROOT)
    return None if re.match(r"\w+:", link) or inside else path.relative_to(ROOT)


def on_config(config: Any) -> Any:
    config["nav"] = navigation()
    return config


def on_files(files: Any, config: Any) -> Any:
    """Adds what the pages link to, and the documents at the top of the repository."""
    from mkdocs.structure.files import File  # here: the tests read the navigation without mkdocs

    pages = [*DOCS.rglob("*.md"), *ROOT.glob("*.md")]
    found = {target(page, link) for page in pages for link, _ in LINK.findall(page.read_text(encoding="utf-8"))}
    for path in sorted({*found, *(page.relative_to(ROOT) for page in ROOT.glob("*.md"))} - {None}):
        for file in (ROOT / path).iterdir() if (ROOT / path).is_dir() else [ROOT / path]:
            if file.is_file():
                files.append(File.generated(config, f"repository/{file.relative_to(ROOT)}", abs_src_path=str(file)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links out of docs/ lead to the copies; those of the documents at the top lead into docs/."""
    source = Path(page.file.abs_src_path)
    up = "../" * len(source.relative_to(DOCS).parent.parts) if source.is_relative_to(DOCS) else "../"

    def moved(link: re.Match[str]) -> str:
        path = (source.parent / link[1]).resolve()
        if re.match(r"\w+:", link[1]) or not path.is_relative_to(ROOT) or not path.exists():
            return link[0]  # mkdocs reports what does not exist
        if path.is_relative_to(DOCS):
            return f"]({up}{path.relative_to(DOCS)}{link[2] or ''})" if not source.is_relative_to(DOCS) else link[0]
        path = path.relative_to(ROOT)
        first = next((one.name for one in sorted((ROOT / path).iterdir())), "") if (ROOT / path).is_dir() else ""
        return f"]({up}repository/{path / first}{link[2] or ''})"

    return LINK.sub(moved, markdown)
