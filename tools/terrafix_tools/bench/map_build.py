"""Time of `terrafix map build` beside GDAL's COG driver on the same raster: python -m terrafix_tools.bench.map_build.

Both read the raster, halve it by the mean and write JPEG tiles of all levels in this process: CPU time with one thread,
and wall time with all cores (of the build: --workers). The build also searches the collar of an image without a mask,
computes descriptors and hashes every tile; the driver does nothing of it. The two take turns, and the ratio is of the
medians. An image in degrees is projected by both, by the driver with TARGET_SRS."""

import os
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import rasterio.shutil
import typer
from rasterio.errors import RasterioError
from rich.console import Console
from rich.table import Table

from terrafix.core.errors import MapError, UsageError
from terrafix_tools.bench.result_file import write_result
from terrafix_tools.mapping.build import build
from terrafix_tools.mapping.package.pyramid import JPEG_QUALITY
from terrafix_tools.mapping.source import ImagerySource
from terrafix_tools.parallel.pool import default_workers
from terrafix_tools.standalone import run_standalone

# The driver's default quality is 75, which writes less; the comparison with it is the stricter one.
QUALITIES = (75, JPEG_QUALITY)


@dataclass(frozen=True)
class Times:
    """Seconds, and bytes written."""

    cpu_s: float
    wall_s: float
    size: int


def cog_options(image: Path, quality: int, threads: int) -> dict[str, str]:
    """-> creation options of GDAL's COG driver (gdal.org) for the work that the build does."""
    options = {"compress": "JPEG", "quality": str(quality), "overview_resampling": "average"}
    options["num_threads"] = str(threads)
    with ImagerySource(image) as source:
        if source.warped:
            west, south, east, north = source.bounds
            options |= {"target_srs": source.crs.to_wkt(), "res": repr(source.pixel_x), "warp_resampling": "bilinear"}
            options |= {"extent": f"{west},{south},{east},{north}", "add_alpha": "YES"}
    return options


def write_cog(image: Path, out: Path, options: dict[str, str]) -> None:
    """Raises MapError."""
    try:
        rasterio.shutil.copy(str(image), str(out), driver="COG", **options)
    except RasterioError as error:
        raise MapError(f"{image}: GDAL cannot write it as COG ({error}); give another raster") from None


def timed(work: Callable[[], object], out: Path) -> Times:
    """Runs ``work``, which writes ``out``."""
    out.unlink(missing_ok=True)
    wall_s, cpu_s = time.monotonic(), time.process_time()
    work()
    return Times(time.process_time() - cpu_s, time.monotonic() - wall_s, out.stat().st_size)


def measure(image: Path, work: Path, repeats: int) -> dict[str, Any]:
    """-> medians of ``repeats`` rounds for one raster, and our times divided by the driver's."""
    package, cog, threads = work / "map.gpkg", work / "cog.tif", default_workers()
    jobs: dict[str, tuple[Callable[[], object], Path]] = {
        "build": (partial(build, image, package), package),
        "build_all_cores": (partial(build, image, package, workers=threads), package),
    }
    for quality in QUALITIES:
        for name, count in ((f"cog_{quality}", 1), (f"cog_{quality}_all_cores", threads)):
            jobs[name] = partial(write_cog, image, cog, cog_options(image, quality, count)), cog
    for job, _ in jobs.values():
        job()  # libraries load, and the file comes into the page cache
    rounds = [{name: timed(job, out) for name, (job, out) in jobs.items()} for _ in range(repeats)]
    result: dict[str, Any] = {"megapixels": round(_megapixels(image), 1)}
    for name in jobs:
        of_name = [times[name] for times in rounds]
        result[name] = {
            "cpu_s": round(statistics.median(t.cpu_s for t in of_name), 3),
            "wall_s": round(statistics.median(t.wall_s for t in of_name), 3),
            "mb": round(of_name[0].size / 2**20, 2),
        }
    for quality in QUALITIES:
        result[f"ratio_{quality}"] = {
            "cpu": round(result["build"]["cpu_s"] / result[f"cog_{quality}"]["cpu_s"], 2),
            "wall": round(result["build_all_cores"]["wall_s"] / result[f"cog_{quality}_all_cores"]["wall_s"], 2),
        }
    return result


def _megapixels(image: Path) -> float:
    with ImagerySource(image) as source:
        return source.width_px * source.height_px / 1e6


def show(found: dict[str, dict[str, Any]], console: Console) -> None:
    table = Table(title="Map build beside GDAL's COG driver", title_justify="left")
    table.add_column("raster")
    for head in ("Mpx", "build, CPU s", *(f"COG q{quality}, CPU s" for quality in QUALITIES)):
        table.add_column(head, justify="right")
    for quality in QUALITIES:
        table.add_column(f"CPU / q{quality}", justify="right")
        table.add_column(f"wall / q{quality}", justify="right")
    for name, row in found.items():
        cells = [
            str(row["megapixels"]),
            *(f"{row[k]['cpu_s']:.2f}" for k in ("build", *(f"cog_{q}" for q in QUALITIES))),
        ]
        ratios = (f"x {row[f'ratio_{quality}'][of]:.2f}" for quality in QUALITIES for of in ("cpu", "wall"))
        table.add_row(name, *cells, *ratios)
    console.print(table)


def bench(
    images: Annotated[list[Path], typer.Argument(help="Rasters, as for `terrafix map build`.")],
    out: Annotated[Path | None, typer.Option(help="JSON file of the results.")] = None,
    repeats: Annotated[int, typer.Option(help="Rounds; the median counts.")] = 3,
) -> None:
    """CPU and wall time of the map build and of GDAL's COG driver on the same rasters, and their ratios."""
    if repeats < 1:
        raise UsageError(f"--repeats {repeats}: give 1 or more")
    found = {}
    with tempfile.TemporaryDirectory(prefix="terrafix-map-build-") as work:
        for image in images:
            found[image.name] = measure(image, Path(work), repeats)
    write_result(out, {"cores": default_workers(), "load_average": os.getloadavg(), "rasters": found})
    show(found, Console(width=130))


if __name__ == "__main__":
    run_standalone("map_build", bench)
