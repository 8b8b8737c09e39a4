"""The format of a map package: tables, manifest, checksum. What is written here is what is signed."""

import hashlib
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

import msgspec

from terrafix.map.null_model import NullModel

FORMAT_VERSION = 2  # 1: one imagery layer, elevation in a table of its own, placement outside the checksum
APPLICATION_ID = 0x47504B47  # "GPKG", OGC 12-128r18 requirement 2
IMAGERY_TABLE = "imagery"  # the first layer; further ones are imagery_2, imagery_3, ...
ELEVATION_TABLE = "elevation"
MANIFEST_TABLE = "terrafix_manifest"
HASH_TABLE = "terrafix_hash"
SIGNATURE_TABLE = "terrafix_signature"
SEAL_TABLE = "terrafix_seal"
TILE_PX = 256
DEM_TILE_PX = 256
CE90_SIGMAS = 2.1460  # radius that holds 90 % of a circular normal error, in its sigmas: sqrt(-2 ln 0.1)
DEM_NULL = 65535  # void in a 16-bit elevation tile
SIGNED_AS = b"terrafix map package\n"  # before the checksum in what is signed: the key may sign other things too

HashRow = tuple[str, int, int, int, bytes]  # table, zoom, column, row, sha256


class DemGrid(msgspec.Struct, frozen=True, kw_only=True):
    """Placement of the elevation grid in the map's CRS; x_min, y_max is the outer corner of the first pixel."""

    x_min: float
    y_max: float
    pixel: float  # CRS units
    width_px: int
    height_px: int
    source: str = ""
    licence: str = ""


@dataclass(frozen=True)
class Level:
    """One zoom level: tile matrix of 256 px tiles. Units of the CRS."""

    zoom: int
    pixel_x: float
    pixel_y: float
    columns: int
    rows: int


class DescriptorTable(msgspec.Struct, frozen=True, kw_only=True):
    """Descriptors for the search of a place that nobody knows: of the tiles of some levels of a layer, the same tiles.

    A tile is a PNG of 8 bits: ``channels`` pictures of cells below each other, 255 for 1, and one that is 255 where all
    of a cell is valid."""

    table: str
    name: str  # of the describer, with its version
    pool: int  # pixels of a cell's side
    channels: int
    zooms: tuple[int, ...]
    tiles: int


class Ce90Origin(StrEnum):
    """Where the position error of a layer comes from."""

    STATED = "stated"  # by the producer
    ESTIMATED = "estimated"  # when the package was built, from another layer of it
    DEFAULT = "default"  # neither: `[map] ce90_m` counts


class Layer(msgspec.Struct, frozen=True, kw_only=True):
    """One imagery layer: one date, one pixel grid. Layers of a package may differ in CRS."""

    table: str
    date: str  # of the imagery, YYYY-MM-DD; empty = unknown
    licence: str
    source: str  # file name
    source_sha256: str
    ce90_m: float | None  # radius that holds 90 % of the errors of position; None: not known
    gsd_m: float  # ground metres per pixel of the finest level at the centre of the layer
    crs: str  # "EPSG:32651", or WKT
    x_min: float  # corner of the tile matrices, CRS units
    y_max: float
    bounds: tuple[float, float, float, float]  # x_min, y_min, x_max, y_max of the imagery; the matrices reach beyond
    levels: tuple[Level, ...]  # coarse to fine
    tiles: int
    descriptors: DescriptorTable | None = None
    null_model: NullModel | None = None  # what wrong places score; None: not measured
    ce90_origin: Ce90Origin | None = None  # None: a package from before this was recorded; what it has is stated


@dataclass(frozen=True)
class Accuracy:
    """Error of position of a layer: radius that holds 90 % of it, and where that number comes from."""

    ce90_m: float
    origin: Ce90Origin

    @property
    def sigma_m(self) -> float:
        """1-sigma per horizontal axis, of a circular normal error."""
        return self.ce90_m / CE90_SIGMAS


def accuracy_of(layer: Layer, default_ce90_m: float) -> Accuracy:
    """``default_ce90_m``: `[map] ce90_m`, of a layer that says nothing."""
    if layer.ce90_m is None:
        return Accuracy(default_ce90_m, Ce90Origin.DEFAULT)
    return Accuracy(layer.ce90_m, layer.ce90_origin or Ce90Origin.STATED)


class VectorTable(msgspec.Struct, frozen=True, kw_only=True):
    """A table of features; sha256 is over all its rows."""

    table: str
    features: int
    sha256: str
    source: str
    date: str
    licence: str


class Manifest(msgspec.Struct, frozen=True, kw_only=True):
    """What the package says about itself; one row each in the table terrafix_manifest.

    What is said of imagery at the top is said of the newest layer, the one that is used when none is named."""

    format_version: int
    name: str
    gsd_m: float
    crs: str  # of the newest layer and of the elevation
    bounds_wgs84: tuple[float, float, float, float]  # west, south, east, north, degrees
    date: str
    licence: str
    source: str
    source_sha256: str
    built_with: str
    has_dem: bool
    dem: DemGrid | None
    tiles: int  # of imagery, descriptors and elevation together
    checksum: str  # sha256 over the other rows and every tile's sha256
    ce90_m: float | None = None
    layers: tuple[Layer, ...] = ()  # newest first
    vectors: tuple[VectorTable, ...] = ()
    sealed: bool = False  # whether the file has a seal (``checksum.py``)


def manifest_rows(manifest: Manifest) -> list[tuple[str, str]]:
    """(key, value) rows of the table: text as it is, everything else as JSON."""
    rows = []
    for name in manifest.__struct_fields__:
        value = getattr(manifest, name)
        rows.append((name, value if isinstance(value, str) else msgspec.json.encode(value).decode()))
    return rows


def checksum_of(rows: Iterable[tuple[str, str]], hashes: Iterable[HashRow]) -> str:
    """sha256 over the manifest rows but `checksum`, and over table, place and sha256 of every tile; both sorted."""
    digest = hashlib.sha256()
    for key, value in sorted(rows):
        if key != "checksum":
            digest.update(f"{key}={value}\n".encode())
    for table, zoom, column, row, tile_hash in sorted(hashes):
        digest.update(f"{table}/{zoom}/{column}/{row}:".encode() + tile_hash)
    return digest.hexdigest()


def tile_sha256(data: bytes, scale: float | None = None, offset: float | None = None) -> bytes:
    """What is recorded of a tile; of an elevation tile with the scale and the offset that make metres of it."""
    digest = hashlib.sha256(data)
    if scale is not None and offset is not None:
        digest.update(struct.pack("<dd", scale, offset))
    return digest.digest()


def features_sha256(rows: Iterable[tuple[int, bytes, str, str, str]]) -> str:
    """sha256 over the rows (fid, geom, kind, name, attributes) of a table of features, in the order of their fid."""
    digest = hashlib.sha256()
    for fid, geometry, *texts in rows:
        digest.update(struct.pack("<qI", fid, len(geometry)) + geometry)
        for text in texts:
            coded = (text or "").encode()
            digest.update(struct.pack("<I", len(coded)) + coded)
    return digest.hexdigest()


def signed_bytes(checksum: str) -> bytes:
    """What the signature of a package is over."""
    return SIGNED_AS + checksum.encode()
