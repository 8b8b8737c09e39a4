"""`terrafix config check`: whether a configuration, a camera description or a flight.toml can be flown with."""

import tomllib
from collections.abc import Iterator
from pathlib import Path

import msgspec

from terrafix.core.config import Config, load
from terrafix.core.errors import ConfigError
from terrafix.core.toml_file import read_toml
from terrafix.vision.sources.description import Description, camera_of, read_description
from terrafix.vision.sources.facts import camera_facts, mount_fact
from terrafix_tools.configuration.schema import CAMERA, CONFIG, FLIGHT

# Keys of a configuration that name a file or a folder.
FILES = (("map", "path"), ("models", "folder"), ("places", "index"), ("source", "camera"), ("link", "signing_key"))


def kind_of(path: Path) -> str:
    """By the tables at the top. Raises ConfigError: not readable, not TOML."""
    try:
        table = read_toml(path)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; write one with 'terrafix init DIR'") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML ({error})") from None
    sections = {field.name for field in msgspec.structs.fields(Config)}
    others = {field.name for field in msgspec.structs.fields(Description)}
    described = [
        key for key, value in table.items() if key in others and (key not in sections or isinstance(value, str))
    ]
    if not described:
        return CONFIG
    return CAMERA if "start" not in table and "map" not in table and "camera" in table else FLIGHT


def check(path: Path) -> Iterator[str]:
    """-> lines about the file. Raises ConfigError, SourceError: the first mistake, with its key."""
    kind = kind_of(path)
    if kind != CONFIG:
        description = read_description(path)
        yield f"{path}: {kind}, no mistake found"
        if description.camera is not None:
            camera = camera_of(path, description)
            yield from (
                f"  {fact.topic:<6}  {fact.text}"
                for fact in [*camera_facts(camera, "this file"), mount_fact(camera, "this file")]
            )
        return
    config = load([path])
    for section, key in FILES:
        named = str(getattr(getattr(config, section), key))
        if named and not Path(named).exists():
            raise ConfigError(
                f"{path}: [{section}] {key}: {named} is not there, seen from {Path.cwd()}; correct the path, or change "
                "into the folder that it is relative to"
            )
    yield f"{path}: {kind}, no mistake found"
    defaults = Config()
    for part in msgspec.structs.fields(Config):
        given, usual = getattr(config, part.name), getattr(defaults, part.name)
        for field in msgspec.structs.fields(type(given)):
            value = getattr(given, field.name)
            if value != getattr(usual, field.name):
                yield f"  [{part.name}] {field.name} = {value}"
    if config.source.camera:
        yield from check(Path(config.source.camera))
