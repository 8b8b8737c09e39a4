"""A self-contained HTML page about a map package: where frames are placed alone, and the mission."""

import math
from pathlib import Path

import cv2
import numpy as np

from terrafix.core.errors import OutputError
from terrafix_tools.mapping.check.sight import Sight
from terrafix_tools.mapping.check.suitability import CheckResult, MapCheck
from terrafix_tools.mapping.check.text import lines_of
from terrafix_tools.pages.document import kit, macros
from terrafix_tools.pages.pictures import VOID_BGR, jpeg_uri

OWN = macros("terrafix_tools/package.html")
PICTURE_PX = 1400  # longer side of the inlined image
JPEG_QUALITY = 82
CASING_BGR, WAY_BGR = (36, 32, 28), (255, 255, 255)  # of the mission
# BGRA; blue, orange and crimson are distinguishable for the colour-blind, and blind is also the darkest.
COLOURS = {
    Sight.NO_MAP: (0, 0, 0, 0),
    Sight.BLIND: (92, 30, 170, 175),
    Sight.WEAK: (23, 154, 233, 140),
    Sight.SEES: (216, 114, 34, 70),
}
WORDS = {
    Sight.SEES: "sees: a frame is placed alone, in another season too",
    Sight.WEAK: "weak: while the ground looks as on the map",
    Sight.BLIND: "blind: water, bare ground, or a pattern that repeats itself",
}


def write_page(checked: CheckResult, out: Path) -> None:
    """Writes the page, or the picture alone if ``out`` is a PNG. Raises OutputError."""
    is_png = out.suffix.lower() == ".png"
    content = cv2.imencode(".png", picture(checked))[1].tobytes() if is_png else page(checked).encode()
    try:
        out.write_bytes(content)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); give another name") from None


def picture(checked: CheckResult) -> np.ndarray:
    """(h, w, 3) BGR: the map under the colours of its cells, and the mission."""
    e_min, n_min, e_max, n_max = checked.local.bounds_m
    gsd_m = max(e_max - e_min, n_max - n_min) / PICTURE_PX
    width, height = max(1, round((e_max - e_min) / gsd_m)), max(1, round((n_max - n_min) / gsd_m))
    image, valid = checked.local.window(e_min, n_max, width, height, gsd_m, checked.report.layer)
    image[~valid] = VOID_BGR
    cells = np.array([COLOURS[Sight(k)] for k in range(len(Sight))], np.uint8)[checked.grid.sight]
    covered = [math.ceil(count * checked.grid.step_m / gsd_m) for count in cells.shape[1::-1]]
    cells = cv2.resize(cells, covered, interpolation=cv2.INTER_NEAREST)[:height, :width]
    share = cells[:, :, 3:] / 255.0
    image = (image * (1.0 - share) + cells[:, :, :3] * share).astype(np.uint8)
    if checked.route is not None:
        way_px = np.round((checked.route.points_m - (e_min, n_max)) * (1 / gsd_m, -1 / gsd_m)).astype(np.int32)
        for colour, thickness in ((CASING_BGR, 7), (WAY_BGR, 3)):
            cv2.polylines(image, [way_px], False, colour, thickness, cv2.LINE_AA)
        cv2.circle(image, way_px[0].tolist(), 7, WAY_BGR, cv2.FILLED, cv2.LINE_AA)
    return image


def page(checked: CheckResult) -> str:
    report = checked.report
    name = Path(report.package).name
    head = kit.header("Map package", name, _headline(report))
    return kit.document(
        name, "", head, OWN.sight(jpeg_uri(picture(checked), JPEG_QUALITY), _colours()), kit.facts(lines_of(report))
    )


def _headline(report: MapCheck) -> str:
    mission = report.mission
    if mission is not None and mission.outside:
        return "The mission leaves this map."
    if mission is not None:
        return f"The mission stays on this map; fixes are to be expected on {mission.seen_share:.0%} of it."
    return f"{report.alone:.0%} of frames are expected to be placed alone, from {report.agl_m:.0f} m above ground."


def _colours() -> list[tuple[str, str]]:
    """CSS colour and meaning of each kind of ground."""
    bgra = [COLOURS[sight] for sight in WORDS]
    css = (f"rgba({red},{green},{blue},{alpha / 255:.2f})" for blue, green, red, alpha in bgra)
    return list(zip(css, WORDS.values(), strict=True))
