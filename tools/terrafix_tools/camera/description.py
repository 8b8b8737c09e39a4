"""Writes a flight description (flight.toml)."""

import json
from pathlib import Path

import msgspec

from terrafix.core.errors import OutputError
from terrafix.vision.sources.description import Description


def write_toml(path: Path, flight: Description, note: str) -> None:
    """``note``: first line, a comment. Default values are omitted. Raises OutputError."""
    values, tables = _split(flight)
    lines = [f"# {note}", *values]
    for name, table in tables.items():
        if rows := _split(table)[0]:
            lines += [f"[{name}]", *rows]
    try:
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another --out") from None


def _split(
    table: msgspec.Struct | dict[str, object],
) -> tuple[list[str], dict[str, msgspec.Struct | dict[str, object]]]:
    """Returns "key = value" lines, and the nested tables."""
    lines, tables = [], {}
    items = table if isinstance(table, dict) else _changed(table)
    for name, value in items.items():
        if isinstance(value, msgspec.Struct | dict):
            tables[name] = value
        else:
            # Strings, numbers and lists of JSON are valid TOML.
            lines.append(f"{name} = {json.dumps(value, ensure_ascii=False)}")
    return lines, tables


def _changed(table: msgspec.Struct) -> dict[str, object]:
    """Returns the fields that differ from their default; required fields are always included."""
    return {
        field.name: value
        for field in msgspec.structs.fields(table)
        if (value := getattr(table, field.name)) is not None and (field.required or value != field.default)
    }
