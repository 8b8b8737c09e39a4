"""The folder that a simulated flight writes: emptied when an earlier one made it, left alone when it did not."""

import json
import shutil
from pathlib import Path
from typing import Any

from terrafix.core.errors import OutputError


def make_room(out: Path, mark: str, about: dict[str, Any]) -> None:
    """An empty folder with the file ``mark``, which says that it is ours to empty, and ``about`` in it.

    Raises OutputError for a folder with other things in it."""
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out}: is a file; give a folder with --out")
    if out.is_dir() and any(out.iterdir()) and not (out / mark).is_file():
        maker = mark.partition(".")[0]
        raise OutputError(f"{out}: holds files that no {maker} made; give another folder with --out")
    try:
        if out.is_dir():
            for entry in out.iterdir():
                shutil.rmtree(entry) if entry.is_dir() and not entry.is_symlink() else entry.unlink()
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); give another folder with --out") from None
    write_json(out / mark, about)


def write_json(path: Path, data: dict[str, Any]) -> None:
    """Raises OutputError."""
    try:
        path.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); give another folder with --out") from None
