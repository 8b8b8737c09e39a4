"""A self-contained HTML page about a map package: the image, its matchability, and the mission."""

from pathlib import Path

import cv2
import numpy as np
from markupsafe import Markup

from terrafix.core.errors import OutputError
from terrafix_tools.mapping.check.sight import Sight
from terrafix_tools.mapping.check.suitability import CheckResult, MapCheck
from terrafix_tools.mapping.check.text import lines_of
from terrafix_tools.pages.document import kit, macros
from terrafix_tools.pages.pictures import VOID_BGR, data_uri, jpeg_uri

OWN = macros("terrafix_tools/package.html")
PICTURE_PX = 1400  # longer side of the inlined image
JPEG_QUALITY = 82
# BGRA; blue, orange and crimson are distinguishable for the colour-blind, and blind is also the darkest.
COLOURS = {
    Sight.NO_MAP: (0, 0, 0, 0),
    Sight.BLIND: (92, 30, 170, 175),
    Sight.WEAK: (23, 154, 233, 140),
    Sight.SEES: (216, 114, 34, 70),
}
WORDS = {
    Sight.SEES: "sees: fixes come",
    Sight.WEAK: "weak: fixes come now and then",
    Sight.BLIND: "blind: water, bare ground, or a pattern that repeats itself",
}


def write_page(checked: CheckResult, out: Path) -> None:
    """Writes the page. Raises OutputError."""
    try:
        out.write_text(page(checked), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); give another name") from None


def page(checked: CheckResult) -> str:
    report = checked.report
    name = Path(report.package).name
    head = kit.header("Map package", name, _headline(report))
    return kit.document(name, "", head, OWN.sight(_svg(checked), _colours()), kit.facts(lines_of(report)))


def _headline(report: MapCheck) -> str:
    mission = report.mission
    if mission is not None and mission.outside:
        return "The mission leaves this map."
    if mission is not None:
        return f"The mission stays on this map; fixes are to be expected on {mission.seen_share:.0%} of it."
    return (
        f"Fixes are to be expected over {report.sees + report.weak:.0%} of it, from {report.agl_m:.0f} m above ground."
    )


def _svg(checked: CheckResult) -> str:
    e_min, n_min, e_max, n_max = checked.local.bounds_m
    gsd_m = max(e_max - e_min, n_max - n_min) / PICTURE_PX
    width, height = max(1, round((e_max - e_min) / gsd_m)), max(1, round((n_max - n_min) / gsd_m))
    image, valid = checked.local.window(e_min, n_max, width, height, gsd_m, checked.report.layer)
    image[~valid] = VOID_BGR
    ground = jpeg_uri(image, JPEG_QUALITY)
    table = np.array([COLOURS[Sight(k)] for k in range(len(Sight))], np.uint8)
    overlay = data_uri("image/png", cv2.imencode(".png", table[checked.grid.sight])[1].tobytes())
    cells_h, cells_w = checked.grid.sight.shape
    side = checked.grid.step_m / gsd_m
    body = [
        f'<image width="{width}" height="{height}" href="{ground}"/>',
        f'<image class="sight" width="{cells_w * side:.1f}" height="{cells_h * side:.1f}" '
        f'preserveAspectRatio="none" href="{overlay}"/>',
        _mission(checked, e_min, n_max, gsd_m),
    ]
    size = f"0 0 {width} {height}"
    return Markup(
        f'<svg class="package" viewBox="{size}" role="img" aria-label="The map, north up">{"".join(body)}</svg>'
    )


def _mission(checked: CheckResult, e_min_m: float, n_max_m: float, gsd_m: float) -> str:
    if checked.route is None:
        return ""
    xy = (checked.route.points_m - (e_min_m, n_max_m)) * (1 / gsd_m, -1 / gsd_m)
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in xy)
    x, y = xy[0]
    return (
        f'<polyline class="casing" points="{line}"/><polyline class="way" points="{line}"/>'
        f'<circle class="way" cx="{x:.1f}" cy="{y:.1f}" r="7"/>'
    )


def _colours() -> list[tuple[str, str]]:
    """CSS colour and meaning of each kind of ground."""
    found = []
    for sight, words in WORDS.items():
        blue, green, red, alpha = COLOURS[sight]
        found.append((f"rgba({red},{green},{blue},{alpha / 255:.2f})", words))
    return found
