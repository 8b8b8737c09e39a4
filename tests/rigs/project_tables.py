"""Generates the table of docs/architecture.md from the code. Run this file to write it into the page."""

import re
from pathlib import Path

from terrafix import messages
from terrafix.processes import PROCESSES

PAGE = Path(__file__).resolve().parents[2] / "docs" / "architecture.md"


def process_table() -> str:
    rows = ["| process | subscribes to | publishes | tick rate | time-out without progress |", "|---|---|---|---|---|"]
    for process in PROCESSES:
        subscribes = "all messages" if process.subscribes == messages.ALL_MESSAGES else _names(process.subscribes)
        newest = f" (of queued {_names(process.newest)} only the newest)" if process.newest else ""
        ticks = f"{process.tick_hz:g} Hz" if process.tick_hz else "-"
        publishes = _names(process.publishes)
        rows.append(
            f"| `{process.name}` | {subscribes}{newest} | {publishes} | {ticks} | {process.stuck_after_s:g} s |"
        )
    return "\n".join(rows)


def page(text: str) -> str:
    """The text of the page with the table generated from the code."""
    text, count = re.subn(
        r"(<!-- table: processes -->).*?(<!-- end -->)",
        lambda m: f"{m[1]}\n{process_table()}\n{m[2]}",
        text,
        flags=re.S,
    )
    assert count == 1, f"{PAGE}: the marks of the table are missing"
    return text


def _names(of: tuple[type[messages.Message], ...]) -> str:
    return ", ".join(message.__name__ for message in of) or "-"


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
