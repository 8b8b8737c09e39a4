"""Pages for people: one HTML file each, without other files, made by the macros of templates.

A template is an HTML file in the folder ``assets`` of a package and holds macros, which Python calls as functions. What
they get is text, and escaped, unless it is ``Markup``, which they return."""

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup

from terrafix.core.errors import OutputError


@dataclass(frozen=True)
class Figure:
    value: str
    unit: str
    name: str
    mood: str = ""  # "good", "fair", "bad"; empty: not rated


def _text_of(name: str) -> str:
    """``name``: PACKAGE/FILE."""
    package, _, file = name.partition("/")
    return (files(package) / "assets" / file).read_text(encoding="utf-8")


_TEMPLATES = Environment(
    loader=FunctionLoader(_text_of), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
)
_TEMPLATES.globals["asset"] = lambda name: Markup(_text_of(name))


def macros(name: str) -> Any:
    """The macros of the template ``name`` (PACKAGE/FILE), as attributes."""
    return _TEMPLATES.get_template(name).module


kit = macros("terrafix_tools/kit.html")


def write_file(path: Path, text: str, advice: str = "") -> None:
    """Writes the file whole or not at all. Raises OutputError, whose message ends with ``advice``."""
    partial = path.with_name(f"{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}){advice}") from None
