"""URL templates of tiles: XYZ, TMS and WMTS."""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from urllib.parse import quote, urlsplit

from terrafix.core.errors import UsageError
from terrafix_tools.mapping.sources.tiles.grid import Tile

FIELD = re.compile(r"\{([^{}]*)\}")
SECRET = re.compile(r"\$\{(\w+)\}")
WMTS_NAMES = {"tilematrix": "z", "tilecol": "x", "tilerow": "y"}  # RESTful WMTS, OGC 07-057r7 clause 10
HINT = "write {z}, {x} and {y} (or {-y}, rows from the south) into it"


@dataclass(frozen=True)
class UrlTemplate:
    """``text`` with {z} {x} {y}, or {-y} where rows count from the south, or {TileMatrix} {TileCol} {TileRow};
    {a,b,c} alternates between these values; ${NAME} is an environment variable, so that keys need not be in files.

    ``matrix_of_zoom``: names of the matrices of a WMTS, if they are not the zoom."""

    text: str
    matrix_of_zoom: Mapping[int, str] = field(default_factory=dict)

    def check(self) -> None:
        """Raises UsageError."""
        parts = urlsplit(self.text)
        if parts.scheme not in ("http", "https") or not parts.netloc:
            raise UsageError(f"source {self.text}: not an address; it starts with http:// or https://")
        names = [_plain(name) for name in FIELD.findall(SECRET.sub("", self.text))]
        unknown = [name for name in names if name not in ("z", "x", "y", "-y") and "," not in name]
        if unknown:
            raise UsageError(f"source {self.text}: {{{unknown[0]}}} is not known; {HINT}")
        if not ("z" in names and "x" in names and ("y" in names) != ("-y" in names)):
            raise UsageError(f"source {self.text}: not the address of a tile; {HINT}")
        for name in SECRET.findall(self.text):
            if not os.environ.get(name):
                raise UsageError(f"source {self.text}: the environment has no {name}; export {name}=... first")

    def url(self, tile: Tile) -> str:
        def fill(match: re.Match[str]) -> str:
            name = _plain(match[1])
            match name:
                case "z":
                    return quote(self.matrix_of_zoom.get(tile.zoom, str(tile.zoom)))
                case "x":
                    return str(tile.column)
                case "y":
                    return str(tile.row)
                case "-y":
                    return str((1 << tile.zoom) - 1 - tile.row)
            choices = name.split(",")
            return choices[(tile.column + tile.row) % len(choices)]

        # Placeholders first: values of environment variables are inserted unchanged.
        protected = SECRET.sub(lambda m: f"\0{m[1]}\0", self.text)
        return re.sub("\0(\\w+)\0", lambda m: os.environ.get(m[1], ""), FIELD.sub(fill, protected))


def _plain(name: str) -> str:
    return WMTS_NAMES.get(name.lower(), name)
