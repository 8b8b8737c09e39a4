"""Focal length and principal point of a stored photo from its EXIF and XMP.

A calibration, and the sizes in EXIF, are those of the photo as the camera stored it; a program that has made it
smaller, turned or cut it may have kept or changed them."""

import math
from dataclasses import dataclass

# Width of the whole sensor in mm, from the manufacturers; every mode of these cameras uses the whole width.
SENSOR_WIDTH_MM = {
    "FC220": 6.17,  # Mavic Pro
    "FC300C": 6.17,  # Phantom 3 Standard
    "FC300S": 6.17,  # Phantom 3 Advanced
    "FC300X": 6.17,  # Phantom 3 Professional
    "FC330": 6.17,  # Phantom 4
    "FC350": 6.17,  # Zenmuse X3
    "FC6310": 13.2,  # Phantom 4 Pro
    "FC6310R": 13.2,  # Phantom 4 RTK
    "FC6310S": 13.2,  # Phantom 4 Pro V2
    "L1D-20c": 13.2,  # Mavic 2 Pro
    "M3E": 17.3,  # Mavic 3 Enterprise
}
DIAGONAL_35_MM = 43.267  # diagonal of 36x24 mm: the 35 mm equivalent focal length refers to diagonals (CIPA DCG-001)
WIDE_ASPECT = 1.6  # a wider photo is a crop of a 4:3 sensor; the 35 mm equivalent refers to the sensor's diagonal
ASPECT_TOLERANCE = 0.02  # a size rounded to whole pixels and to the blocks of a JPEG keeps its aspect within this
# A calibrated principal point is within a few percent of the middle; farther away the calibration is of another size.
MAX_OFF_CENTRE = 0.1  # of the width and of the height
MAX_UNEQUAL = 0.06  # of the sizes that both coordinates of the principal point tell: it is within 1.5 % of the middle
# Two statements of one focal length that differ by more: the 35 mm equivalent is rounded, and refers to diagonals or to
# widths, which differ by a fifth.
MAX_DISAGREEMENT = 1.5


@dataclass(frozen=True)
class LensTags:
    """What EXIF and XMP state of the lens; None: not stated."""

    model: str = ""
    focal_mm: float | None = None
    focal_35_mm: float | None = None
    digital_zoom: float | None = None
    px_per_mm: float | None = None  # FocalPlaneXResolution
    exif_size: tuple[float | None, float | None] = (None, None)  # of the photo as the camera stored it
    calibrated_px: float | None = None
    calibrated_centre_px: tuple[float, float] | None = None
    calibrated_mm: float | None = None


@dataclass(frozen=True)
class Lens:
    """In pixels of the stored photo. ``focal_px`` None: not stated, or stated in a way that cannot be used, of which
    ``problem`` says why. ``notes``: what was assumed, in words."""

    focal_px: float | None = None
    focal_from: str = ""
    centre_px: tuple[float, float] | None = None
    problem: str = ""
    notes: tuple[str, ...] = ()


def lens_of(tags: LensTags, width: int, height: int) -> Lens:
    """``width``, ``height``: of the stored photo."""
    resized, turned, problem = _resized(tags, width, height)
    if problem:
        return Lens(problem=problem)
    notes = [f"made smaller by {resized:.3g} after the camera had stored it"] if abs(resized - 1.0) > 1e-3 else []
    zoom = tags.digital_zoom if tags.digital_zoom is not None and tags.digital_zoom > 1.0 else 1.0
    per_35_mm = None if not tags.focal_35_mm else _focal_of_35_mm(tags.focal_35_mm, width, height)
    zoomed = f", times the digital zoom of {zoom:g}" if zoom > 1.0 else ""
    if tags.calibrated_px:
        focal_px, centre_px = tags.calibrated_px * resized, _scaled(tags.calibrated_centre_px, resized)
        by, centre_px, problem = _by_centre(centre_px, width, height, turned=turned)
        if problem:
            return Lens(problem=problem)
        if abs(by - 1.0) > 1e-3:
            notes.append(f"calibrated at {1.0 / by:.3g} times the size of the photo, by its principal point")
        focal_px *= by
        if per_35_mm and not 1 / MAX_DISAGREEMENT <= focal_px / per_35_mm <= MAX_DISAGREEMENT:
            return Lens(
                problem=f"CalibratedFocalLength is {focal_px:.0f} px of this photo, FocalLengthIn35mmFilm is "
                f"{per_35_mm:.0f} px: the calibration is of another size or lens"
            )
        return Lens(focal_px * zoom, f"CalibratedFocalLength{zoomed}", centre_px, notes=tuple(notes))
    sensor_mm = SENSOR_WIDTH_MM.get(tags.model)
    if tags.calibrated_mm and tags.px_per_mm:
        focal_px = tags.calibrated_mm * tags.px_per_mm * resized * zoom
        return Lens(focal_px, f"PerspectiveFocalLength and FocalPlaneXResolution{zoomed}", notes=tuple(notes))
    if tags.focal_mm and sensor_mm:
        focal_px = tags.focal_mm / sensor_mm * max(width, height) * zoom
        return Lens(focal_px, f"FocalLength and the sensor table{zoomed}", notes=tuple(notes))
    if tags.focal_mm and tags.px_per_mm:
        focal_px = tags.focal_mm * tags.px_per_mm * resized * zoom
        return Lens(focal_px, f"FocalLength and FocalPlaneXResolution{zoomed}", notes=tuple(notes))
    if per_35_mm and zoom > 1.0:
        return Lens(
            problem=f"has a digital zoom of {zoom:g}, and of its focal length FocalLengthIn35mmFilm alone, which some "
            "makers state with the zoom and others without"
        )
    return Lens(per_35_mm, "FocalLengthIn35mmFilm", notes=tuple(notes)) if per_35_mm else Lens()


def _focal_of_35_mm(focal_35_mm: float, width: int, height: int) -> float:
    long, short = max(width, height), min(width, height)
    return focal_35_mm / DIAGONAL_35_MM * math.hypot(long, short if long / short <= WIDE_ASPECT else long * 3 / 4)


def _resized(tags: LensTags, width: int, height: int) -> tuple[float, bool, str]:
    """-> size of the photo over that which EXIF states; whether it was turned by a quarter since; why it cannot be
    known (it was cut)."""
    exif_width, exif_height = tags.exif_size
    if exif_width is None or exif_width < 1:
        return 1.0, False, ""
    if exif_height is None or exif_height < 1:
        return width / exif_width, False, ""
    turned = (exif_width > exif_height) != (width > height) and exif_width != exif_height and width != height
    if turned:
        exif_width, exif_height = exif_height, exif_width
    by, by_height = width / exif_width, height / exif_height
    if abs(by / by_height - 1.0) > ASPECT_TOLERANCE:
        return by, turned, f"is {width}x{height}, the camera stored {exif_width:.0f}x{exif_height:.0f}: it was cut"
    return by, turned, ""


def _by_centre(
    centre_px: tuple[float, float] | None, width: int, height: int, *, turned: bool
) -> tuple[float, tuple[float, float] | None, str]:
    """-> factor by which the calibration is to be scaled for its principal point to be in the middle (1: it is there),
    that point in the photo (None: not known), and why there is no such factor."""
    if centre_px is None:
        return 1.0, None, ""
    for quarter, (x, y) in ((False, centre_px), (True, centre_px[::-1])):
        across, along = 2 * x / width, 2 * y / height
        near = max(abs(across - 1.0), abs(along - 1.0)) <= 2 * MAX_OFF_CENTRE
        if not near and not 0.0 < max(across, along) <= (1.0 + MAX_UNEQUAL) * min(across, along):
            continue
        by = 1.0 if near else 2.0 / (across + along)
        # Of a photo that was turned, or whose size is guessed, the offset from the middle is not known.
        return by, None if quarter or turned or by != 1.0 else centre_px, ""
    x, y = centre_px
    problem = f"CalibratedOpticalCenter ({x:.0f}, {y:.0f}) is not near the middle of {width}x{height}"
    return 1.0, None, f"{problem}: the calibration is of another size, or the photo was cut"


def _scaled(centre_px: tuple[float, float] | None, by: float) -> tuple[float, float] | None:
    return None if centre_px is None else ((centre_px[0] + 0.5) * by - 0.5, (centre_px[1] + 0.5) * by - 0.5)
