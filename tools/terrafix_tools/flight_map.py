"""The map package of a recorded flight."""

import os
from pathlib import Path
from typing import Any

from terrafix.core.errors import MapError
from terrafix_tools.installation import install_command


def map_of_flight(folder: Path, given: Path | None, summary: dict[str, Any], header: dict[str, Any]) -> Path | None:
    """The map ``given`` by the user, or the one that summary.json or the configuration in the ``header`` of the record
    names, or one in the folder; None: there is none. Raises MapError."""
    if given is not None:
        return package_of(given)
    config = header.get("config", {})
    named = [summary.get("map", {}).get("path", ""), config.get("map", {}).get("path", "")]
    candidates = [Path(name) for name in named if name.endswith(".gpkg")] + sorted(folder.glob("*.gpkg"))
    return next((path for path in candidates if path.is_file()), None)


def package_of(path: Path, *, progress: bool = False) -> Path:
    """The path itself if it is a package, else one that is built once and cached. Only that needs GDAL, which is not
    installed on a vehicle. Raises MapError, OutputError."""
    if path.suffix.lower() == ".gpkg":
        return path
    try:
        from terrafix_tools.mapping.build import ensure_package
    except ModuleNotFoundError:
        raise MapError(
            f"{path}: no map package (.gpkg); this installation makes none: use `terrafix map build` on the ground, or "
            f"{install_command('ground')}"
        ) from None

    return ensure_package(path, map_cache_dir(), progress=progress)


def map_cache_dir() -> Path:
    """Folder that caches packages made from GeoTIFFs."""
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "terrafix" / "maps"
