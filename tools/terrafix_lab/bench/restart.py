"""Hot restart: how long GPS_INPUT and the 3D fix are away after a kill in flight, over many kills.

python -m terrafix_lab.bench.restart OUT [--times N] [--kill NAME ...] [--seed N] [--json FILE]

A copter flies the two legs of the fault matrix forth and back, as in bench.soak. Each process, the supervisor, and all
of them together are killed (SIGKILL) in turn, N times; a link that is stopped (SIGSTOP) is one more. The next kill
comes when there was a fix for STEADY_S. Exit code 1: of a row, the median is above MEDIAN_S or the worst above WORST_S,
or a position was wrong (chaos/verdict.py)."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from terrafix.core.errors import UsageError
from terrafix_lab.bench.result_file import write_result
from terrafix_lab.chaos.rig import Rig
from terrafix_lab.chaos.scene import ChaosScene
from terrafix_lab.chaos.shuttle import RUN, shuttle_in
from terrafix_lab.chaos.verdict import back_s, sigmas, without_fix_s, wrong_fixes
from terrafix_lab.faults.fault import Action, nothing
from terrafix_lab.faults.processes import NAMES
from terrafix_lab.faults.table import FAULTS
from terrafix_lab.standalone import run_standalone
from terrafix_tools.score import longest_gap_s

STEADY_S = 1.0  # with a fix before each kill
RECOVERY_LIMIT_S = 30.0  # until the fix is back, as in the matrix
MEDIAN_S, WORST_S = 2.0, 4.0  # [spec: hot restart, median and worst of 50]
STEP_S = 0.02
MISSED = 1  # exit code


def begin_of(fault: str) -> Action:
    process = FAULTS[fault].process
    assert process is not None
    return process.begin


KILLS: dict[str, Action] = {
    **{name: begin_of(f"{name}: kill -9") for name in NAMES},
    "link stopped": begin_of("link: SIGSTOP"),
    "nothing": nothing,  # gaps of the flight itself
    "all": begin_of("all processes: kill -9"),
}


class Kill(msgspec.Struct, frozen=True):
    """What one kill did, in seconds of wall time. ``fix_s``: from the kill to the lasting fix after a gap of fixes,
    0: there was no gap, None: there was no fix to the limit."""

    name: str
    silence_s: float
    without_fix_s: float
    fix_s: float | None


def measure(scene: ChaosScene, out: Path, names: Sequence[str], times: int, seed: int) -> dict[str, object]:
    """Flies in ``out``, a new folder. Raises SourceError, OSError."""
    kills: list[Kill] = []
    with Rig(scene, out, 0.0, seed=seed) as rig:
        rig.take_off()
        for _ in range(times):
            for name in names:
                if _wait(rig, time.monotonic() - STEADY_S):
                    kills.append(_kill(rig, name))
        fixes = rig.peer.fixes()
    rows = {name: summary([kill for kill in kills if kill.name == name]) for name in names}
    return {
        "rows": rows,
        "fixes": len(fixes),
        "wrong": len(wrong_fixes(fixes)),
        "worst_sigmas": max((sigmas(fix) for fix in fixes if fix.horizontal_m), default=None),
        "kills": msgspec.to_builtins(kills),
    }


def _kill(rig: Rig, name: str) -> Kill:
    killed_s = time.monotonic()
    KILLS[name](rig)
    _wait(rig, killed_s)
    now_s = time.monotonic()
    fixes_s = [fix.received_s for fix in rig.peer.fixes()]
    return Kill(
        name,
        longest_gap_s(rig.peer.received_s, killed_s, now_s),
        without_fix_s(fixes_s, killed_s, now_s),
        back_s(fixes_s, killed_s, now_s),
    )


def _wait(rig: Rig, from_s: float) -> bool:
    """Until there were fixes for STEADY_S after ``from_s``; False: not within RECOVERY_LIMIT_S."""
    while (now_s := time.monotonic()) < from_s + RECOVERY_LIMIT_S:
        rig.check()
        back = back_s([fix.received_s for fix in rig.peer.fixes()[-1000:]], from_s, now_s)
        if back is not None and now_s - (from_s + back) > STEADY_S:
            return True
        time.sleep(STEP_S)
    return False


def summary(kills: Sequence[Kill]) -> dict[str, float | None]:
    """Median and worst; ``fix`` None: once there was no fix to the limit."""
    silence = [kill.silence_s for kill in kills]
    fix = [kill.fix_s if kill.fix_s is not None else float("inf") for kill in kills]
    return {
        "kills": len(kills),
        "silence_median_s": float(np.median(silence)) if kills else None,
        "silence_worst_s": max(silence, default=None),
        "fix_median_s": float(np.median(fix)) if kills else None,
        "fix_worst_s": max(fix) if kills and max(fix) < RECOVERY_LIMIT_S else None,
    }


def missed(rows: dict[str, dict[str, float | None]]) -> list[str]:
    """The rows that do not meet the limits."""
    return [
        name
        for name, row in rows.items()
        if any((row[f"{what}_median_s"] or 0.0) > MEDIAN_S for what in ("silence", "fix"))
        or any((row[f"{what}_worst_s"] if row["kills"] else 0.0) is None for what in ("silence", "fix"))
        or any((row[f"{what}_worst_s"] or 0.0) > WORST_S for what in ("silence", "fix"))
    ]


def show(rows: dict[str, dict[str, float | None]], console: Console) -> None:
    table = Table()
    for title in ("killed", "times", "silence", "worst", "fix back after", "worst"):
        table.add_column(title, justify="right")
    for name, row in rows.items():
        figures = ("silence_median_s", "silence_worst_s", "fix_median_s", "fix_worst_s")
        table.add_row(name, str(row["kills"]), *("-" if row[key] is None else f"{row[key]:.2f} s" for key in figures))
    console.print(table)


def main(
    out: Annotated[Path, typer.Argument(help="New folder; the flight in it is generated.")],
    times: Annotated[int, typer.Option(help="Kills of each.")] = 50,
    kill: Annotated[list[str] | None, typer.Option(help="What is killed; may be given several times.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of the place and of the noise.")] = 1,
    json_file: Annotated[Path | None, typer.Option("--json", help="JSON to write.")] = None,
) -> None:
    names = kill or list(KILLS)
    unknown = set(names) - set(KILLS)
    if unknown:
        raise UsageError(f"--kill {unknown.pop()}: unknown; choose from {', '.join(KILLS)}")
    result = measure(shuttle_in(out, seed), out / RUN, names, times, seed)
    rows: dict[str, dict[str, float | None]] = result["rows"]  # type: ignore[assignment]
    console = Console(width=120)
    show(rows, console)
    console.print(f"{result['fixes']} positions, {result['wrong']} wrong, worst {result['worst_sigmas']} sigma")
    write_result(json_file, result)
    raise typer.Exit(MISSED if missed(rows) or result["wrong"] else 0)


if __name__ == "__main__":
    run_standalone("bench.restart", main)
