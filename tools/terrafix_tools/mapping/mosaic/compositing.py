"""Mosaic of several sources on one grid inside an area; each pixel comes from the first source that has it."""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from pyproj import CRS
from rasterio.transform import Affine

from terrafix.map.format import InputStatement
from terrafix_tools.mapping.area.polygons import Area, Placed
from terrafix_tools.mapping.imagery import Imagery
from terrafix_tools.mapping.mosaic.grid import Grid
from terrafix_tools.mapping.mosaic.warp import Warped

Opener = Callable[[], Imagery]


@dataclass(frozen=True)
class MosaicPlan:
    """Picklable description of a mosaic for worker processes. ``parts``: openers of the sources, the best first."""

    area: Area
    grid: Grid
    parts: tuple[Opener, ...]


class Mosaic(Imagery):
    """Its grid is that of the plan."""

    def __init__(self, plan: MosaicPlan) -> None:
        grid = plan.grid
        self.crs = CRS.from_user_input(grid.crs)
        self.width_px, self.height_px = grid.width_px, grid.height_px
        self.pixel_x, self.pixel_y = grid.pixel_x, grid.pixel_y
        self.x_min, self.y_max = grid.x_min, grid.y_max
        self._placed = Placed(plan.area, self.crs)
        self._open = contextlib.ExitStack()
        with self._open:  # closes the open sources when a later one fails to open
            self._sources = [self._open.enter_context(part()) for part in plan.parts]
            self._parts = [Warped(part, grid, self.crs) for part in self._sources]
            self._open = self._open.pop_all()

    def close(self) -> None:
        self._open.close()

    @property
    def statements(self) -> tuple[InputStatement, ...]:
        return tuple(statement for part in self._sources for statement in part.statements)

    def read(self, column: int, row: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
        """A window inside the mosaic: (height, width, 3) uint8 BGR and mask (height, width) uint8 of 0 and 255."""
        x_min, y_max = self.x_min + column * self.pixel_x, self.y_max - row * self.pixel_y
        transform = Affine(self.pixel_x, 0, x_min, 0, -self.pixel_y, y_max)
        open_: np.ndarray = np.where(self._placed.burn(transform, width, height), 255, 0).astype(np.uint8)
        image = np.zeros((height, width, 3), np.uint8)
        mask: np.ndarray = np.zeros((height, width), np.uint8)
        for part in self._parts:
            if not open_.any():
                break
            found = part.read(column, row, width, height)
            if found is None:
                continue
            pixels, valid = found
            taken = cv2.bitwise_and(open_, valid)
            cv2.copyTo(pixels, taken, image)
            mask = cv2.bitwise_or(mask, taken)
            open_ = cv2.subtract(open_, taken)
        return image, mask
