"""A map package of format 1 (first release): imagery of 120 by 100 pixels at 0.5 m, planar elevation."""

import gzip
from pathlib import Path

STORED = Path(__file__).with_name("map_format1.gpkg.gz")


def unpack(folder: Path) -> Path:
    path = folder / "format1.gpkg"
    path.write_bytes(gzip.decompress(STORED.read_bytes()))
    return path
