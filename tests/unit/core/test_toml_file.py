"""TOML files of users: bounded in size, depth and numbers."""

import tomllib
from pathlib import Path

import pytest

from terrafix.core.config import load
from terrafix.core.errors import ConfigError, SourceError
from terrafix.core.toml_file import MAX_BYTES, read_toml
from terrafix.vision.sources.description import read_description


def written(folder: Path, text: str) -> Path:
    path = folder / "a.toml"
    path.write_text(text, encoding="utf-8")
    return path


HOSTILE = [
    ("a = " + "[" * 100_000, "nested too deeply"),
    ("a = " + "[" * 9 + "]" * 9, "nested too deeply"),
    ("a = " + "9" * 5000, "limit"),
    ("a = " + "9" * 400, "more than 64 bits"),
    ("a = 9223372036854775808", "more than 64 bits"),
    ("a = -9223372036854775809", "more than 64 bits"),
    ("[b]\nc = [1, {d = 99999999999999999999}]", "more than 64 bits"),
    ("#" * (MAX_BYTES + 1), "larger than 1 MB"),
    ("a = ", "Invalid value"),
]


@pytest.mark.parametrize(("text", "reason"), HOSTILE)
def test_a_hostile_file_is_not_valid_toml(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(tomllib.TOMLDecodeError, match=reason):
        read_toml(written(tmp_path, text))


@pytest.mark.parametrize(("text", "reason"), HOSTILE)
def test_a_hostile_configuration_or_description_is_one_line_of_error(tmp_path: Path, text: str, reason: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ConfigError, match=reason):
        load([path])
    with pytest.raises(SourceError, match=reason):
        read_description(path)


def test_a_file_at_the_bounds_is_read(tmp_path: Path) -> None:
    text = "a = " + "[" * 7 + "]" * 7 + "\nb = 9223372036854775807\nc = -9223372036854775808\n"
    table = read_toml(written(tmp_path, text + "#" * (MAX_BYTES - len(text))))
    assert (table["a"], table["b"], table["c"]) == ([[[[[[[]]]]]]], 2**63 - 1, -(2**63))


def test_a_byte_order_mark_and_other_encodings(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes(b"\xef\xbb\xbfa = 1")
    assert read_toml(path) == {"a": 1}
    path.write_bytes("a = 'ä'".encode("latin-1"))
    with pytest.raises(UnicodeDecodeError):
        read_toml(path)
