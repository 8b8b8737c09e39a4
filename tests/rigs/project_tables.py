"""The two tables of docs/architecture.md, made from the code. Run this file to write them into the page."""

import re
from pathlib import Path

import msgspec

from terrafix import messages
from terrafix.processes import EVERYTHING, PROCESSES, SUPERVISOR

PAGE = Path(__file__).resolve().parents[2] / "docs" / "architecture.md"
# Said by the shell and the supervisor, which are not processes of the table.
ALSO_SAID_BY = {"ProcessEvent": f"the {SUPERVISOR}", "Dropped": "the shell of every process"}


def processes() -> str:
    rows = ["| process | subscribes | publishes | ticks | counts as stuck after |", "|---|---|---|---|---|"]
    for process in PROCESSES:
        hears = "everything" if process.subscribes == EVERYTHING else _names(process.subscribes)
        newest = f" (a backlog of {_names(process.newest)} becomes the newest)" if process.newest else ""
        ticks = f"{process.tick_hz:g} Hz" if process.tick_hz else "-"
        says = _names(process.publishes)
        rows.append(f"| `{process.name}` | {hears}{newest} | {says} | {ticks} | {process.stuck_after_s:g} s |")
    return "\n".join(rows)


def said() -> str:
    rows = ["| message | said by | heard by | what it is |", "|---|---|---|---|"]
    for message in EVERYTHING:
        by = [p.name for p in PROCESSES if message in p.publishes]
        by += [ALSO_SAID_BY[message.__name__]] if message.__name__ in ALSO_SAID_BY else []
        hearers = [p.name for p in PROCESSES if message in p.subscribes and p.subscribes != EVERYTHING]
        rows.append(f"| {message.__name__} | {', '.join(by)} | {', '.join(hearers) or '-'} | {_purpose(message)} |")
    return "\n".join(rows)


def page(text: str) -> str:
    """The text of the page with both tables as the code has them now."""
    for name, table in (("processes", processes()), ("messages", said())):
        text, count = re.subn(
            rf"(<!-- table: {name} -->).*?(<!-- end -->)", lambda m, t=table: f"{m[1]}\n{t}\n{m[2]}", text, flags=re.S
        )
        assert count == 1, f"{PAGE}: the marks of the table '{name}' are gone"
    return text


def _names(of: tuple[type[messages.Message], ...]) -> str:
    return ", ".join(message.__name__ for message in of) or "-"


def _purpose(message: type[msgspec.Struct]) -> str:
    """First paragraph of the docstring, without the ids of requirements."""
    first = " ".join((message.__doc__ or "").strip().split("\n\n")[0].split())
    return re.sub(r" \([A-Z]{2}-\d+[^)]*\)", "", first).replace("``", "`")


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
