"""Reads the small text files of sysfs. A sensor that is absent, powered down or garbled gives None."""

from pathlib import Path


def read_text(path: Path) -> str | None:
    """Content of a file without surrounding white space; None when it cannot be read."""
    try:
        return path.read_text(encoding="ascii", errors="replace").strip()
    except OSError:
        return None


def read_number(path: Path) -> int | None:
    """Content of a file as an integer; None when it cannot be read or is no integer."""
    text = read_text(path)
    try:
        return int(text) if text is not None else None
    except ValueError:
        return None
