"""A disk of a few megabytes that can be filled: a tmpfs, which takes root to mount."""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

BLOCK = 4096  # of a tmpfs


class SmallDisk:
    """``folder``: where it is mounted."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._other = folder / "of another program"

    def fill(self, free_bytes: int = 0) -> None:
        """Another program takes all but ``free_bytes``, in whole blocks."""
        with self._other.open("ab", buffering=0) as file:
            try:
                while file.write(bytes(BLOCK)) == BLOCK:
                    pass
            except OSError:
                pass
            file.truncate(max(0, file.seek(0, 2) - free_bytes // BLOCK * BLOCK))

    def free(self) -> None:
        self._other.unlink()


@contextmanager
def small_disk(folder: Path, size_mb: int) -> Iterator[SmallDisk]:
    """Skips the test where nothing can be mounted."""
    folder.mkdir()
    mounting = ["mount", "-t", "tmpfs", "-o", f"size={size_mb}m", "tmpfs", str(folder)]
    try:
        mounted = subprocess.run(mounting, capture_output=True, text=True, timeout=10)
    except OSError as error:
        pytest.skip(f"a small disk takes mount ({error})")
    if mounted.returncode != 0:
        pytest.skip(f"a small disk takes root ({mounted.stderr.strip()})")
    try:
        yield SmallDisk(folder)
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True, timeout=10)
