"""The frame of an HTML page without other files, in the look of the flight report."""

from html import escape
from importlib.resources import files


def document(title: str, body: str, more_style: str = "") -> str:
    """``body``: HTML of the page. ``more_style``: CSS after that of the report."""
    style = (files("terrafix_tools") / "assets" / "report.css").read_text(encoding="utf-8")
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="color-scheme" content="light dark">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{escape(title)}</title><style>{style}{more_style}</style></head>"
        f"<body><main>{body}</main></body></html>\n"
    )


def table(columns: list[str], rows: list[list[object]]) -> str:
    """The first column is text, the others are numbers; None is a dash."""
    head = "".join(f"<th>{escape(name)}</th>" for name in columns)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(str('-' if cell is None else cell))}</td>" for cell in row) + "</tr>"
        for row in rows
    )
    return (
        f'<div class="scroll"><table class="numbers"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
    )
