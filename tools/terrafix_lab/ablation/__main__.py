"""What each integrity mechanism is worth: ``python -m terrafix_lab.ablation OUT [NAME ...] -- COMMAND`` runs a campaign
(``montecarlo --lies 0.05 --flights 12``) once as it is and once without each of the named mechanisms (default: all), in
all its processes, and prints a table of the results: ``montecarlo.json`` of each, in OUT/NAME."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.table import Table

from terrafix_lab.ablation.mechanisms import MECHANISMS, VARIABLE
from terrafix_lab.montecarlo.run import RESULT

SHIM = Path(__file__).parent / "shim"
NOTHING = "-"  # as it is
COLUMNS = ("median_m", "max_m", "false_fixes", "late_false_fixes", "coverage", "coverage_refined", "nees", "notice_s")


def main(words: list[str]) -> int:
    """-> exit code. ``words``: of the command line."""
    if "--" not in words[1:] or words.index("--") == len(words) - 1:
        typer.echo(
            f"usage: python -m terrafix_lab.ablation OUT [NAME ...] -- montecarlo ...; names: {', '.join(MECHANISMS)}"
        )
        return 2
    cut = words.index("--")
    out, names, command = Path(words[0]), words[1:cut] or list(MECHANISMS), words[cut + 1 :]
    if unknown := [name for name in names if name not in MECHANISMS]:
        typer.echo(f"{', '.join(unknown)}: no such mechanism; there are {', '.join(MECHANISMS)}")
        return 2
    table = Table("without", *COLUMNS)
    for name in (NOTHING, *names):
        Console().print(f"without {name}")
        found = result_without(name, command, out / name.replace(NOTHING, "all"))
        table.add_row(name, *(_cell(found.get(column)) for column in COLUMNS))
    Console().print(table)
    return 0


def result_without(name: str, command: list[str], out: Path) -> dict[str, Any]:
    """Results over all flights of ``terrafix COMMAND --out OUT`` without the mechanism ``name``; NOTHING: with all.
    Raises CalledProcessError, where the command cannot be run."""
    environment = dict(os.environ)
    if name != NOTHING:
        path = [str(SHIM), *filter(None, [environment.get("PYTHONPATH")])]
        environment |= {VARIABLE: name, "PYTHONPATH": os.pathsep.join(path)}
    program = [sys.executable, "-m", "terrafix_tools.program", *command, "--out", str(out)]
    done = subprocess.run(program, env=environment, stdout=subprocess.DEVNULL, check=False)
    if done.returncode not in (0, 1):  # 1: a floor does not hold
        raise subprocess.CalledProcessError(done.returncode, program)
    found: dict[str, Any] = json.loads((out / RESULT).read_text(encoding="utf-8"))["all"]
    return found


def _cell(value: Any) -> str:
    if isinstance(value, dict):
        return f"{value['mean']:.2f}"
    return "-" if value is None else f"{value:g}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
