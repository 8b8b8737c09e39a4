"""Files that belong to Terrafix and are no code: configuration, parameters of autopilots, the systemd unit.

In a wheel they are in the folder ``data`` of the package, with the paths that they have in the source tree."""

from importlib import resources
from pathlib import Path

from terrafix.core.errors import UsageError


def installed_files() -> Path:
    """The folder that has ``config`` and ``systemd``: of the package, or the source tree. Raises UsageError."""
    package = Path(str(resources.files("terrafix")))
    for folder in (package / "data", package.parents[1]):
        if (folder / "config" / "default.toml").is_file():
            return folder
    raise UsageError(f"{package}: its files are missing; install Terrafix again")
