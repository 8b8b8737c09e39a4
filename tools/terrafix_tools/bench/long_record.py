"""A synthetic live record of any length, and a map of its ground, for the benchmark of the report."""

from pathlib import Path

import cv2
import numpy as np
import rasterio
from rasterio.transform import Affine

from terrafix import messages as m
from terrafix.core.config import Config
from terrafix.core.geodesy import local_crs
from terrafix.recorder.images import thumbnail_jpeg
from terrafix.recorder.provenance import header
from terrafix.recorder.writer import FlightWriter
from terrafix_tools.bench.long_flight import EXTENT_M, NS, ORIGIN, START_NS, Rates, messages, position_m

MAP_GSD_M, MAP_MARGIN_M = 0.5, 150.0
THUMBNAILS = 40  # different ones


def draw_map(path: Path) -> None:
    """Writes a GeoTIFF of noise of two scales under the whole flight, MAP_GSD_M a pixel."""
    width, height = (round(2 * (extent + MAP_MARGIN_M) / MAP_GSD_M) for extent in EXTENT_M)
    rng = np.random.default_rng(2)
    image = np.full((height, width), 120.0, np.float32)
    for cells, contrast in ((40, 25.0), (400, 20.0)):
        noise = rng.normal(0.0, contrast, (cells, cells)).astype(np.float32)
        image += cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
    bands = np.stack([np.clip(image * k, 0, 255).astype(np.uint8) for k in (1.05, 1.0, 0.9)])
    west_m, north_m = (-width * MAP_GSD_M / 2, height * MAP_GSD_M / 2)
    profile = {
        "driver": "GTiff", "width": width, "height": height, "count": 3, "dtype": "uint8",
        "crs": local_crs(ORIGIN.lat_deg, ORIGIN.lon_deg).to_wkt(),
        "transform": Affine(MAP_GSD_M, 0.0, west_m, 0.0, -MAP_GSD_M, north_m), "tiled": True,
    }  # fmt: skip
    with rasterio.open(path, "w", **profile) as file:
        file.write(bands)


def write_long_record(folder: Path, duration_s: float, rates: Rates) -> int:
    """Writes FOLDER/flight-000.mcap and FOLDER/truth.csv. Returns the size of the record in bytes."""
    folder.mkdir(parents=True, exist_ok=True)
    writer = FlightWriter(folder / "flight-000.mcap", header(Config()))
    rng = np.random.default_rng(1)
    pictures = [_picture(rng) for _ in range(THUMBNAILS)]
    with (folder / "truth.csv").open("w", encoding="utf-8") as truth:
        truth.write("file,lat_deg,lon_deg\n")
        for received_ns, message in messages(duration_s, rates, rng):
            writer.write(message, received_ns)
            if isinstance(message, m.Frame):
                writer.write_thumbnail(message.t_ns, message.frame_id, pictures[message.frame_id % THUMBNAILS])
                lat_deg, lon_deg = ORIGIN.to_wgs84(*position_m((message.t_ns - START_NS) / NS))
                truth.write(f"{message.file},{lat_deg:.8f},{lon_deg:.8f}\n")
    writer.close()
    return writer.path.stat().st_size


def _picture(rng: np.random.Generator) -> bytes:
    """A thumbnail that is as large as one of fields and houses: 10 to 15 kB."""
    coarse = rng.integers(60, 200, (45, 80, 3)).astype(np.uint8)
    large = np.kron(coarse, np.ones((12, 12, 1), np.uint8))
    noise = rng.normal(0.0, 10.0, large.shape)
    return thumbnail_jpeg(np.clip(large + noise, 0, 255).astype(np.uint8), 320)
