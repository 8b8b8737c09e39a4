"""Specification of an imagery source: on the command line, or in a TOML file with the keys of SourceSpec."""

import os
import tomllib
from pathlib import Path

import msgspec

from terrafix.core.errors import ConfigError, UsageError
from terrafix.core.toml_file import read_toml
from terrafix_tools.mapping.fetching.pace import USER_AGENT, Limits
from terrafix_tools.mapping.sources.tiles.grid import MAX_ZOOM
from terrafix_tools.mapping.sources.tiles.url_template import UrlTemplate

SENTINEL = "sentinel-2"
TILE_FILES = (".mbtiles", ".pmtiles")


class SourceSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One [[source]] of a TOML file; the order in the file is the priority. Exactly one of path, url, wmts, service."""

    path: str = ""  # GeoTIFF, COG, VRT, GeoPackage or any other GDAL raster; .mbtiles, .pmtiles
    url: str = ""  # template of tiles: {z} {x} {y} or {-y}; ${NAME} is an environment variable
    wmts: str = ""  # address of a GetCapabilities document; `layer_name` selects one of its layers
    layer_name: str = ""
    service: str = ""  # "sentinel-2"
    name: str = ""  # for messages and the manifest
    licence: str = ""  # required for network sources
    date: str = ""  # of the imagery, YYYY-MM-DD; for sentinel-2 the last day of the search
    days: int = 90  # sentinel-2: maximum age of scenes before `date`
    ce90_m: float | None = None  # radius that contains 90 % of the position errors
    layer: str = ""  # sources of one layer fill each other's gaps; other layers are other dates of the same area
    zoom: int | None = None  # tiles: this zoom instead of that of the requested resolution
    tile_px: int = 256
    requests_per_s: float = 5.0
    connections: int = 2
    user_agent: str = USER_AGENT
    headers: dict[str, str] = {}

    @property
    def from_network(self) -> bool:
        return not self.path

    @property
    def of_tiles(self) -> bool:
        return bool(self.url or self.wmts) or self.path.lower().endswith(TILE_FILES)

    @property
    def title(self) -> str:
        return self.name or Path(self.path).name or self.layer_name or self.service or self.url.split("?")[0]

    @property
    def limits(self) -> Limits:
        return Limits(self.requests_per_s, self.connections, self.user_agent)


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    source: list[SourceSpec]


def parse_sources(
    texts: list[str], *, licence: str = "", date: str = "", ce90_m: float | None = None, rate: float | None = None
) -> list[SourceSpec]:
    """--source values in order: a path, a template, or the name of a service. ``rate``: requests per second.

    Raises UsageError."""
    specs = []
    for text in texts:
        kind = "service" if text == SENTINEL else "url" if "://" in text else "path"
        common: dict[str, object] = {"licence": licence, "date": date, "ce90_m": ce90_m}
        if rate is not None:
            common["requests_per_s"] = rate
        spec = msgspec.convert({kind: text, **common}, SourceSpec)
        check_spec(spec, f"--source {text}")
        specs.append(spec)
    return specs


def read_sources(path: Path) -> list[SourceSpec]:
    """Reads a source file. Raises ConfigError. Paths in the file are relative to it."""
    try:
        parsed = msgspec.convert(read_toml(path), _File)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; check --sources") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as TOML ({error})") from None
    except msgspec.ValidationError as error:
        raise ConfigError(f"{path}: {error}; the keys are those in docs/map-sources.md") from None
    if not parsed.source:
        raise ConfigError(f"{path}: has no [[source]]; add one")
    specs = []
    for number, spec in enumerate(parsed.source, start=1):
        try:
            check_spec(spec, f"{path} source {number}")
        except UsageError as error:
            raise ConfigError(str(error)) from None
        placed = str((path.parent / os.path.expanduser(spec.path)).resolve()) if spec.path else ""
        specs.append(msgspec.structs.replace(spec, path=placed))
    return specs


def check_spec(spec: SourceSpec, where: str) -> None:
    """Raises UsageError: a missing or invalid value."""
    given = [key for key in ("path", "url", "wmts", "service") if getattr(spec, key)]
    if len(given) != 1:
        raise UsageError(f"{where}: give exactly one of path, url, wmts and service (given: {', '.join(given) or '-'})")
    if spec.service not in ("", SENTINEL):
        raise UsageError(f"{where}: service '{spec.service}' is not known; there is {SENTINEL}")
    if spec.from_network and not spec.service and not spec.licence.strip():
        raise UsageError(
            f"{where}: needs the licence for storage and offline use of its imagery: --licence, or licence = ..."
        )
    if spec.wmts and not spec.layer_name:
        raise UsageError(f"{where}: a WMTS source needs layer_name")
    if spec.url:
        UrlTemplate(spec.url).check()
    bounds = {
        "tile_px": (64, 4096),
        "requests_per_s": (0.01, 1000.0),
        "connections": (1, 32),
        "days": (1, 3650),
        "zoom": (0, MAX_ZOOM),
    }
    for key, (low, high) in bounds.items():
        value = getattr(spec, key)
        if value is not None and not low <= value <= high:
            raise UsageError(f"{where}: {key} = {value} is out of {low} .. {high}")
