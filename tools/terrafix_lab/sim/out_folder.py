"""Output folder of a simulated flight: emptied if an earlier flight made it, otherwise refused when not empty."""

import json
import shutil
from pathlib import Path
from typing import Any

from terrafix.core.errors import OutputError


def prepare_folder(out: Path, marker: str, about: dict[str, Any]) -> None:
    """Makes ``out`` an empty folder that contains the file ``mark``, which marks it as ours, with ``about`` as JSON.

    Raises OutputError when the folder has files and no ``mark``.
    """
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out}: is a file; give a folder with --out")
    if out.is_dir() and any(out.iterdir()) and not (out / marker).is_file():
        maker = marker.partition(".")[0]
        raise OutputError(f"{out}: contains files that were not made by {maker}; give another folder with --out")
    try:
        if out.is_dir():
            for entry in out.iterdir():
                shutil.rmtree(entry) if entry.is_dir() and not entry.is_symlink() else entry.unlink()
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); give another folder with --out") from None
    write_json(out / marker, about)


def write_json(path: Path, data: dict[str, Any]) -> None:
    """Writes JSON. Raises OutputError."""
    try:
        path.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); give another folder with --out") from None
