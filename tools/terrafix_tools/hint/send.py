"""An operator's hint to the processes that fly on this computer, over their bus; and what became of it."""

import os
from pathlib import Path

from terrafix.core.clock import now_ns
from terrafix.core.errors import LinkError, UsageError
from terrafix.messages import HintVerdict, PositionHint
from terrafix.processes import PROCESSES
from terrafix.runtime.cli_client import Operator
from terrafix.runtime.run_dir import RunDir, living

HEARERS = [process.name for process in PROCESSES if PositionHint in process.subscribes]
HEARD_S = 20.0  # they look for an operator several times a second, an anchor that searches between two looks
ANSWER_S = 10.0  # comes with the next frame
RADIUS_M = (100.0, 100_000.0)


def hint(lat_deg: float, lon_deg: float, radius_m: float, run: str = "") -> str:
    """-> what became of it, for people. Raises UsageError, and LinkError: nobody flies here, or does not answer."""
    if not (abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0):
        raise UsageError(f"{lat_deg:g}, {lon_deg:g} is no place; give latitude and longitude in degrees")
    if not RADIUS_M[0] <= radius_m <= RADIUS_M[1]:
        raise UsageError(f"--radius {radius_m:g}: choose {RADIUS_M[0]:.0f} to {RADIUS_M[1]:.0f} metres")
    run_dir = _run_dir(run)
    if not os.access(run_dir.path, os.W_OK | os.X_OK):
        raise LinkError(f"{run_dir.path} belongs to another user; do this as the user that Terrafix runs as")
    said = PositionHint(t_ns=now_ns(), lat_deg=lat_deg, lon_deg=lon_deg, radius_m=radius_m, source="command line")
    with Operator(run_dir, answers=HintVerdict, answered_by="anchor") as operator:
        if not operator.is_heard(PositionHint, len(HEARERS), HEARD_S):
            raise LinkError(f"{run_dir.path}: {' and '.join(HEARERS)} do not listen; is Terrafix still starting?")
        operator.say(said)
        for answer in operator.answers(ANSWER_S):
            if isinstance(answer, HintVerdict) and answer.hint_t_ns == said.t_ns:
                return answer.text
    return f"taken; no frame came within {ANSWER_S:.0f} s, it waits for the next one"


def _run_dir(run: str) -> RunDir:
    if run:
        if not Path(run).is_dir():
            raise UsageError(f"{run}: no such folder; leave --run out when only one Terrafix flies here")
        return RunDir(Path(run))
    flying = living()
    if not flying:
        raise LinkError("no Terrafix flies on this computer; is the service started?")
    if len(flying) > 1:
        raise UsageError(f"several fly here; name one: --run {' or --run '.join(str(r.path) for r in flying)}")
    return flying[0]
