"""The ground that is trained on: pictures of places, of one date or of several, aligned to the pixel.

A list in TOML says which pictures show one place, and which places are held out. A place is trained on or measured on,
never both: neighbouring crops of one place share streets, sensors and seasons, and flatter what was trained on them."""

import tomllib
from dataclasses import dataclass
from pathlib import Path

import cv2
import msgspec
import numpy as np
from PIL import Image, TiffImagePlugin

from terrafix_engines.train.errors import TrainingError

cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # it warns of every tag of GeoTIFF

LEAST_SIDE_PX = 640  # a view of the ground, turned, at the coarsest zoom
MOST_LEVELS = 3  # octaves of scale: roads at 0.3 m and at 1.2 m a pixel are both met in flight
TIE_POINT, PIXEL_SCALE = 33922, 33550  # tags of GeoTIFF
SAME_SCALE = 1e-3


class Place(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``pictures``: of one place, a file for each date."""

    name: str
    pictures: list[str]
    held_out: bool = False


class Places(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    place: list[Place]


@dataclass(frozen=True)
class Ground:
    """A place at one scale. ``pictures`` (dates, 3, H, W) uint8 RGB."""

    name: str
    pictures: np.ndarray


def read_list(path: Path) -> list[Place]:
    """Raises TrainingError."""
    try:
        places = msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), Places).place
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise TrainingError(f"{path}: no list of places ({error}); docs/training.md shows one") from None
    if len({place.name for place in places}) < len(places):
        raise TrainingError(f"{path}: two places have one name; name them apart")
    if not any(place.held_out for place in places) or all(place.held_out for place in places):
        raise TrainingError(f"{path}: needs places to train on and others with held_out = true to measure on")
    shared = {p for one in places if one.held_out for p in one.pictures} & {
        p for one in places if not one.held_out for p in one.pictures
    }
    if shared:
        raise TrainingError(f"{path}: {min(shared)} is trained on and held out; decide")
    return places


def read_places(places: list[Place], folder: Path) -> list[Ground]:
    """All scales of all places; ``folder`` is where the paths of the pictures begin. Raises TrainingError."""
    return [level for place in places for level in _levels(place, folder)]


def _levels(place: Place, folder: Path) -> list[Ground]:
    pictures = _aligned([folder / name for name in place.pictures])
    if min(pictures[0].shape[:2]) < LEAST_SIDE_PX:
        raise TrainingError(f"{place.name}: less than {LEAST_SIDE_PX} px that all its pictures show; leave it out")
    levels: list[Ground] = []
    while len(levels) < MOST_LEVELS and min(pictures[0].shape[:2]) >= LEAST_SIDE_PX:
        stacked = np.stack([picture[:, :, ::-1].transpose(2, 0, 1) for picture in pictures])
        levels.append(Ground(place.name, stacked))
        half = pictures[0].shape[1] // 2, pictures[0].shape[0] // 2
        pictures = [cv2.resize(picture, half, interpolation=cv2.INTER_AREA) for picture in pictures]
    return levels


def _aligned(paths: list[Path]) -> list[np.ndarray]:
    """(H, W, 3) uint8 BGR each, cut to what all of them show. Raises TrainingError."""
    corners = np.array([_corner_px(path, paths[0]) for path in paths])
    pictures = [_picture(path) for path in paths]
    if not corners.any() and len({picture.shape for picture in pictures}) > 1 and not _georeference(paths[0]):
        raise TrainingError(f"{paths[0]}: not georeferenced, and not of the size of its other dates; use GeoTIFF")
    first = corners.max(axis=0)
    last = np.min([corner + picture.shape[1::-1] for corner, picture in zip(corners, pictures, strict=True)], axis=0)
    cut = []
    for corner, picture in zip(corners, pictures, strict=True):
        (x0, y0), (x1, y1) = first - corner, last - corner
        cut.append(picture[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)])
    return cut


def _corner_px(path: Path, base: Path) -> tuple[int, int]:
    """Column and row of a picture's corner on the grid of another one; what remains is less than half a pixel."""
    here, there = _georeference(path), _georeference(base)
    if here is None or there is None:
        return 0, 0
    if not np.allclose(here[:2], there[:2], rtol=SAME_SCALE):
        raise TrainingError(f"{path}: pixels of another size than those of {base}; bring it onto one grid (gdalwarp)")
    east_m, north_m = here[2] - there[2], here[3] - there[3]
    return round(east_m / there[0]), round(-north_m / there[1])


def _georeference(path: Path) -> tuple[float, float, float, float] | None:
    """Size of a pixel and coordinates of the corner; None: the file says none. Raises TrainingError."""
    try:
        with Image.open(path) as image:
            tags = image.tag_v2 if isinstance(image, TiffImagePlugin.TiffImageFile) else {}
            scale, tie = tags.get(PIXEL_SCALE), tags.get(TIE_POINT)
    except OSError as error:
        raise TrainingError(f"{path}: cannot be read ({error}); check the list of places") from None
    if not scale or not tie:
        return None
    return scale[0], scale[1], tie[3] - tie[0] * scale[0], tie[4] + tie[1] * scale[1]


def _picture(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise TrainingError(f"{path}: not a picture that OpenCV can read; bring it to 8 bits (gdal_translate -ot Byte)")
    return picture
