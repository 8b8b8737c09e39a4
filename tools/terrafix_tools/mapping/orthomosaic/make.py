"""`terrafix map mosaic`: from a record to a layer."""

from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from pyproj import CRS

from terrafix.core.errors import OutputError, SourceError, UsageError
from terrafix.map.format import CE90_SIGMAS
from terrafix_tools.locate.ground import ground_patch
from terrafix_tools.locate.locator import FlightLocator
from terrafix_tools.locate.position import Pixel, locate_object
from terrafix_tools.locate.views import CameraView
from terrafix_tools.log.contents import read_contents
from terrafix_tools.mapping.build_checks import check_date
from terrafix_tools.mapping.orthomosaic.composite import Composite, grid_around, is_steep
from terrafix_tools.mapping.orthomosaic.frames import images, spread
from terrafix_tools.mapping.orthomosaic.write import Statement, write_cog
from terrafix_tools.mapping.sources.utm import utm_epsg
from terrafix_tools.progress import progress_bar

PROBED = ((0.5, 0.5), (0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75))  # places in a frame, shares of its size
MAX_SIGMA_M = 10.0  # default of the largest stated 1-sigma of a frame that is used


@dataclass(frozen=True)
class OrthomosaicRequest:
    """The options of the command."""

    record: Path
    out: Path
    frames: Path | None = None
    map_path: Path | None = None
    gsd_m: float | None = None
    max_sigma_m: float = MAX_SIGMA_M
    date: str = ""
    flown_by: str = ""


@dataclass(frozen=True)
class Made:
    """``frames``: that are visible in the mosaic; ``covered_m2``: area of its pixels."""

    frames: int
    gsd_m: float
    covered_m2: float
    statement: Statement


def make(wanted: OrthomosaicRequest, *, progress: bool = False) -> Made:
    """Raises SourceError, MapError, UsageError, OutputError."""
    if wanted.out.suffix.lower() not in (".tif", ".tiff"):
        raise UsageError(f"{wanted.out}: a GeoTIFF ends in .tif; choose another name")
    if not wanted.out.absolute().parent.is_dir():
        raise OutputError(f"{wanted.out.parent}: no such folder; make it, or choose another file")
    check_date(wanted.date)
    locator = FlightLocator.open(wanted.record, wanted.map_path)
    views = spread(locator.flight.views, wanted.max_sigma_m)
    if not views:
        raise SourceError(
            f"{wanted.record}: no frame has a position that is known to {wanted.max_sigma_m:g} m; give a larger --sigma"
        )
    origin = locator.flight.origin
    crs = CRS.from_epsg(utm_epsg(origin.lon_deg, origin.lat_deg))
    frame = locator.flight.frame
    made = Composite(grid_around(views, frame, crs, wanted.gsd_m), frame, locator.elevation)
    by_id = {view.frame_id: view for view in views}
    with progress_bar(progress) as bar:
        step = bar("frames", len(views))
        for frame_id, image in images(wanted.record, wanted.frames, set(by_id)):
            made.add(by_id[frame_id], image)
            step()
    shown = Counter(made.frame_of[made.valid].tolist())
    if not shown:
        raise SourceError(f"{wanted.record}: the images of its frames were not found; give its flight with --frames")
    statement = Statement(
        date=wanted.date or _date_of(wanted.record),
        ce90_m=_ce90_m(locator, by_id, shown),
        flown_by=wanted.flown_by,
        flight=wanted.record.resolve().name,
    )
    write_cog(wanted.out, made, statement)
    gsd_m = made.grid.gsd_m
    return Made(len(shown), gsd_m, shown.total() * gsd_m**2, statement)


def _date_of(record: Path) -> str:
    """Date of the flight (UTC); empty where no clock was plausible."""
    start = read_contents(record).start_utc
    return datetime.fromisoformat(start).astimezone(UTC).date().isoformat() if start else ""


def _ce90_m(locator: FlightLocator, views: dict[int, CameraView], shown: Counter[int]) -> float:
    """CE90 of the mosaic: the mean variance of what its frames show at their middle and half way to their corners, by
    the number of pixels that are of each frame."""
    variances_m2, weights = [], []
    for frame_id, pixels in shown.items():
        camera, view = views[frame_id].calibration, views[frame_id]
        for across, down in PROBED:
            pixel = Pixel(view, across * (camera.width - 1), down * (camera.height - 1))
            if not is_steep(pixel.ray()):
                continue
            patch = ground_patch(view, pixel.ray(), locator.cloud(-1), locator.elevation)
            variances_m2.append(float(np.trace(locate_object([pixel], [patch]).cov[:2, :2])) / 2.0)
            weights.append(pixels)
    return CE90_SIGMAS * float(np.sqrt(np.average(variances_m2, weights=weights)))
