"""An examiner of flight records whose process dies; in a module of its own, so that workers can import it."""

import os
import signal
from dataclasses import dataclass
from pathlib import Path

from terrafix_tools.fleet.examine import Examined, Examiner
from terrafix_tools.fleet.find import Place, Record


@dataclass(frozen=True)
class DyingExaminer:
    """``deadly``: names of the run folders at which the process is killed: at each once, or at every attempt.
    ``deaths``: folder with a file for each death."""

    place: Place
    deadly: tuple[str, ...]
    deaths: Path
    once: bool

    def __call__(self) -> "DyingExaminer":
        return self

    def render(self, wanted: Record) -> Examined:
        name = Path(wanted.path).name
        if name in self.deadly and not (self.once and any(self.deaths.glob(f"{name}.*"))):
            (self.deaths / f"{name}.{os.getpid()}").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return Examiner(self.place).render(wanted)
