"""Faults of the operating system that cannot be caused from outside without hitting everything on the computer.

The interpreter of Terrafix imports the folder ``shim`` first (PYTHONPATH), which replaces functions of the standard
library by some that look into a folder of switches. Terrafix itself is unchanged."""

import os
from enum import StrEnum
from pathlib import Path

FOLDER_VARIABLE = "TERRAFIX_CHAOS_SWITCHES"  # shim/sitecustomize.py has the same name
SHIM = Path(__file__).parent / "shim"


class Switch(StrEnum):
    """File names in the folder; the file has the value."""

    WALL_CLOCK_S = "wall_clock_s"  # added to the time of the computer's wall clock
    FSYNC_S = "fsync_s"  # that an fsync takes longer
    NO_PROVIDER = "no_provider"  # no model gives a result
    LEAK_PID = "leak_pid"  # the process that takes more and more memory


class Switches:
    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder

    def set(self, switch: Switch, value: float) -> None:
        """0: as without the fault."""
        file = self._folder / switch
        if value == 0.0:
            file.unlink(missing_ok=True)
            return
        temporary = file.with_suffix(".new")
        temporary.write_text(str(value))
        temporary.replace(file)

    def environment(self) -> dict[str, str]:
        """For the program that has the faults."""
        before = os.environ.get("PYTHONPATH")
        path = f"{SHIM}{os.pathsep}{before}" if before else str(SHIM)
        return {**os.environ, "PYTHONPATH": path, FOLDER_VARIABLE: str(self._folder)}
