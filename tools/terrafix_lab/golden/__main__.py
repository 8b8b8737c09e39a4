"""Regression test on message digests: python -m terrafix_lab.golden --help

Each case (cases.py) runs in its own process, with one thread for linear algebra. The references are valid for the kind
of processor that wrote them; --against REVISION computes them from another revision of this repository on this
computer instead.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from terrafix.core.errors import OutputError, UsageError
from terrafix_lab.golden.cases import CASES, GoldenCase
from terrafix_lab.golden.digest import Digest, References, differences
from terrafix_lab.standalone import run_standalone

REFERENCES = Path("tests/golden/references.json")
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
CASE_TIMEOUT_S = 1200.0  # time-out of one case
EXIT_DIFFERENT = 1  # exit code when a case differs
DATA = Path(os.environ.get("TERRAFIX_DATA", "../shared/data"))


def run_case(case: GoldenCase, data: Path, sources: Path | None = None) -> dict[str, Digest]:
    """Runs one case in its own process and returns its digests. ``sources``: root of another revision. Raises
    UsageError when it fails.
    """
    paths = [str(sources / part) for part in ("daemon", "engines", "tools")] if sources is not None else []
    env = {**os.environ, **ONE_THREAD, **({"PYTHONPATH": os.pathsep.join(paths)} if paths else {})}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "digests.json"
        command = [sys.executable, "-m", "terrafix_lab.golden.one", case.name, str(data.resolve()), str(out)]
        try:
            done = subprocess.run(
                command, env=env, capture_output=True, text=True, timeout=CASE_TIMEOUT_S, check=False, cwd=folder
            )
        except subprocess.TimeoutExpired:
            raise UsageError(f"{case.name}: not done after {CASE_TIMEOUT_S:.0f} s") from None
        if done.returncode != 0:
            raise UsageError(f"{case.name}: failed; {(done.stderr.strip().splitlines() or ['no output'])[-1]}")
        return msgspec.json.decode(out.read_bytes(), type=dict[str, Digest])


def references(path: Path) -> References:
    """Reads the reference file. Raises UsageError."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=References)
    except FileNotFoundError:
        raise UsageError(f"{path}: no such file; write it with --update-refs") from None
    except msgspec.DecodeError as error:
        raise UsageError(f"{path}: not a file of references ({error})") from None


def write(path: Path, digests: References) -> None:
    """Writes the reference file. Raises OutputError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(msgspec.json.format(msgspec.json.encode(digests), indent=1) + b"\n")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another --refs") from None


def wanted_cases(names: list[str], data: Path) -> list[GoldenCase]:
    """Selects the cases by ``names`` (empty: all). Prints which are skipped for missing data. Raises UsageError."""
    unknown = sorted(set(names) - {case.name for case in CASES})
    if unknown:
        raise UsageError(f"--case '{unknown[0]}': unknown; choose from: {', '.join(c.name for c in CASES)}")
    cases = []
    for case in CASES:
        missing = [need for need in case.needs if not (data / need).exists()]
        if names and case.name not in names:
            continue
        if missing:
            typer.echo(f"{case.name}: skipped, {data / missing[0]} does not exist (--data)", err=True)
            continue
        cases.append(case)
    return cases


def compare(cases: list[GoldenCase], data: Path, expected: References) -> int:
    """Returns the number of cases that differ."""
    different = 0
    for case in cases:
        if case.name not in expected:
            typer.echo(f"{case.name}: no reference; write it with --update-refs")
            different += 1
            continue
        lines = differences(expected[case.name], run_case(case, data))
        different += bool(lines)
        typer.echo(f"{case.name}: {'different' if lines else 'equal'}")
        for line in lines:
            typer.echo(f"  {line}")
    return different


def revision_digests(revision: str, cases: list[GoldenCase], data: Path) -> References:
    """Returns the digests of another revision, from its own worktree. Raises UsageError."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        added = subprocess.run(
            ["git", "worktree", "add", "--detach", str(tree), revision], capture_output=True, text=True, check=False
        )
        if added.returncode != 0:
            raise UsageError(f"--against {revision}: {added.stderr.strip().splitlines()[-1]}")
        try:
            return {case.name: run_case(case, data, tree) for case in cases}
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", str(tree)], capture_output=True, check=False)


def main(
    case: Annotated[list[str] | None, typer.Option(help="Only this case; may be given several times.")] = None,
    refs: Annotated[Path, typer.Option(help="File of references.")] = REFERENCES,
    data: Annotated[Path, typer.Option(help="Folder with flights/, maps/ and models/.")] = DATA,
    update_refs: Annotated[bool, typer.Option("--update-refs", help="Write the references instead.")] = False,
    against: Annotated[str, typer.Option(help="Compare with this revision instead of the references.")] = "",
) -> None:
    """Compare the messages of each case with the references. Exit code 0: all are equal; 1: at least one differs."""
    cases = wanted_cases(case or [], data)
    if update_refs:
        known = references(refs) if refs.exists() else {}
        for one in cases:
            known[one.name] = run_case(one, data)
            write(refs, known)
            typer.echo(f"{one.name}: {sum(digest.count for digest in known[one.name].values())} messages")
        return
    expected = revision_digests(against, cases, data) if against else references(refs)
    different = compare(cases, data, expected)
    typer.echo(f"{different} of {len(cases)} cases differ")
    raise typer.Exit(EXIT_DIFFERENT if different else 0)


if __name__ == "__main__":
    run_standalone("golden", main)
