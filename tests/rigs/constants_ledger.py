"""The constants of what flies and where each comes from. Run this file to list those without a source.

A constant is a module-level name in capitals whose value is a number, or a tuple of numbers, or arithmetic on these.
The comment on its line, or the comment block directly above it, ends with one of

    [measured: where]   a measurement that a page of docs/ or a file describes
    [spec: what]        a standard, an interface, a unit, or the arithmetic of other constants
    [tuned]             chosen; nothing better is known
"""

import ast
import re
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("estimator", "anchor", "link")
SHARED = ("core/pnp.py",)  # what several of them use
TAG = re.compile(r"\[(?:(measured|spec): [^\]]+|(tuned))\]$")
CONSTANT = re.compile(r"_?[A-Z][A-Z0-9_]*$")


@dataclass(frozen=True)
class Constant:
    """``source``: "measured", "spec", "tuned", or None where no tag stands."""

    where: str  # path:line
    name: str
    source: str | None


def constants() -> list[Constant]:
    """All constants of ``FOLDERS`` and ``SHARED``, in the order of files and lines."""
    terrafix = ROOT / "daemon" / "terrafix"
    files = [path for folder in FOLDERS for path in sorted((terrafix / folder).rglob("*.py"))]
    files += [terrafix / name for name in SHARED]
    return [constant for path in files for constant in _of(path)]


def _of(path: Path) -> list[Constant]:
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    return [
        Constant(f"{path.relative_to(ROOT)}:{node.lineno}", name, _source(lines, node.lineno, node.end_lineno or 0))
        for node in ast.parse(text).body
        for name in _names(node)
    ]


def _names(node: ast.stmt) -> list[str]:
    if isinstance(node, ast.Assign):
        targets, value = node.targets, node.value
    elif isinstance(node, ast.AnnAssign) and node.value is not None:
        targets, value = [node.target], node.value
    else:
        return []
    names = [n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)]
    return [name for name in names if CONSTANT.match(name)][:1] if _is_numeric(value) else []


def _is_numeric(value: ast.expr) -> bool:
    """A literal number is somewhere in it, and no text."""
    literals = [n.value for n in ast.walk(value) if isinstance(n, ast.Constant)]
    numbers = [x for x in literals if isinstance(x, int | float) and not isinstance(x, bool)]
    return bool(numbers) and not any(isinstance(x, str | bytes) for x in literals)


def _source(lines: list[str], first: int, last: int) -> str | None:
    """The tag at the end of a line of the assignment (``first`` to ``last``, from 1), or of the comment above it."""
    above = first - 2
    candidates = lines[first - 1 : last]
    if above >= 0 and lines[above].startswith("#"):
        candidates = [*candidates, lines[above]]
    for line in candidates:
        if found := TAG.search(line):
            return found.group(1) or found.group(2)
    return None


if __name__ == "__main__":
    only = sys.argv[1] if len(sys.argv) > 1 else ""
    for constant in constants():
        if constant.source is None and only in constant.where:
            print(constant.where, constant.name)  # noqa: T201
