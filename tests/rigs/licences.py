"""The licences of what an installation brings, by extra, from the metadata of the installed packages.

Run this file to write the table of docs/licences.md; a test compares them, and refuses what may not be shipped."""

import re
import tomllib
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "licences.md"
NOT_SHIPPED = ("dev", "docs", "nightly")  # extras of the checks and of the documentation
ALLOWED = {
    "0BSD", "Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "BSL-1.0", "CC0-1.0", "ISC", "MIT", "MIT-0", "MIT-CMU",
    "PSF-2.0", "Python-2.0", "Unlicense", "Zlib",
    "LGPL-2.1-or-later", "LGPL-3.0-only", "MPL-2.0",  # used as libraries of their own, unchanged
}  # fmt: skip
# Packages whose metadata has no SPDX expression: the text or the classifier that they have instead.
NAMED = {
    "Simplified BSD license": "BSD-2-Clause",
    "Apache 2.0": "Apache-2.0",
    "Apache Software License": "Apache-2.0",
    "ISC License": "ISC",
    "ISC License (ISCL)": "ISC",
    "MIT": "MIT",
    "MIT License": "MIT",
    "LGPLv3": "LGPL-3.0-only",
    "BSD": "BSD-3-Clause",
    "BSD License": "BSD-3-Clause",
    "BSD-2-Clause": "BSD-2-Clause",
    "BSD-3-Clause": "BSD-3-Clause",
    "3-Clause BSD License": "BSD-3-Clause",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Python Software Foundation License": "PSF-2.0",
    "The Unlicense (Unlicense)": "Unlicense",
    "any-OSI": "Zlib",  # of apsw: any licence of the Open Source Initiative, this one was its first
}
# Extras that the check does not install, because they need a compiler or a GPU, or are for one
# export: read on their pages.
ELSEWHERE = {
    "rosbags": "Apache-2.0",
    "pygobject": "LGPL-2.1-or-later",
    "systemd-python": "LGPL-2.1-or-later",
    "torch": "BSD-3-Clause",
    "onnx": "Apache-2.0",
    "onnxscript": "MIT",
}
TABLE = "|---|---|---|\n"  # the rows of the page follow it


def project() -> dict[str, list[Requirement]]:
    """Declared requirements by extra; "" is what every installation has."""
    table = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = {"": table["dependencies"], **table["optional-dependencies"]}
    libraries = {extra: [line for line in lines if not line.startswith("terrafix-")] for extra, lines in extras.items()}
    return {extra: [Requirement(line) for line in libraries[extra]] for extra in extras if extra not in NOT_SHIPPED}


def closure(requirements: list[Requirement]) -> set[str]:
    """Names of these packages and of all that they need on this interpreter."""
    found: set[str] = set()
    waiting = [(one, extra) for one in requirements for extra in ("", *one.extras)]
    while waiting:
        requirement, extra = waiting.pop()
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": extra}):
            continue
        name = canonicalize_name(requirement.name)
        if name in found:
            continue
        found.add(name)
        try:
            needed = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue  # licence_of decides
        for line in needed:
            other = Requirement(line)
            waiting += [(other, wanted) for wanted in ("", *requirement.extras)]
    return found


def licence_of(name: str) -> str:
    """SPDX expression; "" when it is not known."""
    if name in ELSEWHERE:
        return ELSEWHERE[name]
    try:
        found = metadata.metadata(name)
    except metadata.PackageNotFoundError:
        return ""
    if found.get("License-Expression"):
        return str(found["License-Expression"])
    text = (found.get("License") or "").strip().partition("\n")[0].strip()
    classifiers = [c.rpartition(" :: ")[2] for c in found.get_all("Classifier", []) if c.startswith("License :: OSI")]
    named = [NAMED[one] for one in (text, *classifiers) if one in NAMED]
    return named[0] if named else ""


def is_allowed(expression: str) -> bool:
    """One alternative of it has only ALLOWED licences."""
    alternatives = re.split(r"\bOR\b", expression.replace("(", " ").replace(")", " "))
    return any(all(part.strip() in ALLOWED for part in re.split(r"\bAND\b", one)) for one in alternatives)


def packages() -> dict[str, tuple[str, str]]:
    """What brings it, and its licence, by package."""
    extras: dict[str, list[str]] = {}
    for extra, requirements in project().items():
        for name in closure(requirements):
            extras.setdefault(name, []).append(extra)
    return {
        name: ("every installation" if "" in where else ", ".join(sorted(where)), licence_of(name) or "unknown")
        for name, where in sorted(extras.items())
    }


def rows() -> list[str]:
    """The table of the page: packages by what brings them and by licence."""
    found: dict[tuple[str, str], list[str]] = {}
    for name, kind in packages().items():
        found.setdefault(kind, []).append(name)
    order = sorted(found, key=lambda kind: (kind[0] != "every installation", kind))
    return [f"| {where} | {licence} | {', '.join(found[where, licence])} |" for where, licence in order]


def written() -> dict[str, tuple[str, str]]:
    """The packages that the page states, as ``packages``."""
    found = {}
    for row in PAGE.read_text(encoding="utf-8").partition(TABLE)[2].splitlines():
        where, licence, names = (cell.strip() for cell in row.strip("|").split("|"))
        found.update(dict.fromkeys(names.split(", "), (where, licence)))
    return found


if __name__ == "__main__":
    above, rule, _ = PAGE.read_text(encoding="utf-8").partition(TABLE)
    PAGE.write_text(above + rule + "\n".join(rows()) + "\n", encoding="utf-8")
