"""A real aerial image through a tile server: displacement of the result against the original."""

import threading
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from rasterio.enums import Resampling
from rasterio.transform import Affine
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

from map_servers import HALF_M, Reply, Request, serving
from terrafix_tools.mapping.area.build import Order, build_order

ZOOM = 19
PATCH_PX = 512


@pytest.mark.slow
def test_a_town_through_a_tile_server_is_displaced_by_less_than_a_pixel(
    tmp_path: Path, data_set: Callable[[str], Path]
) -> None:
    path = data_set("maps/town.tif")
    span_m = 2 * HALF_M / (1 << ZOOM)
    world = {"transform": Affine(span_m / 256, 0, -HALF_M, 0, -span_m / 256, HALF_M), "width": 256 << ZOOM}
    lock = threading.Lock()
    with rasterio.open(path) as original:
        west, south, east, north = Transformer.from_crs(original.crs, 4326, always_xy=True).transform_bounds(
            *original.bounds
        )
        tiles = WarpedVRT(
            original, crs="EPSG:3857", height=256 << ZOOM, resampling=Resampling.cubic, add_alpha=True, **world
        )

        def answer(request: Request) -> Reply:
            zoom, column, row = (int(part) for part in request.path.removesuffix(".png").strip("/").split("/"))
            assert zoom == ZOOM
            with lock:
                bands = tiles.read([3, 2, 1, 4], window=Window(256 * column, 256 * row, 256, 256))
            return Reply(body=cv2.imencode(".png", bands.transpose(1, 2, 0))[1].tobytes())

        width_deg, height_deg = east - west, north - south
        box = f"{west + width_deg / 4},{south + height_deg / 4},{east - width_deg / 4},{north - height_deg / 4}"
        with tiles, serving(answer) as server:
            order = Order(
                area=box,
                buffer_km=0.0,
                source=[server.url + "/{z}/{x}/{y}.png"],
                licence="internal",
                gsd_m=0.3,
                rate=500.0,
                cache=tmp_path / "cache",
                out=tmp_path / "town.gpkg",
            )
            assert build_order(order)
        grid = {"crs": original.crs, "transform": original.transform, "width": original.width}
        with (
            rasterio.open(tmp_path / "town.gpkg") as made,
            WarpedVRT(made, height=original.height, resampling=Resampling.cubic, **grid) as back,
        ):
            for share in (0.4, 0.5, 0.6):
                corner = int(original.width * share) - PATCH_PX // 2, int(original.height * share) - PATCH_PX // 2
                window = Window(*corner, PATCH_PX, PATCH_PX)
                before, after = (
                    f.read([1, 2, 3], window=window).mean(axis=0).astype(np.float32) for f in (original, back)
                )
                assert np.corrcoef(before.ravel(), after.ravel())[0, 1] > 0.99
                hann = cv2.createHanningWindow((PATCH_PX, PATCH_PX), cv2.CV_32F)
                (x_px, y_px), _ = cv2.phaseCorrelate(before, after, hann)
                assert max(abs(x_px), abs(y_px)) < 0.5  # pixels of 0.16 m; the map's are 0.27 m
