"""Cases of `field/` in the shared data: files of people, or a script that makes them."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path


def made(data_set: Callable[[str], Path], name: str, folder: Path, *args: str) -> str:
    """Runs ``make.py`` of the case ``name`` in ``folder``; skips without the shared data. Returns what it prints."""
    script = data_set(f"field/{name}") / "make.py"
    done = subprocess.run(
        [sys.executable, script, *args], cwd=folder, check=True, capture_output=True, text=True, timeout=120
    )
    return done.stdout
