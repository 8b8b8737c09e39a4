"""Generates the tables of docs/inputs.md: what is read from outside, in which unit and datum, what is assumed and what
is refused. Every row names the tests that hold it. Run this file to write the tables into the page."""

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "inputs.md"


@dataclass(frozen=True)
class Row:
    """``tests``: file below tests/unit and names of its test functions, which hold the row."""

    quantity: str
    comes_from: str
    unit: str
    datum: str
    assumed: str
    refused: str
    tests: tuple[str, tuple[str, ...]]


MAP_INPUTS: tuple[Row, ...] = ()

FLIGHT_INPUTS: tuple[Row, ...] = ()

TABLES = {"map": MAP_INPUTS, "flight": FLIGHT_INPUTS}


def table(rows: tuple[Row, ...]) -> str:
    lines = ["| quantity | comes from | unit | datum | assumed, and said | refused |", "|---|---|---|---|---|---|"]
    for row in rows:
        file, _ = row.tests
        held = f"[{row.quantity}](../tests/unit/{file})"
        lines.append(f"| {held} | {row.comes_from} | {row.unit} | {row.datum} | {row.assumed} | {row.refused} |")
    return "\n".join(lines)


def page(text: str) -> str:
    """The text of the page with all tables generated."""
    for name, rows in TABLES.items():
        made = table(rows)
        text, count = re.subn(
            rf"(<!-- table: {name} -->).*?(<!-- end -->)", lambda m, t=made: f"{m[1]}\n{t}\n{m[2]}", text, flags=re.S
        )
        assert count == 1, f"{PAGE}: the marks of the table '{name}' are missing"
    return text


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
