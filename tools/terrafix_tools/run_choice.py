"""The running Terrafix that a command refers to."""

import os
from pathlib import Path

from terrafix.core.errors import LinkError, UsageError
from terrafix.runtime.run_dir import RunDir, live_runs


def chosen_run(run: str) -> RunDir:
    """``run``: folder; "": the only one that runs on this computer. Raises UsageError, and LinkError: none runs, or it
    is of another user."""
    chosen = _run_dir(run)
    if not os.access(chosen.path, os.W_OK | os.X_OK):
        raise LinkError(f"{chosen.path} belongs to another user; run this command as that user")
    return chosen


def _run_dir(run: str) -> RunDir:
    if run:
        if not Path(run).is_dir():
            raise UsageError(f"{run}: no such folder; omit --run when only one Terrafix runs here")
        return RunDir(Path(run))
    runs = live_runs()
    if not runs:
        raise LinkError("Terrafix does not run on this computer; is the service started?")
    if len(runs) > 1:
        raise UsageError(
            f"several runs on this computer; choose one: --run {' or --run '.join(str(r.path) for r in runs)}"
        )
    return runs[0]
