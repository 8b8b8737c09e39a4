"""Roads, water and buildings drawn as a layer, so that frames are matched with them like with imagery.

What a frame shows of them is edges: both sides of a road, the bank of a water, the outline of a building. The drawing
has the same edges. Its grey levels mean nothing, because the features of the matcher do not depend on the sign of a
contrast."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from pyproj import CRS, Transformer

from terrafix.map.vectors import wkb_parts
from terrafix_tools.mapping.area.polygons import Area, Placed
from terrafix_tools.mapping.imagery import Imagery
from terrafix_tools.mapping.layers import Feature, LayerInput, VectorInput
from terrafix_tools.mapping.mosaic.compositing import Mosaic, MosaicPlan
from terrafix_tools.mapping.mosaic.grid import Grid
from terrafix_tools.mapping.sources.utm import utm_epsg

GSD_M = 1.0  # metres per pixel: a lane of a road is three; finer pixels would be finer than the features' errors

GROUND, WATER, ROAD, BUILDING = 110, 30, 190, 250  # grey levels, at least 60 apart
ORDER = {"water": WATER, "roads": ROAD, "buildings": BUILDING}  # bridges over water, buildings over both
FINER = 4  # pixels are drawn as FINER x FINER smaller ones, because widths are whole numbers of pixels
SHIFT = 4  # sub-pixel bits of OpenCV's drawing coordinates
# Width of what has no attribute width, metres: carriageway and shoulders, track bed, water.
WIDTH_M = {
    "motorway": 24.0,
    "trunk": 14.0,
    "primary": 9.0,
    "secondary": 8.0,
    "tertiary": 7.0,
    "residential": 6.0,
    "service": 4.0,
    "track": 3.5,
    "river": 20.0,
    "canal": 12.0,
    "stream": 3.0,
}
OTHER_WIDTH_M, MAX_WIDTH_M = 5.0, 200.0
# Too narrow to be seen from the height of a flight, or beside a road that is drawn.
NOT_DRAWN = {"footway", "path", "cycleway", "steps", "bridleway", "corridor", "platform", "ditch", "drain"}
STROKE = np.dtype(
    [("first", "<i8"), ("points", "<i4"), ("width_m", "<f4"), ("grey", "u1"), ("low", "<f8", 2), ("high", "<f8", 2)]
)  # of one feature: its points in the file of points, 0 m for a filled surface, its box in the CRS
POINTS_FILE, STROKES_FILE = "points", "strokes"


@dataclass(frozen=True)
class DrawnLayer:
    given: LayerInput
    crs: CRS


def drawn_layer(vectors: VectorInput, area: Area, folder: Path) -> DrawnLayer:
    """The layer of ``vectors``, in the UTM zone of ``area``. It opens after ``spooled`` has filled ``folder``."""
    west, south, east, north = area.bounds_deg
    crs = CRS.from_epsg(utm_epsg((west + east) / 2, (south + north) / 2))
    x_min, y_min, x_max, y_max = Placed(area, crs).bounds
    left, top = math.floor(x_min / GSD_M) * GSD_M, math.ceil(y_max / GSD_M) * GSD_M
    grid = Grid(
        crs=f"EPSG:{crs.to_epsg()}",
        x_min=left,
        y_max=top,
        pixel_x=GSD_M,
        pixel_y=GSD_M,
        width_px=math.ceil((x_max - left) / GSD_M),
        height_px=math.ceil((top - y_min) / GSD_M),
    )
    given = LayerInput(
        open=partial(Mosaic, MosaicPlan(area, grid, (partial(Drawing, folder, grid),))),
        source=vectors.source,
        date=vectors.date,
        licence=vectors.licence,
        ce90_m=vectors.ce90_m,
    )
    return DrawnLayer(given, crs)


def spooled(given: VectorInput, folder: Path, crs: CRS) -> Iterator[Feature]:
    """The features of ``given``; what is drawn of them is written to ``folder`` meanwhile, for ``Drawing``."""
    to_crs = Transformer.from_crs(4326, crs, always_xy=True)
    first = 0
    with (folder / POINTS_FILE).open("wb") as points_file, (folder / STROKES_FILE).open("wb") as strokes_file:
        for table, wkb, attributes in given.features:
            yield table, wkb, attributes
            if table not in ORDER or attributes.get("kind") in NOT_DRAWN:
                continue
            parts = [part for part in wkb_parts(wkb) if len(part) > 1]
            is_surface = all((part[0] == part[-1]).all() for part in parts)
            # Rings of one surface as one path: back to the start of the first one after each.
            paths = [np.concatenate([np.vstack([part, parts[0][:1]]) for part in parts])] if is_surface else parts
            for path in paths if parts else []:
                xy = np.stack(to_crs.transform(*path.T), axis=1)
                if not np.isfinite(xy).all():
                    continue
                stroke = np.zeros(1, STROKE)
                width_m = 0.0 if is_surface and table != "roads" else _width_m(attributes)
                stroke[0] = (first, len(xy), width_m, ORDER[table], xy.min(axis=0), xy.max(axis=0))
                strokes_file.write(stroke.tobytes())
                points_file.write(xy.astype("<f8").tobytes())
                first += len(xy)


def _width_m(attributes: Mapping[str, str]) -> float:
    """Width of a line: its attribute, else by its kind."""
    try:
        return float(np.clip(float(attributes["width"].removesuffix("m")), 1.0, MAX_WIDTH_M))
    except (KeyError, ValueError):
        return WIDTH_M.get(attributes.get("kind", "").removesuffix("_link"), OTHER_WIDTH_M)


class Drawing(Imagery):
    """What ``spooled`` has written to ``folder``, on a grid."""

    def __init__(self, folder: Path, grid: Grid) -> None:
        self.crs = CRS.from_user_input(grid.crs)
        self.width_px, self.height_px = grid.width_px, grid.height_px
        self.pixel_x, self.pixel_y = grid.pixel_x, grid.pixel_y
        self.x_min, self.y_max = grid.x_min, grid.y_max
        self._strokes = _mapped(folder / STROKES_FILE, STROKE)
        self._points = _mapped(folder / POINTS_FILE, np.dtype("<f8")).reshape(-1, 2)

    def read(self, column: int, row: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
        """A window inside the grid: (height, width, 3) uint8 and mask (height, width) uint8, 255 everywhere."""
        corner = np.array([self.x_min + column * self.pixel_x, self.y_max - row * self.pixel_y])
        far = corner + np.array([width * self.pixel_x, -height * self.pixel_y])
        unit_m = self.gsd_m / np.sqrt(self.pixel_x * self.pixel_y)
        margin = MAX_WIDTH_M / unit_m
        fine = np.full((height * FINER, width * FINER), GROUND, np.uint8)
        low, high = self._strokes["low"] - margin, self._strokes["high"] + margin
        meets = (low[:, 0] < far[0]) & (high[:, 0] > corner[0]) & (low[:, 1] < corner[1]) & (high[:, 1] > far[1])
        step = np.array([self.pixel_x, -self.pixel_y]) / FINER
        near = self._strokes[meets]
        for stroke in near[np.argsort([list(ORDER.values()).index(grey) for grey in near["grey"]], kind="stable")]:
            xy = self._points[stroke["first"] : stroke["first"] + stroke["points"]]
            px = np.round(((xy - corner) / step - 0.5) * (1 << SHIFT)).astype(np.int32)
            grey = int(stroke["grey"])
            if stroke["width_m"] == 0.0:
                cv2.fillPoly(fine, [px], grey, cv2.LINE_8, SHIFT)
            else:
                thickness = max(1, round(float(stroke["width_m"]) / unit_m / abs(float(step[0]))))
                cv2.polylines(fine, [px], False, grey, thickness, cv2.LINE_8, SHIFT)
        image = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA)
        return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.full((height, width), 255, np.uint8)


def _mapped(path: Path, dtype: np.dtype[np.void] | np.dtype[np.float64]) -> np.ndarray:
    """The file as an array that is not read into memory."""
    return np.memmap(path, dtype, "r") if path.stat().st_size else np.zeros(0, dtype)
