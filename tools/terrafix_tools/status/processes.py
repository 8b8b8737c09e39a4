"""What the run folder tells about the processes of a run."""

from dataclasses import dataclass

from terrafix.core.clock import NS_PER_S
from terrafix.processes import PROCESSES
from terrafix.runtime.progress_stamp import Progress
from terrafix.runtime.run_dir import RunDir


@dataclass(frozen=True)
class ProcessState:
    """``state``: "running", "starting", "stuck", "given up", "stopped".
    ``idle_s``: since its last progress; None: none yet."""

    name: str
    state: str
    idle_s: float | None


def process_states(run: RunDir, now_ns: int) -> list[ProcessState]:
    return [_state(run, p.name, p.stuck_after_s, now_ns) for p in PROCESSES if run.progress(p.name).exists()]


def _state(run: RunDir, name: str, stuck_after_s: float, now_ns: int) -> ProcessState:
    try:
        progress = Progress(run.progress(name))
    except OSError:  # the run ends
        return ProcessState(name, "stopped", None)
    stamp_ns = progress.stamp_ns
    progress.close()
    idle_s = max(0, now_ns - stamp_ns) / NS_PER_S if stamp_ns else None  # it may have worked since "now"
    if run.gave_up(name).exists():
        return ProcessState(name, "given up", idle_s)
    if idle_s is None:
        return ProcessState(name, "starting", None)
    return ProcessState(name, "stuck" if idle_s > stuck_after_s else "running", idle_s)
