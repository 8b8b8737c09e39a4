"""Runs the fuzzers: ``python -m terrafix_lab.fuzz [--target NAME ...] [--executions N] [--seed S] [--out FOLDER]``.

N executions of each target, by mutated valid inputs. An exception that is no TerrafixError, a run of more than LIMIT_S
seconds of processor time, or one that takes more than LIMIT_MB of memory, is a finding: its input is written into
FOLDER, and the exit code is 1. A finding becomes a file of tests/corpus when it is mended, and the tests read it ever
after."""

import random
import signal
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from terrafix.core.errors import OutputError, UsageError
from terrafix_lab.fuzz.mutate import mutated
from terrafix_lab.fuzz.targets import TARGETS, Target, refused_or_read
from terrafix_lab.standalone import run_standalone

RESET, RESET_PEAK = Path("/proc/self/clear_refs"), "5"  # proc(5): sets VmHWM to the present size
LIMIT_S = 5.0  # processor time of one input
LIMIT_MB = 200  # memory of one input; all valid ones are below 1 MB
MOST_FINDINGS = 20  # of one target; the run of it ends


class TooMuch(Exception):
    """An input took more than LIMIT_S or LIMIT_MB."""


def main(
    target: Annotated[list[str] | None, typer.Option(help="Name of a target; may be given several times.")] = None,
    executions: Annotated[int, typer.Option(help="Of each target.")] = 10_000,
    seed: Annotated[int, typer.Option(help="Of the mutations.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for the inputs of findings.")] = Path("out/fuzz"),
) -> None:
    chosen = [t for t in TARGETS if not target or t.name in target]
    if not chosen:
        raise UsageError(f"no such target; known: {', '.join(t.name for t in TARGETS)}")
    signal.signal(signal.SIGVTALRM, _too_long)
    found = sum(fuzz(one, executions, seed, out) for one in chosen)
    raise typer.Exit(1 if found else 0)


def fuzz(target: Target, executions: int, seed: int, out: Path) -> int:
    """-> number of findings, each with another last line of its traceback. Raises OutputError."""
    rng, seeds, began_s = random.Random(f"{seed} {target.name}"), target.seeds(), time.process_time()
    known: set[str] = set()
    done = 0
    while done < executions and len(known) < MOST_FINDINGS:
        done += 1
        data = mutated(seeds, rng)
        signal.setitimer(signal.ITIMER_VIRTUAL, LIMIT_S)
        try:
            taken_mb = _memory_of(lambda data=data: refused_or_read(target, data))  # type: ignore[misc]
            if taken_mb > LIMIT_MB:
                raise TooMuch(f"{taken_mb:.0f} MB of memory")
        except Exception as error:  # noqa: BLE001  # any kind is a finding
            where = traceback.extract_tb(error.__traceback__)[-1]
            name = f"{type(error).__name__} {Path(where.filename).name} {where.lineno}"
            if name not in known:
                known.add(name)
                _write(out, target, len(known), data)
                typer.echo(f"{target.name}: {name}: {error}")
        finally:
            signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
    spent_s = time.process_time() - began_s
    typer.echo(f"{target.name}: {done} executions, {len(known)} findings, {spent_s:.0f} s of processor time")
    return len(known)


def _write(out: Path, target: Target, number: int, data: bytes) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / f"{target.name.replace(' ', '-')}-{number}").write_bytes(data)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); choose another --out") from None


def _memory_of(run: Callable[[], None]) -> float:
    """-> MB by which the resident memory of this program was larger while it ran."""
    RESET.write_text(RESET_PEAK)
    before_mb = _peak_mb()
    run()
    return _peak_mb() - before_mb


def _peak_mb() -> float:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1024


def _too_long(*_: object) -> None:
    raise TooMuch(f"more than {LIMIT_S:g} s of processor time")


if __name__ == "__main__":
    run_standalone("fuzz", main)
