"""What every page is made of: one HTML file that needs no other, its parts, and the file's way to the disk.

Parameters are text, which is escaped here; what is HTML already is named ``html`` or of the type ``Html``."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path

from terrafix.core.errors import OutputError

MAX_IN_ROW = 7  # number of figures in one row; more are set in two even rows


class Html(str):
    """The content of a cell that is HTML and not text."""


@dataclass(frozen=True)
class Figure:
    value: str
    unit: str
    name: str
    mood: str = ""  # "good", "fair", "bad"; empty: not rated


def document(title: str, html: str, after: str = "") -> str:
    """``after``: HTML behind the main part."""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="color-scheme" content="light dark">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{escape(title)}</title><style>{asset('page.css')}</style></head>"
        f"<body><main>{html}</main>{after}</body></html>\n"
    )


def asset(name: str) -> str:
    return (files("terrafix_tools") / "assets" / name).read_text(encoding="utf-8")


def write_file(path: Path, text: str, advice: str = "") -> None:
    """Writes the file whole or not at all. Raises OutputError, whose message ends with ``advice``."""
    partial = path.with_name(f"{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}){advice}") from None


def text(content: str) -> str:
    return content if isinstance(content, Html) else escape(content, quote=False)


def header(eyebrow: str, title: str, *lines: str) -> str:
    above = f'<div class="eyebrow">{text(eyebrow)}</div>' if eyebrow else ""
    return f"<header>{above}<h1>{text(title)}</h1>{''.join(f'<p>{text(line)}</p>' for line in lines)}</header>"


def figures(shown: Sequence[Figure]) -> str:
    """The key figures below the header."""
    tiles = "".join(
        f"<div><b{_class(one.mood)}>{text(one.value)}<small>{text(one.unit)}</small></b>"
        f"<span>{text(one.name)}</span></div>"
        for one in shown
    )
    return f'<section class="figures{" wide" if len(shown) > MAX_IN_ROW else ""}">{tiles}</section>'


def _class(css: str) -> str:
    return f' class="{css}"' if css else ""


def section(title: str, lead: str, *html: str) -> str:
    """A heading, sentences about what is shown (or ""), and what is shown."""
    about = f'<p class="lead">{text(lead)}</p>' if lead else ""
    return f"<h2>{text(title)}</h2>{about}{''.join(html)}"


def scroll(*html: str) -> str:
    """What a narrow screen moves sideways."""
    return f'<div class="scroll">{"".join(html)}</div>'


def two(*html: str) -> str:
    """Side by side, where there is room."""
    return f'<div class="two">{"".join(f"<div>{one}</div>" for one in html if one)}</div>'


def folded(summary: str, *html: str) -> str:
    return f"<details><summary>{text(summary)}</summary>{''.join(html)}</details>"


def table(columns: Sequence[str], rows: Iterable[Sequence[object]], css: str = "numbers") -> str:
    """None is a dash. ``css``: "numbers": the first column is text, the others are numbers."""
    head = "".join(f"<th>{text(name)}</th>" for name in columns)
    body = "".join(f"<tr>{''.join(_cell(cell) for cell in row)}</tr>" for row in rows)
    return scroll(f'<table class="{css}"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>')


def facts(rows: Iterable[Sequence[object]]) -> str:
    """A table of names and values, without a head."""
    return f"<table>{''.join(f'<tr>{_cell(name)}{_cell(value)}</tr>' for name, value in rows)}</table>"


def _cell(cell: object) -> str:
    return f"<td>{text(cell if isinstance(cell, str) else '-' if cell is None else str(cell))}</td>"


def timeline(rows: Iterable[tuple[str, str]]) -> str:
    """Times and what happened then."""
    items = "".join(f"<li><time>{text(when)}</time><span>{text(what)}</span></li>" for when, what in rows)
    return f'<ol class="moments">{items}</ol>'


def share_bar(share: float, css: str) -> str:
    return f'<u class="{css}" style="width:{100 * share:.1f}%"></u>'


def counts(rows: Sequence[tuple[str, int, str]], title: str = "") -> str:
    """Bars with names, counts and shares of the sum. ``rows``: name, count, css class of the bar."""
    total = sum(count for _, count, _ in rows)
    lines = "".join(
        f"<div><span>{text(name)}</span>{share_bar(count / total, css)}"
        f"<span>{count} · {100 * count / total:.0f} %</span></div>"
        for name, count, css in rows
    )
    return f'<div class="verdict">{f"<h3>{text(title)}</h3>" if title else ""}{lines}</div>'


def legend(keys: Iterable[tuple[str, str]]) -> str:
    """``keys``: css class of the key, what it means."""
    items = "".join(f'<span><i class="key {css}"></i>{text(meaning)}</span>' for css, meaning in keys)
    return f'<div class="legend">{items}</div>'
