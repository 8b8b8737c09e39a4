"""The map package of a recorded flight."""

from pathlib import Path
from typing import Any

from terrafix_tools.mapping.build import ensure_package
from terrafix_tools.replay import map_cache_dir


def map_of_flight(folder: Path, given: Path | None, summary: dict[str, Any], header: dict[str, Any]) -> Path | None:
    """The map ``given`` by the user, or the one that summary.json or the configuration in the ``header`` of the record
    names, or one in the folder; None: there is none. Raises MapError."""
    if given is not None:
        return ensure_package(given, map_cache_dir())
    config = header.get("config", {})
    named = [summary.get("map", {}).get("path", ""), config.get("map", {}).get("path", "")]
    candidates = [Path(name) for name in named if name.endswith(".gpkg")] + sorted(folder.glob("*.gpkg"))
    return next((path for path in candidates if path.is_file()), None)
