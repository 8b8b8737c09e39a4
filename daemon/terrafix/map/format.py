"""The format of a map package: tables, manifest, checksum. The checksum covers all of it and is what is signed."""

import hashlib
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

import msgspec

from terrafix.map.null_model import NullModel

FORMAT_VERSION = 2  # of packages that are written and read
APPLICATION_ID = 0x47504B47  # "GPKG", OGC 12-128r18 requirement 2
IMAGERY_TABLE = "imagery"  # the first layer; further ones are imagery_2, imagery_3, ...
DRAWN_TABLE = "drawn"  # the layer that is drawn from roads, water and buildings
ELEVATION_TABLE = "elevation"
MANIFEST_TABLE = "terrafix_manifest"
HASH_TABLE = "terrafix_hash"
SIGNATURE_TABLE = "terrafix_signature"
SEAL_TABLE = "terrafix_seal"
TILE_PX = 256
DEM_TILE_PX = 256
CE90_SIGMAS = 2.1460  # CE90 of a circular normal error in units of its sigma: sqrt(-2 ln 0.1)
DEM_NULL = 65535  # void in a 16-bit elevation tile
# domain separation: prefix of the signed bytes, as the key may sign other data
SIGNATURE_PREFIX = b"terrafix map package\n"

HashRow = tuple[str, int, int, int, bytes]  # table, zoom, column, row, sha256


class DemGrid(msgspec.Struct, frozen=True, kw_only=True):
    """Georeference of the elevation grid in the map's CRS; (x_min, y_max) is the outer corner of the first pixel."""

    x_min: float
    y_max: float
    pixel: float  # CRS units
    width_px: int
    height_px: int
    source: str = ""
    licence: str = ""


@dataclass(frozen=True)
class Level:
    """One zoom level: a tile matrix of 256 px tiles. Pixel sizes in CRS units."""

    zoom: int
    pixel_x: float
    pixel_y: float
    columns: int
    rows: int


class DescriptorTable(msgspec.Struct, frozen=True, kw_only=True):
    """Precomputed descriptors for relocalization: one descriptor tile per imagery tile, for some levels of a layer.

    A tile is an 8-bit PNG: ``channels`` planes of cells stacked vertically, 255 encodes 1.0, and a last plane that is
    255 where all pixels of a cell are valid."""

    table: str
    name: str  # name and version of the describer
    pool: int  # side of a cell, pixels
    channels: int
    zooms: tuple[int, ...]
    tiles: int


class Ce90Origin(StrEnum):
    """Origin of a layer's horizontal accuracy."""

    STATED = "stated"  # by the producer of the imagery
    ESTIMATED = "estimated"  # at build time, against another layer of the package
    DATUM = "datum"  # not stated, and the way from the datum of the imagery to WGS 84 is no better than this
    DEFAULT = "default"  # nothing is known: `[map] ce90_m` is used


class Layer(msgspec.Struct, frozen=True, kw_only=True):
    """One imagery layer: one date, one pixel grid. Layers of a package may differ in CRS.

    The layer ``DRAWN_TABLE`` shows roads, water and buildings instead of imagery."""

    table: str
    date: str  # of the imagery, YYYY-MM-DD; empty = unknown
    licence: str
    source: str  # file name
    source_sha256: str
    ce90_m: float | None  # circular error: radius that contains 90 % of the position errors; None: unknown
    gsd_m: float  # ground metres per pixel of the finest level at the centre of the layer
    crs: str  # "EPSG:32651", or WKT
    x_min: float  # upper left corner of the tile matrices, CRS units
    y_max: float
    bounds: tuple[float, float, float, float]  # x_min, y_min, x_max, y_max of the imagery; tile matrices may exceed it
    levels: tuple[Level, ...]  # coarse to fine
    tiles: int
    descriptors: DescriptorTable | None = None
    null_model: NullModel | None = None  # score distribution of wrong places; None: not measured
    ce90_origin: Ce90Origin | None = None  # None: the package predates this field; then ce90_m is STATED

    @property
    def is_drawn(self) -> bool:
        """Whether it is drawn from roads, water and buildings."""
        return self.table == DRAWN_TABLE


@dataclass(frozen=True)
class Accuracy:
    """Horizontal accuracy of a layer: CE90 in metres, and its origin."""

    ce90_m: float
    origin: Ce90Origin

    @property
    def sigma_m(self) -> float:
        """1-sigma per horizontal axis of a circular normal error with this CE90."""
        return self.ce90_m / CE90_SIGMAS


def accuracy_of(layer: Layer, default_ce90_m: float) -> Accuracy:
    """Accuracy of a layer. ``default_ce90_m``: `[map] ce90_m`, for a layer without one."""
    if layer.ce90_m is None:
        return Accuracy(default_ce90_m, Ce90Origin.DEFAULT)
    return Accuracy(layer.ce90_m, layer.ce90_origin or Ce90Origin.STATED)


class VectorTable(msgspec.Struct, frozen=True, kw_only=True):
    """A table of vector features; ``sha256`` covers all its rows."""

    table: str
    features: int
    sha256: str
    source: str
    date: str
    licence: str


class InputStatement(msgspec.Struct, frozen=True, kw_only=True):
    """What an input of the build was taken for."""

    name: str  # file name or title
    kind: str  # imagery, elevation
    unit: str  # of the heights of elevation; of the coordinates of imagery
    datum: str  # of the heights; of the coordinates
    accuracy_m: float | None  # of the way from its datum to WGS 84, as PROJ states it; None: not stated
    assumed: tuple[str, ...] = ()  # what it does not state itself, or what was done with it

    def text(self) -> str:
        """One line."""
        accuracy = "" if self.accuracy_m is None else f", {self.accuracy_m:g} m to WGS 84"
        return "; ".join((f"{self.kind} {self.name}: {self.datum}, {self.unit}{accuracy}", *self.assumed))


class Manifest(msgspec.Struct, frozen=True, kw_only=True):
    """Metadata of the package; stored as one row per field in the table terrafix_manifest.

    The imagery fields at this level describe the newest layer, which is the default layer."""

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
    layers: tuple[Layer, ...] = ()  # imagery, newest first; then the drawn layer
    vectors: tuple[VectorTable, ...] = ()
    inputs: tuple[InputStatement, ...] = ()  # empty: the package predates this field
    sealed: bool = False  # whether the file contains a file digest (``checksum.py``)


def manifest_rows(manifest: Manifest) -> list[tuple[str, str]]:
    """(key, value) rows of the manifest table: strings unchanged, everything else as JSON."""
    rows = []
    for name in manifest.__struct_fields__:
        value = getattr(manifest, name)
        rows.append((name, value if isinstance(value, str) else msgspec.json.encode(value).decode()))
    return rows


def checksum_of(rows: Iterable[tuple[str, str]], hashes: Iterable[HashRow]) -> str:
    """sha256 over all manifest rows except `checksum`, and over table, tile index and sha256 of every tile; sorted."""
    digest = hashlib.sha256()
    for key, value in sorted(rows):
        if key != "checksum":
            digest.update(f"{key}={value}\n".encode())
    for table, zoom, column, row, tile_hash in sorted(hashes):
        digest.update(f"{table}/{zoom}/{column}/{row}:".encode() + tile_hash)
    return digest.hexdigest()


def tile_sha256(data: bytes, scale: float | None = None, offset: float | None = None) -> bytes:
    """Hash that is recorded for a tile; for an elevation tile it includes the scale and offset to metres."""
    digest = hashlib.sha256(data)
    if scale is not None and offset is not None:
        digest.update(struct.pack("<dd", scale, offset))
    return digest.digest()


def features_sha256(rows: Iterable[tuple[int, bytes, str, str, str]]) -> str:
    """sha256 over the rows (fid, geom, kind, name, attributes) of a feature table, ordered by fid."""
    digest = hashlib.sha256()
    for fid, geometry, *texts in rows:
        shape = geometry or b""  # a damaged row may have none; then the hash is another one
        digest.update(struct.pack("<qI", fid, len(shape)) + shape)
        for text in texts:
            encoded = (text or "").encode()
            digest.update(struct.pack("<I", len(encoded)) + encoded)
    return digest.hexdigest()


def signed_bytes(checksum: str) -> bytes:
    """The bytes that the signature of a package covers."""
    return SIGNATURE_PREFIX + checksum.encode()
