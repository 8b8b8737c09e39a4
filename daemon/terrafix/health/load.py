"""Load of the processor cores, as a whole and by process of this run, from proc(5)."""

import os
from pathlib import Path

from terrafix.health.sensor_files import read_text

ALL = "all"  # key of all cores together
IDLE = (3, 4)  # of the times of a core: idle, waiting for a disk
GUEST = 8  # from here on times that the ones before contain already
USER, SYSTEM = 11, 12  # of the fields of a process after its name


class CpuLoad:
    """The processes of a run have one parent, the fork server, which is that of this process, too."""

    def __init__(self, proc: Path = Path("/proc"), parent: int | None = None) -> None:
        self._proc = proc
        self._parent = os.getppid() if parent is None else parent
        self._cores = 0
        self._busy_ticks: dict[str, int] = {}  # at the reading before, by process; ALL: of all cores
        self._total_ticks = 0

    def read(self) -> dict[str, float]:
        """Share since the reading before: of all cores (ALL), and of one core by process name. Empty at the first
        reading, and where proc cannot be read."""
        before, before_ticks = self._busy_ticks, self._total_ticks
        self._busy_ticks = self._processes()
        self._total_ticks, self._busy_ticks[ALL] = self._whole()
        passed_ticks = self._total_ticks - before_ticks
        if not before_ticks or passed_ticks <= 0:
            return {}
        core_ticks = passed_ticks / max(1, self._cores)
        return {
            name: round(max(0, ticks - before[name]) / (passed_ticks if name == ALL else core_ticks), 3)
            for name, ticks in self._busy_ticks.items()
            if name in before
        }

    def _whole(self) -> tuple[int, int]:
        """-> ticks of all cores since the start of the computer, and those of them that were busy."""
        lines = (read_text(self._proc / "stat") or "").splitlines()
        self._cores = sum(line.startswith("cpu") and not line.startswith("cpu ") for line in lines)
        times = [_ticks(cell) for cell in lines[0].split()[1:]][:GUEST] if lines else []
        return sum(times), sum(ticks for i, ticks in enumerate(times) if i not in IDLE)

    def _processes(self) -> dict[str, int]:
        """Ticks by name of the children of the parent."""
        children = read_text(self._proc / str(self._parent) / "task" / str(self._parent) / "children") or ""
        found = {}
        for child in children.split():
            text = read_text(self._proc / child / "stat") or ""
            name, _, fields = text.partition("(")[2].rpartition(")")
            cells = fields.split()
            if len(cells) > SYSTEM:
                found[name] = _ticks(cells[USER]) + _ticks(cells[SYSTEM])
        return found


def _ticks(cell: str) -> int:
    return int(cell) if cell.isdecimal() else 0
