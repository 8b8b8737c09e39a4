"""How Terrafix is installed here, for messages that say what to type."""

import json
import sys
from importlib import metadata
from pathlib import Path
from urllib.parse import unquote, urlparse

from terrafix import __version__


def _origin(distribution: str) -> str:
    """Folder or wheel that a distribution was installed from (PEP 610); "" where an index gave it."""
    try:
        stated = json.loads(metadata.distribution(distribution).read_text("direct_url.json") or "{}")
    except (metadata.PackageNotFoundError, ValueError):
        return ""
    url = urlparse(str(stated.get("url", "")))
    return unquote(url.path) if url.scheme == "file" else ""


def install_command(extra: str) -> str:
    """What installs ``extra`` into this installation: by pipx, from the checkout or the wheel that it came from."""
    origin = _origin("terrafix")
    name = f"'{origin or 'terrafix'}[{extra}]'"
    if "pipx" in Path(sys.prefix).parts:
        beside = f" --pip-args '--find-links {Path(origin).parent}'" if origin else ""
        return f"pipx install --force {name}{beside}"
    if origin and Path(origin).is_dir():
        return f"{sys.executable} -m pip install -e {name} -e {Path(origin) / 'tools'}"
    beside = f" --find-links {Path(origin).parent}" if origin else ""
    return f"{sys.executable} -m pip install {name}{beside}"


def command() -> str:
    """What calls this program from here: its name if that is on the path, else its file."""
    program = Path(sys.argv[0])
    return "terrafix" if program.name != "terrafix" or _on_path(program) else str(program)


def _on_path(program: Path) -> bool:
    from shutil import which

    found = which("terrafix")
    return found is not None and Path(found).resolve() == program.resolve()


def docs_page(name: str) -> str:
    """Where a page of the documentation is: in the checkout, else its name in the source of this version."""
    page = Path(_origin("terrafix")) / "docs" / name
    return str(page) if page.is_file() else f"docs/{name} of Terrafix {__version__}"
