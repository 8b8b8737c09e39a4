"""The JSON Schemas accept every example of the repository and refuse the broken files by the name of the key."""

import tomllib
from pathlib import Path
from typing import Any

import pytest

from broken_files import BROKEN
from terrafix_tools.configuration.check import kind_of
from terrafix_tools.configuration.schema import schemas

jsonschema_rs = pytest.importorskip("jsonschema_rs", reason="needs the extra 'nightly'")

ROOT = Path(__file__).resolve().parents[2]
VALIDATORS = {kind: jsonschema_rs.validator_for(schema) for kind, schema in schemas().items()}
EXAMPLES = sorted(path for path in (ROOT / "config").rglob("*.toml") if path.parent.name != "training")


def words(kind: str, content: dict[str, Any]) -> str:
    """Every error with the place at which it is."""
    errors = VALIDATORS[kind].iter_errors(content)
    return "\n".join(f"{'.'.join(map(str, error.instance_path))}: {error.message}" for error in errors)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_an_example_of_the_repository_fits_its_schema(path: Path) -> None:
    assert words(kind_of(path), tomllib.loads(path.read_text())) == ""


@pytest.mark.parametrize(("kind", "text", "key"), BROKEN)
def test_a_broken_file_is_refused_at_its_key(kind: str, text: str, key: str) -> None:
    found = words(kind, tomllib.loads(text))
    assert key in found, found
