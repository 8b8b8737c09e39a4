"""Map package reader: GeoPackage imagery and elevation, resampled to local frame coordinates at any scale."""

import math
import sqlite3
import weakref
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from terrafix.core.errors import MapError
from terrafix.core.geodesy import LocalFrame, local_crs, transformer
from terrafix.core.signature import TrustedKey
from terrafix.map.checksum import file_digest_matches
from terrafix.map.dem import ElevationView
from terrafix.map.descriptor_table import StoredDescriptors
from terrafix.map.format import TILE_PX, Layer, Manifest
from terrafix.map.imagery import LayerView
from terrafix.map.tile_cache import TileStore
from terrafix.map.vectors import Feature, features_sha256_of, read_features
from terrafix.map.verify import check_signature, connect, read_manifest

# SQLite's message about a damaged file may quote its bytes, which then are not valid UTF-8.
DATABASE_ERRORS = (sqlite3.DatabaseError, UnicodeDecodeError)


class MapPackage:
    """An open package, read only. Not thread-safe. Closed by ``close``, or with the last of its views.

    A tile whose sha256 differs from the recorded one counts as missing and is listed in ``tiles.damaged``: a bad block
    on a disk costs one tile in flight, not the map. ``verify`` reads everything and raises."""

    def __init__(self, path: Path, db: sqlite3.Connection, manifest: Manifest) -> None:
        self.path = path
        self.manifest = manifest
        self.signed_by: tuple[str, ...] = ()  # ids of the signing keys
        self._db = db
        self._close = weakref.finalize(self, db.close)
        self.tiles = TileStore(db)
        self.crs = CRS.from_user_input(manifest.crs)
        self._from_wgs84 = {layer.table: transformer(4326, layer.crs) for layer in manifest.layers}
        self._verified_vectors: set[str] = set()

    @classmethod
    def open(cls, path: Path, *, verify: bool = False, trusted: Sequence[TrustedKey] | None = None) -> "MapPackage":
        """Opens a package. Checks file size, format, manifest, tile list and signature; with `verify` every tile too.

        ``trusted``: at least one of these keys must have signed (``core.signature.trusted_keys``); None: an unsigned
        package is accepted. An existing signature must be valid in any case. Raises MapError."""
        db = connect(path)
        try:
            manifest = read_manifest(path, db)
            package = cls(path, db, manifest)
            package.signed_by = check_signature(path, db, manifest, trusted)
            if verify:
                package.verify()
        except DATABASE_ERRORS as error:
            db.close()
            raise MapError(f"{path}: damaged map package ({error}); build or copy it again") from None
        except (MapError, CRSError) as error:
            db.close()
            raise MapError(str(error)) from None
        return package

    def verify(self) -> None:
        """Compares every tile and feature with its recorded sha256, then every byte of the file with the file digest.

        Raises MapError, which names the first mismatch."""
        try:
            for table, zoom, column, row, expected in self.tiles.hashes():
                if not self.tiles.matches_hash((table, zoom, column, row), expected):
                    raise MapError(
                        f"{self.path}: tile of {table}, zoom {zoom} column {column} row {row} was altered or lost; "
                        "build or copy the package again"
                    )
            for vectors in self.manifest.vectors:
                self._check_vectors(vectors.table)
            sealed = not self.manifest.sealed or file_digest_matches(self.path)
        except (*DATABASE_ERRORS, OSError) as error:
            raise MapError(f"{self.path}: damaged map package ({error}); build or copy it again") from None
        if not sealed:
            raise MapError(
                f"{self.path}: the file was altered since it was built or signed, outside of tiles and manifest; "
                "build or copy the package again"
            )

    def layer(self, table: str | None = None) -> Layer:
        """An imagery layer by table name; None: the newest. Raises MapError."""
        for layer in self.manifest.layers:
            if table in (None, layer.table):
                return layer
        names = ", ".join(layer.table for layer in self.manifest.layers)
        raise MapError(f"{self.path}: has no layer '{table}'; it has {names}")

    def features(self, table: str, west: float, south: float, east: float, north: float) -> list[Feature]:
        """Features of a table (roads, water, buildings) whose box intersects a box in degrees; [] without that table.

        Raises MapError: the table does not match its hash."""
        for vectors in self.manifest.vectors:
            if vectors.table == table:
                try:
                    self._check_vectors(table)
                    return read_features(self._db, vectors, west, south, east, north)
                except DATABASE_ERRORS as error:
                    raise MapError(f"{self.path}: features of {table} are damaged ({error}); copy it again") from None
        return []

    def ground_amsl_m(self, lat_deg: float, lon_deg: float) -> float | None:
        """Ground height AMSL in metres; None where the package has no elevation."""
        here = np.zeros(1)
        up = self.bind(LocalFrame(lat_deg, lon_deg)).elevation(here, here)
        return float(up[0]) if up is not None and np.isfinite(up[0]) else None

    def covers_start(self, lat_deg: float, lon_deg: float, sigma_m: float) -> bool:
        """True when any point within three sigma of the initial position lies in valid imagery.

        ``sigma_m``: 1-sigma of the position. Tests a ring of 12 points at one, two and three sigma."""
        frame = LocalFrame(lat_deg, lon_deg)
        offsets_m = [(0.0, 0.0)] + [
            (k * sigma_m * math.sin(math.radians(course_deg)), k * sigma_m * math.cos(math.radians(course_deg)))
            for k in (1, 2, 3)
            for course_deg in range(0, 360, 30)
        ]
        return any(self.covers(*frame.to_wgs84(e_m, n_m)) for e_m, n_m in offsets_m)

    def covers(self, lat_deg: float, lon_deg: float, layer: str | None = None) -> bool:
        """True when the point lies in valid imagery of a layer; None: the newest layer."""
        found = self.layer(layer)
        x, y = self._from_wgs84[found.table].transform(lon_deg, lat_deg)
        if not (math.isfinite(x) and math.isfinite(y)):
            return False
        level = found.levels[-1]
        column_px = math.floor((x - found.x_min) / level.pixel_x)
        row_px = math.floor((found.y_max - y) / level.pixel_y)
        if not (0 <= column_px < level.columns * TILE_PX and 0 <= row_px < level.rows * TILE_PX):
            return False
        tile = self.tiles.tile((found.table, level.zoom, column_px // TILE_PX, row_px // TILE_PX))
        if tile is None:
            return False
        return tile[1] or bool(tile[0][row_px % TILE_PX, column_px % TILE_PX, 3])

    def bind(self, frame: LocalFrame, layer: str | None = None) -> "LocalMap":
        """A view of the map in local frame coordinates. ``layer``: default of its windows; None: the newest layer.

        Raises MapError: no such layer."""
        return LocalMap(self, frame, self.layer(layer))

    def close(self) -> None:
        self._close()
        self.tiles.clear()

    def _check_vectors(self, table: str) -> None:
        """Verifies the hash of a feature table, once per open package. Raises MapError."""
        expected = {vectors.table: vectors.sha256 for vectors in self.manifest.vectors}[table]
        if table not in self._verified_vectors and features_sha256_of(self._db, table) != expected:
            raise MapError(f"{self.path}: features of {table} were altered or lost; build or copy the package again")
        self._verified_vectors.add(table)


class LocalMap:
    """A package in local frame coordinates: e east, n north in metres; true north is up at the origin."""

    def __init__(self, package: MapPackage, frame: LocalFrame, layer: Layer) -> None:
        self._package = package
        self._local = local_crs(frame.lat_deg, frame.lon_deg)
        self._default = layer.table
        self._views = {layer.table: LayerView(layer, package.tiles, self._local)}
        self.layers = package.manifest.layers  # newest first
        self.gsd_m = layer.gsd_m
        self.bounds_m = self._views[layer.table].bounds_m
        dem = package.manifest.dem
        self._elevation = None if dem is None else ElevationView(dem, package.tiles, self._local, package.crs)

    def window(
        self, e_min_m: float, n_max_m: float, width_px: int, height_px: int, gsd_m: float, layer: str | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """North-up image: (height_px, width_px, 3) uint8 BGR and validity mask (height_px, width_px) bool.

        The centre of pixel (r, c) is at e = e_min_m + (c + 0.5) gsd_m, n = n_max_m - (r + 0.5) gsd_m. Where the map
        has no imagery, the image is zero and not valid. ``layer``: a table name of ``layers``; None: the bound layer.
        Raises MapError: no such layer."""
        found = self._package.layer(layer or self._default)
        if found.table not in self._views:
            self._views[found.table] = LayerView(found, self._package.tiles, self._local)
        return self._views[found.table].window(e_min_m, n_max_m, width_px, height_px, gsd_m)

    def descriptors(self, name: str) -> StoredDescriptors | None:
        """Precomputed descriptors of the bound layer from the describer ``name``; None: there are none."""
        layer = self._package.layer(self._default)
        if layer.descriptors is None or layer.descriptors.name != name:
            return None
        view = self._views[layer.table]
        return StoredDescriptors(layer, layer.descriptors, self._package.tiles, view.to_crs, view.unit_m)

    def elevation(self, e_m: np.ndarray, n_m: np.ndarray) -> np.ndarray | None:
        """Height AMSL in metres (float64, shape of e_m), bilinear; NaN where unknown; None: no elevation grid."""
        return None if self._elevation is None else self._elevation.at(e_m, n_m)
