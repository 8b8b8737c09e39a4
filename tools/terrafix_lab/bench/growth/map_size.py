"""Cost of a map as its area grows: build, open, read, correlate.

python -m terrafix_lab.bench.growth.map_size KM2 WORK OUT builds WORK/map.gpkg; ``map_size search WORK OUT``
measures it.

The imagery is noise of several scales without repetition, 0.5 m per pixel; the frame is a part of it. Times with "cpu"
in their name are processor times of all threads; the others are wall-clock times."""

import filecmp
import json
import math
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from rasterio.transform import Affine
from rasterio.windows import Window

from terrafix.anchor.matching.frame_matcher import FrameMatcher, View
from terrafix.anchor.matching.point_mass_filter import Belief, belief_cell_m
from terrafix.core.camera import CameraCalibration
from terrafix.core.geodesy import LocalFrame
from terrafix.map.package import LocalMap, MapPackage
from terrafix_engines.features import open_describer
from terrafix_tools.mapping.build import build
from terrafix_tools.replay import peak_memory_mb
from terrafix_tools.timing import spread

GSD_M = 0.5
BLOCK_PX = 512
AGL_M = 150.0
CAMERA = CameraCalibration(640, 360, 380.0, 380.0, 319.5, 179.5)
DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # camera to world, looking straight down
EPSG, WEST_M, NORTH_M = 32632, 690_000.0, 5_330_000.0
BELIEFS_M = {"in flight": 20.0, "lost": 300.0}  # 1-sigma of the belief for the correlation
CORRELATIONS = 8
WORKERS = 4
WINDOW_GSD_M, WINDOWS = (0.5, 0.6, 0.7, 0.85, 1.0, 1.2, 1.5, 1.8, 2.0, 3.0, 4.0), 30


def measure(area_km2: float, work: Path) -> dict[str, Any]:
    """-> times of a whole build, from the image to the package, with one process and with WORKERS; size."""
    side_px = round(math.sqrt(area_km2) * 1000.0 / GSD_M)
    image, package, other = work / "map.tif", work / "map.gpkg", work / "by-several" / "map.gpkg"
    _draw(image, side_px)
    began_s, began_cpu_s = time.monotonic(), time.process_time()
    build(image, package)
    alone_s, alone_cpu_s = time.monotonic() - began_s, time.process_time() - began_cpu_s
    began_s = time.monotonic()
    build(image, other, workers=WORKERS)
    together_s = time.monotonic() - began_s
    same = filecmp.cmp(package, other, shallow=False)
    image.unlink()
    other.unlink()
    return {
        "area_km2": area_km2,
        "gsd_m": GSD_M,
        "build_cpu_s": round(alone_cpu_s, 2),
        "build_s": round(alone_s, 2),
        "build_by_several_s": round(together_s, 2),
        "speed_up": round(alone_s / together_s, 2),
        "same_bytes": same,
        "package_mb": round(package.stat().st_size / 2**20, 1),
    }


def search(package: Path) -> dict[str, Any]:
    """-> costs of this map on board. Needs its own process, because it measures memory."""
    before_mb = peak_memory_mb()
    began_s = time.monotonic()
    opened = MapPackage.open(package)
    place = centre(opened)
    local = opened.bind(place)
    open_ms = (time.monotonic() - began_s) * 1e3
    matcher = FrameMatcher(CAMERA, local, open_describer(""))
    frame = frame_at(local, 0.0)
    view = View(0.0, 0.0, DOWN, AGL_M, 0.0, 0.03, 0.02, 0.02)
    correlations_ms = {}
    for name, sigma_m in BELIEFS_M.items():
        belief = Belief(0.0, 0.0, sigma_m, belief_cell_m(AGL_M, matcher.correlation_cell_m(AGL_M)))
        correlations_ms[name] = spread(
            [_ms(partial(matcher.correlate, frame, view, belief)) for _ in range(CORRELATIONS)]
        )
    grown_mb = peak_memory_mb() - before_mb
    windows = {f"{gsd_m:g} m/px": spread(_windows_ms(local, gsd_m)) for gsd_m in WINDOW_GSD_M}
    opened.close()
    return {
        "open_ms": round(open_ms, 1),
        "window_ms": windows,
        "look_cpu_ms": correlations_ms,
        "memory_mb": round(grown_mb, 1),
    }


def _windows_ms(local: LocalMap, gsd_m: float) -> list[float]:
    """-> times of reading windows of 1 km around the centre, with their tiles in the cache."""
    side_px = round(1000.0 / gsd_m)
    shifts_m = np.random.default_rng(5).uniform(-100.0, 100.0, (WINDOWS, 2)).tolist()
    reads = [partial(local.window, e_m - 500.0, n_m + 500.0, side_px, side_px, gsd_m) for e_m, n_m in shifts_m]
    for read in reads:
        read()
    return [_ms(read, time.monotonic) for read in reads]


def centre(package: MapPackage) -> LocalFrame:
    west, south, east, north = package.manifest.bounds_wgs84
    return LocalFrame((south + north) / 2, (west + east) / 2)


def frame_at(local: LocalMap, e_m: float) -> np.ndarray:
    """-> image of CAMERA that looks straight down ``e_m`` east of the centre, north up."""
    gsd_m = AGL_M / CAMERA.fx
    image, _ = local.window(
        e_m - CAMERA.width / 2 * gsd_m, CAMERA.height / 2 * gsd_m, CAMERA.width, CAMERA.height, gsd_m
    )
    return image


def _draw(path: Path, side_px: int) -> None:
    """Writes the imagery block by block, because 100 km2 do not fit into memory."""
    profile = {
        "driver": "GTiff", "width": side_px, "height": side_px, "count": 3, "dtype": "uint8", "crs": f"EPSG:{EPSG}",
        "transform": Affine(GSD_M, 0.0, WEST_M, 0.0, -GSD_M, NORTH_M), "tiled": True,
        "compress": "JPEG", "photometric": "YCBCR", "blockxsize": BLOCK_PX, "blockysize": BLOCK_PX,
    }  # fmt: skip
    with rasterio.open(path, "w", **profile) as file:
        for row in range(0, side_px, BLOCK_PX):
            for column in range(0, side_px, BLOCK_PX):
                size = (min(BLOCK_PX, side_px - column), min(BLOCK_PX, side_px - row))
                block = _block(np.random.default_rng([row, column]))[: size[1], : size[0]]
                window = Window(column, row, *size)
                file.write(np.moveaxis(block, 2, 0), window=window)


def _block(rng: np.random.Generator) -> np.ndarray:
    image = np.full((BLOCK_PX, BLOCK_PX), 120.0, np.float32)
    for cells, contrast in ((5, 25.0), (20, 20.0), (70, 16.0), (200, 10.0)):
        noise = rng.normal(0.0, contrast, (cells, cells)).astype(np.float32)
        image += cv2.resize(noise, (BLOCK_PX, BLOCK_PX), interpolation=cv2.INTER_CUBIC)
    return cv2.merge([np.clip(image * k, 0, 255).astype(np.uint8) for k in (0.9, 1.0, 1.05)])


def _ms(work: Callable[[], object], clock: Callable[[], float] = time.process_time) -> float:
    began_s = clock()
    work()
    return (clock() - began_s) * 1e3


if __name__ == "__main__":
    _what, _folder, _out = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
    _found = search(_folder / "map.gpkg") if _what == "search" else measure(float(_what), _folder)
    _out.write_text(json.dumps(_found), encoding="utf-8")
