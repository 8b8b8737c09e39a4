"""config/default.toml documents core/config.py: the same keys, values and bounds, each with an explanation."""

import tomllib
from pathlib import Path
from typing import get_type_hints

import msgspec
import pytest

from terrafix.core.config import Config, Section, load
from terrafix.core.errors import ConfigError

DEFAULT = Path(__file__).resolve().parents[3] / "config" / "default.toml"


def test_default_toml_has_every_key_with_the_default_of_the_code() -> None:
    assert tomllib.loads(DEFAULT.read_text()) == msgspec.to_builtins(Config())
    assert load([DEFAULT]) == Config()


def test_default_toml_explains_every_key_and_states_its_bounds() -> None:
    lines = DEFAULT.read_text().splitlines()
    section = ""
    for number, line in enumerate(lines):
        if line.startswith("["):
            section = line.strip("[]")
        elif "=" in line and not line.startswith("#"):
            key = line.split("=")[0].strip()
            comment = ""
            for before in reversed(lines[:number]):
                if not before.startswith("# "):
                    break
                comment = before[2:] + " " + comment
            assert comment, f"[{section}] {key} has no explanation"
            for bound in bounds_of(getattr(Config(), section), key):
                assert f"{bound:g}" in comment or str(bound) in comment, f"[{section}] {key}: {bound} is not named"


def bounds_of(section: Section, key: str) -> list[float]:
    hint = get_type_hints(type(section), include_extras=True)[key]
    metas = [m for m in getattr(hint, "__metadata__", ()) if isinstance(m, msgspec.Meta)]
    return [b for m in metas for b in (m.gt, m.ge, m.lt, m.le) if b is not None]


def written(folder: Path, text: str) -> Path:
    path = folder / "my.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[link]\nbuad = 57600", r"my\.toml: unknown key 'buad' in \[link\]; did you mean 'baud'\?"),
        ("[link]\nzzz = 1", r"my\.toml: unknown key 'zzz' in \[link\]; known: device, baud, "),
        ("[helth]\nhot_c = 70", r"my\.toml: unknown key 'helth' as a section; did you mean 'health'\?"),
        ("hot_c = 70", r"my\.toml: 'hot_c' stands outside any section; write it under a \[section\]"),
        ("[link]\nrate_hz = 50", r"my\.toml: Expected `float` <= 15.0 - at `link\.rate_hz`"),
        ("[link]\nrate_hz = 'fast'", r"my\.toml: Expected `float`, got `str` - at `link\.rate_hz`"),
        ("[log]\nlevel = 'LOUD'", r"my\.toml: Invalid enum value 'LOUD' - at `log\.level`"),
        ("[link\n", r"my\.toml: not valid TOML"),
    ],
)
def test_a_configuration_error_is_one_line_with_file_key_and_remedy(tmp_path: Path, text: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint) as caught:
        load([written(tmp_path, text)])
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 3


def test_later_configuration_files_override_earlier_ones_key_by_key(tmp_path: Path) -> None:
    config = load([DEFAULT, written(tmp_path, "[health]\nhot_c = 70\n")])
    assert (config.health.hot_c, config.health.critical_c) == (70.0, 95.0)
    with pytest.raises(ConfigError, match="no such configuration file"):
        load([tmp_path / "none.toml"])
