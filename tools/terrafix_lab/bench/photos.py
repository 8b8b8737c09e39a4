"""Photos of 26 megapixels, as of a survey camera: time to the first position, and memory.

python -m terrafix_lab.bench.photos OUT.json [--pair FIRST.tif SECOND.tif] [--keep FOLDER]

A camera of 6252 x 4168 px flies in a straight line over the first image; the second one, of another date, is the map.
Without --pair both show a generated place. The imagery has fewer pixels than the photos: this measures the cost of
large images, not accuracy."""

import argparse
import csv
import json
import math
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image
from pyproj import Transformer

from terrafix.core.errors import MapError, TerrafixError
from terrafix_lab.bench import flights
from terrafix_lab.sim.world import place as world
from terrafix_tools.mapping.build import build
from terrafix_tools.mapping.source import ImagerySource
from terrafix_tools.models.two_dates import same_grid

SIZE_PX = 6252, 4168  # 26 megapixels, 3 : 2
FOCAL = 1 / (2 * math.tan(math.radians(30.0)))  # focal length / image width: 60 degrees field of view
SEEN_PX = 720  # width of a photo in pixels of the imagery
ADVANCE = 0.25  # base between two photos, in photo heights
PHOTOS, STEP_S = 6, 2
GRAIN = 4.0  # 1-sigma of sensor noise [grey levels]; makes a JPEG of enlarged imagery as large as a real one
JPEG_QUALITY, SEED = 92, 3
PLACE_M = 600.0, 800.0
_DATETIME_ORIGINAL, _EXIF_IFD, _GPS_IFD = 0x9003, 0x8769, 0x8825
XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" drone-dji:RelativeAltitude="{agl_m:+.2f}" '
    'drone-dji:GimbalYawDegree="{yaw_deg:+.2f}" drone-dji:GimbalPitchDegree="-90.0" '
    'drone-dji:CalibratedFocalLength="{focal_px:.2f}"></rdf:Description></rdf:RDF></x:xmpmeta>'
)


def write_photos(first: Path, second: Path, folder: Path, size_px: tuple[int, int] = SIZE_PX) -> None:
    """Writes photos of the first image, resampled to the grid of the second one, along its columns through its centre,
    and truth.csv. Raises MapError: no common grid, or too small."""
    ground, _ = same_grid(first, second)
    with ImagerySource(second) as source:
        crs_from_px, crs, gsd_m = source.transform, source.crs, source.gsd_m
    to_wgs84 = Transformer.from_crs(crs, 4326, always_xy=True)
    (width, height), focal_px = size_px, FOCAL * size_px[0]
    scale = SEEN_PX / width  # pixels of the imagery per pixel of the photo
    advance_px = np.array([0.0, -ADVANCE * height * scale])
    if (PHOTOS - 1) * -advance_px[1] + height * scale > ground.shape[0] or ground.shape[1] < SEEN_PX:
        raise MapError(f"{second}: too small for {PHOTOS} photos; choose a larger image")
    agl_m = SEEN_PX * gsd_m * FOCAL
    rng = np.random.default_rng(SEED)
    folder.mkdir(parents=True)
    rows = []
    for i in range(PHOTOS):
        centre_px = np.array(ground.shape[1::-1]) / 2 + (i - (PHOTOS - 1) / 2) * advance_px
        lon_deg, lat_deg = to_wgs84.transform(*(crs_from_px @ centre_px))
        ahead = to_wgs84.transform(*(crs_from_px @ (centre_px + advance_px)))
        yaw_deg = math.degrees(math.atan2((ahead[0] - lon_deg) * math.cos(math.radians(lat_deg)), ahead[1] - lat_deg))
        corner = centre_px - 0.5 - scale * (np.array(size_px) - 1) / 2
        matrix = np.array([[scale, 0.0, corner[0]], [0.0, scale, corner[1]]])
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        photo = cv2.warpAffine(ground, matrix, size_px, flags=flags, borderMode=cv2.BORDER_REFLECT_101)
        grain = rng.normal(0.0, GRAIN, photo.shape[:2]).astype(np.float32)[..., None]
        photo = np.clip(photo + grain, 0, 255).astype(np.uint8)
        exif = Image.Exif()
        exif.get_ifd(_EXIF_IFD)[_DATETIME_ORIGINAL] = f"2024:05:06 10:00:{i * STEP_S:02}"
        exif.get_ifd(_GPS_IFD).update({1: "SN"[lat_deg > 0], 2: _dms(lat_deg), 3: "WE"[lon_deg > 0], 4: _dms(lon_deg)})
        xmp = XMP.format(agl_m=agl_m, yaw_deg=yaw_deg, focal_px=focal_px).encode()
        name = f"DJI_{i:04}.JPG"
        Image.fromarray(photo[:, :, ::-1]).save(folder / name, quality=JPEG_QUALITY, exif=exif, xmp=xmp)
        rows.append([name, f"{lat_deg:.8f}", f"{lon_deg:.8f}", f"{agl_m:.2f}", f"{yaw_deg:.2f}"])
    with (folder / "truth.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([["file", "lat_deg", "lon_deg", "agl_m", "yaw_deg"], *rows])


def measure(work: Path, pair: tuple[Path, Path] | None = None) -> dict[str, Any]:
    """-> size of the photos; ``first_position_s``: from the start of the program, with its imports; the rest as
    ``flights.measure``. The map is built before, untimed. Raises MapError."""
    first, second = pair or _generated(work)
    write_photos(first, second, work / "photos")
    package = build(second, work / "map.gpkg")
    out = work / "replay"
    command = [sys.executable, "-m", flights.__name__, str(work / "photos"), str(package), str(out)]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True)
    if done.returncode != 0:
        raise MapError(f"{work / 'photos'}: the replay failed ({done.stderr.strip()})")
    found: dict[str, Any] = json.loads((out / flights.RESULT).read_text(encoding="utf-8"))
    head = {"width_px": SIZE_PX[0], "height_px": SIZE_PX[1], "photos": PHOTOS}
    return head | {"first_position_s": round(found["start_up_s"] + found["first_frame_ms"] / 1e3, 2)} | found


def _generated(work: Path) -> tuple[Path, Path]:
    place = world.generate(SEED, width_m=PLACE_M[0], height_m=PLACE_M[1])
    paths = work / "autumn.tif", work / "summer.tif"
    for path in paths:
        world.write_image(path, place, place.render(path.stem))
    return paths


def _dms(angle_deg: float) -> tuple[float, float, float]:
    """-> degrees, minutes, seconds without a sign, as in EXIF."""
    degrees, rest = divmod(abs(angle_deg), 1.0)
    minutes, rest = divmod(60.0 * rest, 1.0)
    return degrees, minutes, round(60.0 * rest, 5)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, metavar="OUT.json")
    parser.add_argument(
        "--pair", type=Path, nargs=2, metavar=("FIRST", "SECOND"), help="imagery that the camera sees, and the map"
    )
    parser.add_argument(
        "--keep", type=Path, metavar="FOLDER", help="new folder in which photos, map and replay are kept"
    )
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="terrafix-photos-") as temporary:
        work = given.keep or Path(temporary)
        try:
            work.mkdir(parents=True, exist_ok=given.keep is None)
            found = measure(work, given.pair and (given.pair[0], given.pair[1]))
        except (TerrafixError, FileExistsError) as error:
            sys.exit(f"{error}")
    given.out.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
