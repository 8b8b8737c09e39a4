"""Are all messages the same as before? python -m terrafix_tools.golden --help

Each case (cases.py) runs in a process of its own, with one thread for linear algebra. References hold on the kind of
processor that wrote them; --against REVISION makes them anew from another revision of this repository, on this
computer, and compares with those."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from terrafix.core.errors import OutputError, UsageError
from terrafix_tools.golden.cases import CASES, Case
from terrafix_tools.golden.digest import Digest, References, differences
from terrafix_tools.standalone import run_standalone

REFERENCES = Path("tests/golden/references.json")
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
LONGEST_S = 1200.0  # of one case
DIFFERENT = 1  # exit code
DATA = Path(os.environ.get("TERRAFIX_DATA", "../shared/data"))


def found(case: Case, data: Path, sources: Path | None = None) -> dict[str, Digest]:
    """Of one case, in a process of its own. ``sources``: root of another revision. Raises UsageError: it failed."""
    paths = [str(sources / part) for part in ("daemon", "engines", "tools")] if sources is not None else []
    env = {**os.environ, **ONE_THREAD, **({"PYTHONPATH": os.pathsep.join(paths)} if paths else {})}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "digests.json"
        command = [sys.executable, "-m", "terrafix_tools.golden.one", case.name, str(data.resolve()), str(out)]
        try:
            done = subprocess.run(
                command, env=env, capture_output=True, text=True, timeout=LONGEST_S, check=False, cwd=folder
            )
        except subprocess.TimeoutExpired:
            raise UsageError(f"{case.name}: not done after {LONGEST_S:.0f} s") from None
        if done.returncode != 0:
            raise UsageError(f"{case.name}: failed; {(done.stderr.strip().splitlines() or ['no word'])[-1]}")
        return msgspec.json.decode(out.read_bytes(), type=dict[str, Digest])


def references(path: Path) -> References:
    """Raises UsageError."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=References)
    except FileNotFoundError:
        raise UsageError(f"{path}: no such file; write it with --update-refs") from None
    except msgspec.DecodeError as error:
        raise UsageError(f"{path}: not a file of references ({error})") from None


def write(path: Path, digests: References) -> None:
    """Raises OutputError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(msgspec.json.format(msgspec.json.encode(digests), indent=1) + b"\n")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another --refs") from None


def wanted_cases(names: list[str], data: Path) -> list[Case]:
    """``names``: none for all. Cases whose data are absent are said to be left out. Raises UsageError."""
    unknown = sorted(set(names) - {case.name for case in CASES})
    if unknown:
        raise UsageError(f"--case '{unknown[0]}': there is none; choose from: {', '.join(c.name for c in CASES)}")
    cases = []
    for case in CASES:
        missing = [need for need in case.needs if not (data / need).exists()]
        if names and case.name not in names:
            continue
        if missing:
            typer.echo(f"{case.name}: left out, {data / missing[0]} is not there (--data)", err=True)
            continue
        cases.append(case)
    return cases


def compare(cases: list[Case], data: Path, expected: References) -> int:
    """-> how many cases differ."""
    different = 0
    for case in cases:
        if case.name not in expected:
            typer.echo(f"{case.name}: no reference; write it with --update-refs")
            different += 1
            continue
        lines = differences(expected[case.name], found(case, data))
        different += bool(lines)
        typer.echo(f"{case.name}: {'different' if lines else 'the same'}")
        for line in lines:
            typer.echo(f"  {line}")
    return different


def of_revision(revision: str, cases: list[Case], data: Path) -> References:
    """Digests of another revision, from a worktree of its own. Raises UsageError."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        added = subprocess.run(
            ["git", "worktree", "add", "--detach", str(tree), revision], capture_output=True, text=True, check=False
        )
        if added.returncode != 0:
            raise UsageError(f"--against {revision}: {added.stderr.strip().splitlines()[-1]}")
        try:
            return {case.name: found(case, data, tree) for case in cases}
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", str(tree)], capture_output=True, check=False)


def main(
    case: Annotated[list[str] | None, typer.Option(help="Only this case; may be given several times.")] = None,
    refs: Annotated[Path, typer.Option(help="File of references.")] = REFERENCES,
    data: Annotated[Path, typer.Option(help="Folder with flights/, maps/ and models/.")] = DATA,
    update_refs: Annotated[bool, typer.Option("--update-refs", help="Write the references instead.")] = False,
    against: Annotated[str, typer.Option(help="Compare with this revision instead of the references.")] = "",
) -> None:
    """Compares the messages of every case with the references. Exit code 0: all are the same; 1: one is not."""
    cases = wanted_cases(case or [], data)
    if update_refs:
        known = references(refs) if refs.exists() else {}
        for one in cases:
            known[one.name] = found(one, data)
            write(refs, known)
            typer.echo(f"{one.name}: {sum(digest.count for digest in known[one.name].values())} messages")
        return
    expected = of_revision(against, cases, data) if against else references(refs)
    different = compare(cases, data, expected)
    typer.echo(f"{different} of {len(cases)} cases differ")
    raise typer.Exit(DIFFERENT if different else 0)


if __name__ == "__main__":
    run_standalone("golden", main)
