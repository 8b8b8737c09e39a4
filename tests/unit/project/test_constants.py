"""Every constant of estimator, anchor and link says where it comes from, the number of chosen ones only falls, and a
name of a constant has one value in all that flies."""

import re
from collections import Counter, defaultdict

from constants_ledger import ROOT, constants

MAX_TUNED = 456  # lower it when a constant gets a measurement or a specification; never raise it
TERRAFIX = ROOT / "daemon" / "terrafix"
NAME = r"_?[A-Z][A-Z0-9_]+"
ASSIGNED = re.compile(rf"^({NAME}(?:, {NAME})*)(?:: [^=\n]+)? = ", re.MULTILINE)  # at the top of a module


def test_every_constant_has_a_source() -> None:
    without = [f"{c.where} {c.name}" for c in constants() if c.source is None]
    assert not without, "a comment with [measured: where], [spec: what] or [tuned] is missing: " + ", ".join(without)


def test_the_number_of_tuned_constants_only_falls() -> None:
    tuned = Counter(c.source for c in constants())["tuned"]
    assert tuned <= MAX_TUNED, "give the new constant a measurement or a specification"
    assert tuned == MAX_TUNED, f"set MAX_TUNED to {tuned}, so that it cannot rise again"


def test_the_name_of_a_constant_has_one_value() -> None:
    """A name that two files define is two facts, which say whose they are, or one fact, which one file imports."""
    files = defaultdict(set)
    for path in TERRAFIX.rglob("*.py"):
        for names in ASSIGNED.findall(path.read_text("utf-8")):
            for name in names.split(", "):
                files[name].add(str(path.relative_to(TERRAFIX)))
    several = {name: sorted(where) for name, where in files.items() if len(where) > 1}
    assert files and not several, f"name the owner in each, or import the one: {several}"
