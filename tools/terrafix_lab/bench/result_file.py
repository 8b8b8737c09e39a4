"""The JSON file of a benchmark that was asked for one."""

import json
from pathlib import Path
from typing import Any

from terrafix.core.errors import OutputError


def write_result(path: Path | None, result: Any) -> None:
    """``path`` None: no file was asked for. Raises OutputError."""
    if path is None:
        return
    try:
        path.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from None
