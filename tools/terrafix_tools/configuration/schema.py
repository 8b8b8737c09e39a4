"""JSON Schemas of the files that people write, made from the tables that read them; `config/schema/` has them.

An editor that knows TOML (Even Better TOML, taplo, PyCharm) completes keys and shows bounds where the first line of a
file is ``#:schema ADDRESS``. Run ``python -m terrafix_tools.configuration.schema`` after a change of the tables; a test
compares."""

import json
import re
from pathlib import Path
from typing import Any

import msgspec

from terrafix.core.config import Config
from terrafix.core.installed_files import installed_files
from terrafix.vision.sources.description import Description

CONFIG, CAMERA, FLIGHT = "configuration", "camera description", "flight description"
NAMES = {CONFIG: "config.schema.json", CAMERA: "camera.schema.json", FLIGHT: "flight.schema.json"}
FOLDER = Path("config") / "schema"
DIALECT = "https://json-schema.org/draft/2020-12/schema"
_KEY = re.compile(r"(\w+) = ")


def schemas() -> dict[str, dict[str, Any]]:
    """By kind of file."""
    config, flight = (_without_null(msgspec.json.schema(table)) for table in (Config, Description))
    for section, keys in _explanations().items():
        reference = config["$defs"]["Config"]["properties"][section]["$ref"]
        properties = config["$defs"][reference.rsplit("/", 1)[-1]]["properties"]
        for key, text in keys.items():
            properties[key]["description"] = text
    camera = json.loads(json.dumps(flight))
    camera["$defs"]["Description"]["required"] = ["camera"]
    return {
        kind: {"$schema": DIALECT, **found} for kind, found in ((CONFIG, config), (CAMERA, camera), (FLIGHT, flight))
    }


def _without_null(node: Any) -> Any:
    """The schema without "or null", which TOML cannot say, so that an error is about the table itself."""
    if isinstance(node, list):
        return [_without_null(item) for item in node]
    if not isinstance(node, dict):
        return node
    node = {key: _without_null(value) for key, value in node.items() if not (key == "default" and value is None)}
    choices = [choice for choice in node.get("anyOf", []) if choice != {"type": "null"}]
    if len(choices) == 1:
        node = {**{key: value for key, value in node.items() if key != "anyOf"}, **choices[0]}
    return node


def _explanations() -> dict[str, dict[str, str]]:
    """The comments of config/default.toml: by section and key."""
    found: dict[str, dict[str, str]] = {}
    section, comment = "", list[str]()
    for line in (installed_files() / "config" / "default.toml").read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            section = line.strip("[]")
        elif line.startswith("# "):
            comment.append(line[2:])
            continue
        elif key := _KEY.match(line):
            found.setdefault(section, {})[key.group(1)] = " ".join(comment)
        comment = []
    return found


def text_of(schema: dict[str, Any]) -> str:
    """Content of a schema file."""
    return json.dumps(schema, indent=1) + "\n"


def write_all(folder: Path) -> None:
    """Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    for kind, schema in schemas().items():
        (folder / NAMES[kind]).write_text(text_of(schema), encoding="utf-8")


if __name__ == "__main__":
    write_all(installed_files() / FOLDER)
