"""flight.toml from a Description."""

import json
from pathlib import Path

import msgspec

from terrafix.core.errors import OutputError
from terrafix.vision.sources.description import Description


def write_toml(path: Path, flight: Description, note: str) -> None:
    """``note``: first line, a comment. What is at its default is left out. Raises OutputError."""
    values, tables = _split(flight)
    lines = [f"# {note}", *values]
    for name, table in tables.items():
        lines += [f"[{name}]", *_split(table)[0]]
    try:
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another --out") from None


def _split(
    table: msgspec.Struct | dict[str, object],
) -> tuple[list[str], dict[str, msgspec.Struct | dict[str, object]]]:
    """-> "key = value" lines; the tables inside."""
    lines, tables = [], {}
    items = table if isinstance(table, dict) else _changed(table)
    for name, value in items.items():
        if isinstance(value, msgspec.Struct | dict):
            tables[name] = value
        else:
            # JSON's strings, numbers and lists are TOML's.
            lines.append(f"{name} = {json.dumps(value, ensure_ascii=False)}")
    return lines, tables


def _changed(table: msgspec.Struct) -> dict[str, object]:
    """Fields that are not at their default; a camera says all of its numbers."""
    return {
        field.name: value
        for field in msgspec.structs.fields(table)
        if (value := getattr(table, field.name)) is not None and (field.required or value != field.default)
    }
