"""The folder for what the next start must know, also after a loss of power."""

import os
from pathlib import Path

SERVICE = Path("/var/lib/terrafix")  # StateDirectory= of the service


def state_folder() -> Path:
    """-> $STATE_DIRECTORY (systemd); else the service's folder for whoever may write there, as preflight run by its
    account; else $XDG_STATE_HOME/terrafix, by default ~/.local/state/terrafix. It need not exist."""
    if by_systemd := os.environ.get("STATE_DIRECTORY"):
        return Path(by_systemd.partition(":")[0])
    if os.access(SERVICE, os.W_OK | os.X_OK):
        return SERVICE
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "terrafix"


def flush_to_disk(path: Path) -> None:
    """A file, or the names in a folder: on the disk when this returns. Raises OSError."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
