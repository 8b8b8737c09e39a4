"""Training data: co-registered images of places, of one date or several.

A TOML list says which images show the same place, and which places are held out. A place is used for training or for
evaluation, not both: neighbouring crops of one place share streets, sensors and seasons, which would bias the
evaluation."""

import tomllib
from dataclasses import dataclass
from pathlib import Path

import cv2
import msgspec
import numpy as np
from PIL import Image, TiffImagePlugin

from terrafix_lab.train.errors import TrainingError

cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # OpenCV warns about every GeoTIFF tag

MIN_SIDE_PX = 640  # holds a rotated ground view at the coarsest zoom
MAX_LEVELS = 3  # octaves of scale: flights use roads at 0.3 m and at 1.2 m per pixel
TIE_POINT, PIXEL_SCALE = 33922, 33550  # GeoTIFF tags
SCALE_TOLERANCE = 1e-3


class Place(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``pictures``: files of one place, one per date."""

    name: str
    pictures: list[str]
    held_out: bool = False


class Places(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    place: list[Place]


@dataclass(frozen=True)
class TrainingGround:
    """A place at one scale. ``pictures`` (dates, 3, H, W) uint8 RGB."""

    name: str
    pictures: np.ndarray


def read_list(path: Path) -> list[Place]:
    """Reads and validates the list of places. Raises TrainingError."""
    try:
        places = msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), Places).place
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise TrainingError(f"{path}: no list of places ({error}); docs/training.md shows one") from None
    if len({place.name for place in places}) < len(places):
        raise TrainingError(f"{path}: two places have one name; rename one")
    if not any(place.held_out for place in places) or all(place.held_out for place in places):
        raise TrainingError(f"{path}: needs places to train on and others with held_out = true to measure on")
    shared = {p for one in places if one.held_out for p in one.pictures} & {
        p for one in places if not one.held_out for p in one.pictures
    }
    if shared:
        raise TrainingError(f"{path}: {min(shared)} is trained on and held out; choose one")
    return places


def read_places(places: list[Place], folder: Path) -> list[TrainingGround]:
    """All scale levels of all places. ``folder``: base of the image paths. Raises TrainingError."""
    return [level for place in places for level in _levels(place, folder)]


def _levels(place: Place, folder: Path) -> list[TrainingGround]:
    pictures = _crop_to_common_area([folder / name for name in place.pictures])
    if min(pictures[0].shape[:2]) < MIN_SIDE_PX:
        raise TrainingError(f"{place.name}: its images have less than {MIN_SIDE_PX} px in common; remove it")
    levels: list[TrainingGround] = []
    while len(levels) < MAX_LEVELS and min(pictures[0].shape[:2]) >= MIN_SIDE_PX:
        stacked = np.stack([image[:, :, ::-1].transpose(2, 0, 1) for image in pictures])
        levels.append(TrainingGround(place.name, stacked))
        half = pictures[0].shape[1] // 2, pictures[0].shape[0] // 2
        pictures = [cv2.resize(image, half, interpolation=cv2.INTER_AREA) for image in pictures]
    return levels


def _crop_to_common_area(paths: list[Path]) -> list[np.ndarray]:
    """Images (H, W, 3) uint8 BGR, cropped to their common area. Raises TrainingError."""
    corners = np.array([_corner_px(path, paths[0]) for path in paths])
    pictures = [_read_image(path) for path in paths]
    if not corners.any() and len({image.shape for image in pictures}) > 1 and not _georeference(paths[0]):
        raise TrainingError(f"{paths[0]}: not georeferenced, and not of the size of its other dates; use GeoTIFF")
    first = corners.max(axis=0)
    last = np.min([corner + image.shape[1::-1] for corner, image in zip(corners, pictures, strict=True)], axis=0)
    cut = []
    for corner, image in zip(corners, pictures, strict=True):
        (x0, y0), (x1, y1) = first - corner, last - corner
        cut.append(image[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)])
    return cut


def _corner_px(path: Path, base: Path) -> tuple[int, int]:
    """Column and row of an image's corner on the grid of ``base``, rounded: the residual is below half a pixel."""
    here, there = _georeference(path), _georeference(base)
    if here is None or there is None:
        return 0, 0
    if not np.allclose(here[:2], there[:2], rtol=SCALE_TOLERANCE):
        raise TrainingError(f"{path}: pixels of another size than those of {base}; bring it onto one grid (gdalwarp)")
    east_m, north_m = here[2] - there[2], here[3] - there[3]
    return round(east_m / there[0]), round(-north_m / there[1])


def _georeference(path: Path) -> tuple[float, float, float, float] | None:
    """Pixel size (x, y) and corner coordinates (x, y); None without georeference. Raises TrainingError."""
    try:
        with Image.open(path) as image:
            tags = image.tag_v2 if isinstance(image, TiffImagePlugin.TiffImageFile) else {}
            scale, tie = tags.get(PIXEL_SCALE), tags.get(TIE_POINT)
    except OSError as error:
        raise TrainingError(f"{path}: cannot be read ({error}); check the list of places") from None
    if not scale or not tie:
        return None
    return scale[0], scale[1], tie[3] - tie[0] * scale[0], tie[4] + tie[1] * scale[1]


def _read_image(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise TrainingError(f"{path}: not an image that OpenCV can read; bring it to 8 bits (gdal_translate -ot Byte)")
    return image
