"""Where on the map it fails: cells of a grid with their share of refused frames, as a picture."""

import math
from dataclasses import dataclass
from html import escape
from typing import Any

from markupsafe import Markup

from terrafix_tools.fleet.query import FleetTables

MAX_CELLS = 30  # along the longer side
CELLS_M = (25, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 20_000, 50_000)
LEAST_FRAMES = 5  # of a cell whose share is shown; that of fewer says little
METRES_PER_DEG = 111_320.0  # of latitude; sizes of cells need no more than 1 %
# Upper ends of the classes of the share of refused frames, and what the legend says.
CLASSES = ((0.05, "under 5 %"), (0.15, "5 to 15 %"), (0.3, "15 to 30 %"), (0.6, "30 to 60 %"), (1.01, "60 % and more"))
KEYS = [(f"cell c{i}", text) for i, (_, text) in enumerate(CLASSES)]  # of the legend
KEYS += [("cell few", f"small: fewer than {LEAST_FRAMES} frames")]
LEAST_COLUMNS = 20  # of a picture, so that few cells are not drawn large
PX = 12  # side of a cell, SVG units
MARGIN_PX = 22  # below the grid, for the scale

# Frames far away from the others (a wrong position) must not make the cells large: 0.5 % at each side are left out.
BOUNDS = """
SELECT map, count(*) AS frames,
    quantile_cont(lat_deg, 0.005) AS south, quantile_cont(lat_deg, 0.995) AS north,
    quantile_cont(lon_deg, 0.005) AS west, quantile_cont(lon_deg, 0.995) AS east
FROM frames JOIN flights USING (flight) WHERE lat_deg IS NOT NULL AND verdict IS NOT NULL
GROUP BY map ORDER BY frames DESC, map
"""
CELLS = """
SELECT CAST(floor((lon_deg - $2) / $4) AS INTEGER) AS x, CAST(floor((lat_deg - $3) / $5) AS INTEGER) AS y,
    count(*) AS frames, count(*) FILTER (verdict = 'refused') AS refused, mode(reason) AS reason,
    median(sigma_m) AS sigma_m, count(DISTINCT flight) AS flights
FROM frames JOIN flights USING (flight)
WHERE map IS NOT DISTINCT FROM $1 AND verdict IS NOT NULL AND lon_deg >= $2 AND lat_deg >= $3
GROUP BY x, y HAVING x < $6 AND y < $7 ORDER BY x, y
"""


@dataclass(frozen=True)
class Cell:
    """``lat_deg``, ``lon_deg``: its centre. ``x``, ``y``: its column and row, from the south-west corner."""

    x: int
    y: int
    lat_deg: float
    lon_deg: float
    frames: int
    refused: int
    reason: str | None  # the commonest one
    sigma_m: float | None  # median
    flights: int

    @property
    def share(self) -> float:
        return self.refused / self.frames


@dataclass(frozen=True)
class PlaceGrid:
    """Cells of ``cell_m`` over one map, ``columns`` by ``rows``."""

    map: str | None
    frames: int
    cell_m: int
    columns: int
    rows: int
    cells: list[Cell]


def grids(tables: FleetTables) -> list[PlaceGrid]:
    """One for each map, those with most frames first."""
    return [_grid(tables, **bounds) for bounds in tables.ask(BOUNDS).objects()]


def _grid(
    tables: FleetTables, map: str | None, frames: int, south: float, north: float, west: float, east: float
) -> PlaceGrid:
    metres_per_lon_deg = METRES_PER_DEG * max(0.01, math.cos(math.radians((south + north) / 2)))
    height_m, width_m = (north - south) * METRES_PER_DEG, (east - west) * metres_per_lon_deg
    longest_m = max(height_m, width_m)
    cell_m = next((size for size in CELLS_M if longest_m / size <= MAX_CELLS), CELLS_M[-1])
    columns, rows = (max(1, math.ceil(extent / cell_m)) for extent in (width_m, height_m))
    lon_step, lat_step = cell_m / metres_per_lon_deg, cell_m / METRES_PER_DEG
    found = tables.ask(CELLS, [map, west, south, lon_step, lat_step, columns, rows]).objects()
    cells = [
        Cell(lat_deg=south + (one["y"] + 0.5) * lat_step, lon_deg=west + (one["x"] + 0.5) * lon_step, **one)
        for one in found
    ]
    return PlaceGrid(map, frames, cell_m, columns, rows, cells)


def picture(grid: PlaceGrid) -> str:
    """SVG, north up: each cell in the colour of its class, those with few frames small."""
    width, height = max(grid.columns, LEAST_COLUMNS) * PX, grid.rows * PX
    marks = "".join(_mark(cell, grid) for cell in grid.cells)
    scale = max(1, max(grid.columns, LEAST_COLUMNS) // 4)
    y = height + MARGIN_PX / 2
    label = f"Share of refused frames on {grid.map or 'an unknown map'}"
    return Markup(
        f'<svg class="places" viewBox="-2 -2 {width + 4} {height + MARGIN_PX + 2}" role="img" '
        f'aria-label="{escape(label)}"><rect class="rail" width="{width}" height="{height}"/>{marks}'
        f'<path class="ruler" d="M0 {y - 3}v6M0 {y}h{scale * PX}m0 -3v6"/>'
        f'<text x="{scale * PX + 5}" y="{y + 3.5}">{_length(scale * grid.cell_m)}</text></svg>'
    )


def worst(found: list[PlaceGrid], count: int) -> list[tuple[PlaceGrid, Cell]]:
    """Cells with the largest shares of refused frames, and enough frames."""
    all_cells = [(grid, cell) for grid in found for cell in grid.cells if cell.frames >= LEAST_FRAMES and cell.refused]
    return sorted(all_cells, key=lambda pair: (-pair[1].share, -pair[1].frames))[:count]


def _mark(cell: Cell, grid: PlaceGrid) -> str:
    css = next(i for i, (limit, _) in enumerate(CLASSES) if cell.share < limit)
    inset = PX / 3 if cell.frames < LEAST_FRAMES else 0.5
    x, y = cell.x * PX + inset, (grid.rows - 1 - cell.y) * PX + inset
    tip = f"{cell.lat_deg:.5f}, {cell.lon_deg:.5f}: {cell.refused} of {cell.frames} frames refused ({cell.share:.0%})"
    tip += f", mostly {words(cell.reason)}" if cell.reason else ""
    tip += f"; {cell.flights} flights" + (f", median sigma {cell.sigma_m:.1f} m" if cell.sigma_m is not None else "")
    side = PX - 2 * inset
    return (
        f'<rect class="c{css}" x="{x:.1f}" y="{y:.1f}" width="{side:.1f}" height="{side:.1f}">'
        f"<title>{escape(tip)}</title></rect>"
    )


def words(reason: Any) -> str:
    return str(reason or "-").replace("_", " ")


def _length(metres: float) -> str:
    return f"{metres / 1000:g} km" if metres >= 1000 else f"{metres:g} m"
