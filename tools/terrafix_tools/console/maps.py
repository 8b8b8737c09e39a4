"""Maps of the console: packages in its folders, and their imagery as tiles in web mercator."""

import math
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from pyproj import Transformer

from terrafix.core.errors import MapError
from terrafix.map.format import TILE_PX, Level
from terrafix.map.package import MapPackage
from terrafix_tools.console.payloads import MapInfo, Start
from terrafix_tools.console.problems import Refusal

SUFFIX = ".gpkg"
TILE = 256  # pixels of a side of a tile
MIN_ZOOM, MAX_ZOOM = 0, 22
WORLD_M = 2 * math.pi * 6_378_137.0  # side of the web mercator square [spec: EPSG:3857]
OPEN_MAPS = 4  # packages that stay open [spec: 100 MB of decoded tiles each]
MAX_SOURCE_PX = 2048  # of a side of what one tile is resampled from [spec: 16 MB]
EQUATOR_GSD_M = WORLD_M / TILE  # of zoom 0


class OpenMap:
    """A package with the projection of its newest imagery. Of one thread, as the package."""

    def __init__(self, package: MapPackage) -> None:
        self.package = package
        self.layer = package.layer()
        self._to_layer = Transformer.from_crs(3857, self.layer.crs, always_xy=True)

    def tile_png(self, z: int, x: int, y: int) -> bytes:
        """PNG of TILE x TILE pixels, with alpha 0 where the package has no imagery."""
        side_m = WORLD_M / 2**z
        step_m = side_m / TILE
        centres_m = (np.arange(TILE) + 0.5) * step_m
        east_m, north_m = np.meshgrid(x * side_m - WORLD_M / 2 + centres_m, WORLD_M / 2 - y * side_m - centres_m)
        xs, ys = self._to_layer.transform(east_m, north_m)
        with np.errstate(invalid="ignore"):  # places beyond the projection are infinite
            spacing = float(np.median(np.abs(np.diff(xs, axis=1))))
        level = next((one for one in self.layer.levels if one.pixel_x <= 1.1 * spacing), self.layer.levels[-1])
        columns = (xs - self.layer.x_min) / level.pixel_x - 0.5
        rows = (self.layer.y_max - ys) / level.pixel_y - 0.5
        image = np.zeros((TILE, TILE, 4), np.uint8)
        inside = (
            np.isfinite(columns)
            & np.isfinite(rows)
            & (columns > -1)
            & (rows > -1)
            & (columns < level.columns * TILE_PX)
            & (rows < level.rows * TILE_PX)
        )
        if inside.any():
            self._fill(image, level, columns, rows, inside)
        done, png = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        assert done
        return png.tobytes()

    def _fill(self, image: np.ndarray, level: Level, columns: np.ndarray, rows: np.ndarray, inside: np.ndarray) -> None:
        """Bilinear, from the pixels of ``level`` that are under the visible part."""
        u_0, v_0 = max(int(columns[inside].min()), 0), max(int(rows[inside].min()), 0)
        width, height = int(columns[inside].max()) + 2 - u_0, int(rows[inside].max()) + 2 - v_0
        if max(width, height) > MAX_SOURCE_PX:  # far coarser than the coarsest level: the map is a dot on the page
            return
        mosaic, _ = self.package.tiles.mosaic(self.layer.table, level, u_0, v_0, width, height)
        at = (columns - u_0).astype(np.float32), (rows - v_0).astype(np.float32)
        cv2.remap(mosaic, *at, cv2.INTER_LINEAR, dst=image, borderMode=cv2.BORDER_CONSTANT)


class MapStore:
    """The packages in ``folders``, by the names of their files without the suffix; of two with one name the first."""

    def __init__(self, folders: tuple[Path, ...]) -> None:
        self._folders = folders
        self._open: OrderedDict[tuple[Path, int], OpenMap] = OrderedDict()
        self._thread = ThreadPoolExecutor(1, "maps")  # a package belongs to the thread that opened it

    def path(self, name: str) -> Path:
        """Raises Refusal (404)."""
        for path in self._paths():
            if path.stem == name:
                return path
        raise Refusal(404, f"there is no map {name[:100]!r}; GET /maps lists them")

    def all(self) -> list[MapInfo]:
        """Those that can be opened."""
        found: dict[str, MapInfo] = {}
        for path in self._paths():
            if path.stem not in found:
                try:
                    found[path.stem] = self.info(path.stem)
                except Refusal:
                    continue
        return list(found.values())

    def info(self, name: str) -> MapInfo:
        manifest = self._thread.submit(lambda: self._opened(name).package.manifest).result()
        west, south, east, north = manifest.bounds_wgs84
        cos_lat = math.cos(math.radians((south + north) / 2))
        finest = math.ceil(math.log2(EQUATOR_GSD_M * cos_lat / manifest.gsd_m))
        return MapInfo(
            name=name,
            bounds=(west, south, east, north),
            min_zoom=MIN_ZOOM,
            max_zoom=min(finest, MAX_ZOOM),
            gsd_m=manifest.gsd_m,
            date=manifest.date,
            source=manifest.source,
            licence=manifest.licence,
            has_dem=manifest.has_dem,
            tiles_url=f"/maps/{name}/tiles/{{z}}/{{x}}/{{y}}.png",
        )

    def check_start(self, name: str, start: Start | None) -> None:
        """Raises Refusal: no such map, or it does not cover the start of a flight."""

        def covered() -> bool:
            package = self._opened(name).package
            return start is None or package.covers_start(start.lat, start.lon, start.sigma_m)

        if not self._thread.submit(covered).result():
            raise Refusal(422, f"map {name!r} has no imagery at the start; choose another map, or check the start")

    def tile(self, name: str, z: int, x: int, y: int) -> bytes:
        """Raises Refusal: no such map or tile."""
        if max(x, y) >= 2**z:
            raise Refusal(404, f"zoom {z} has columns and rows 0 to {2**z - 1}")
        return self._thread.submit(lambda: self._opened(name).tile_png(z, x, y)).result()

    def _paths(self) -> list[Path]:
        return [path for folder in self._folders if folder.is_dir() for path in sorted(folder.glob(f"*{SUFFIX}"))]

    def _opened(self, name: str) -> OpenMap:
        path = self.path(name)
        try:
            key = path, path.stat().st_mtime_ns  # a package that was replaced is opened anew
            if key not in self._open:
                self._open[key] = OpenMap(MapPackage.open(path))
        except (MapError, OSError) as error:
            raise Refusal(404, str(error)) from None
        self._open.move_to_end(key)
        while len(self._open) > OPEN_MAPS:
            self._open.popitem(last=False)[1].package.close()
        return self._open[key]
