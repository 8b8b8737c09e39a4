"""The track over the map: a map window as an inlined JPEG, with vector layers on top."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

from terrafix.core.geodesy import LocalFrame
from terrafix_tools.estimates import Row
from terrafix_tools.pages.document import kit
from terrafix_tools.pages.pictures import VOID_BGR, jpeg_uri
from terrafix_tools.pages.series import thin_path
from terrafix_tools.report.data import FlightView, ellipse95
from terrafix_tools.report.map_crop import open_map

WIDTH_PX = 1280  # of the inlined image: sharp on a laptop, about 300 kB
MARGIN = 0.12  # margin around the track, as a share of its extent
MIN_SPAN_M = 160.0  # least extent, so that a hovering flight shows some ground
ASPECT = (1.25, 2.0)  # smallest and largest aspect ratio (width over height)
JPEG_QUALITY = 80
ELLIPSE_SPACING = 1.1  # spacing of ellipses in units of their length, so that they do not hide the track
MIN_SPACING_PX = 24.0
MIN_STEP_PX = 0.7  # of a track
SCALE_BAR_SHARE = 0.22  # largest length, as a share of the image width


@dataclass(frozen=True)
class MapImage:
    """Georeference of the image: metres per pixel and the north-west corner in local metres."""

    frame: LocalFrame
    e_min_m: float
    n_max_m: float
    width_px: int
    height_px: int
    gsd_m: float

    def pixel(self, lat_deg: float, lon_deg: float) -> tuple[float, float]:
        e_m, n_m = self.frame.to_local(lat_deg, lon_deg)
        return (e_m - self.e_min_m) / self.gsd_m, (self.n_max_m - n_m) / self.gsd_m


def map_svg(view: FlightView, map_path: Path | None, marked: list[int], pointed: list[int]) -> str:
    """Returns the <svg>; without a readable map the tracks are drawn on a plain background.

    ``marked``: rows of the worst moments, drawn as numbers from 1. ``pointed``: rows that the pointer finds."""
    points = [(r.lat_deg, r.lon_deg) for r in view.rows if r.lat_deg is not None and r.lon_deg is not None]
    points += [(t.lat_deg, t.lon_deg) for t in view.truth_track]
    if not points and view.origin is not None:
        points = [(view.origin.lat_deg, view.origin.lon_deg)]
    if not points:
        return kit.quiet("No position in this record.")
    map_image = _map_image(points)
    u = map_image.width_px / 1000  # unit of line widths, constant across image sizes
    body = [
        _ground(map_image, map_path),
        _ellipses(view, map_image),
        _estimates(view, map_image),
        _tracks(view, map_image),
        _frame_dots(view, map_image, u, pointed),
        _end_labels(view, map_image, u),
        _numbers(view, map_image, u, marked),
        _scale_bar(map_image, u),
        '<circle id="here" r="0"/>',
    ]
    return Markup(
        f'<svg id="map" viewBox="0 0 {map_image.width_px} {map_image.height_px}" style="--u:{u:.3f}px" role="img" '
        f'aria-label="Track over the map">{"".join(body)}</svg>'
    )


def _map_image(points: list[tuple[float, float]]) -> MapImage:
    frame = LocalFrame(*points[0])
    local = np.array([frame.to_local(*p) for p in points])
    low, high = local.min(axis=0), local.max(axis=0)
    centre, span = (low + high) / 2, np.maximum(high - low, MIN_SPAN_M) * (1 + 2 * MARGIN)
    width_m, height_m = float(span[0]), float(span[1])
    width_m = max(width_m, height_m * ASPECT[0])
    height_m = max(height_m, width_m / ASPECT[1])
    gsd_m = width_m / WIDTH_PX
    return MapImage(
        frame,
        float(centre[0]) - width_m / 2,
        float(centre[1]) + height_m / 2,
        WIDTH_PX,
        round(height_m / gsd_m),
        gsd_m,
    )


def _ground(map_image: MapImage, map_path: Path | None) -> str:
    size = f'width="{map_image.width_px}" height="{map_image.height_px}"'
    opened = open_map(map_path, map_image.frame)
    if opened is None:
        return f'<rect class="void" {size}/>'
    package, local = opened
    image, valid = local.window(
        map_image.e_min_m, map_image.n_max_m, map_image.width_px, map_image.height_px, map_image.gsd_m
    )
    package.close()
    image[~valid] = VOID_BGR
    return f'<image class="ground" {size} href="{jpeg_uri(image, JPEG_QUALITY)}"/>'


def _xy(row: Row, map_image: MapImage) -> tuple[float, float] | None:
    if row.lat_deg is None or row.lon_deg is None:
        return None
    return map_image.pixel(row.lat_deg, row.lon_deg)


def _line(points: list[tuple[float, float]], css: str) -> str:
    points = thin_path(points, MIN_STEP_PX)
    text = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline class="{css}" points="{text}"/>'


def _ellipses(view: FlightView, map_image: MapImage) -> str:
    parts = []
    last, previous_a_px = (-math.inf, -math.inf), 0.0
    for row in view.rows:
        point, axes = _xy(row, map_image), ellipse95(row)
        if point is None or axes is None:
            continue
        a, b, angle = axes
        spacing_px = max(MIN_SPACING_PX, ELLIPSE_SPACING * (previous_a_px + a / map_image.gsd_m))
        if math.dist(point, last) < spacing_px:
            continue
        last, previous_a_px = point, a / map_image.gsd_m
        # SVG's y axis points down, so an angle towards north has the opposite sign.
        parts.append(
            f'<ellipse rx="{a / map_image.gsd_m:.1f}" ry="{b / map_image.gsd_m:.1f}" '
            f'transform="translate({point[0]:.1f} {point[1]:.1f}) rotate({-math.degrees(angle):.1f})"/>'
        )
    return f'<g class="layer ellipses">{"".join(parts)}</g>'


def _tracks(view: FlightView, map_image: MapImage) -> str:
    """The refined and the finalised track, and that of the truth on top."""
    refined = [
        (r.refined_lat_deg, r.refined_lon_deg)
        for r in view.rows
        if r.refined_lat_deg is not None and r.refined_lon_deg is not None
    ]
    truth = [(t.lat_deg, t.lon_deg) for t in view.truth_track]
    parts = []
    for css, places in (("refined", refined), ("finalised", view.finalised), ("truth", truth)):
        points = [map_image.pixel(*place) for place in places]
        if points:
            parts.append(f'<g class="layer {css}">{_line(points, "casing")}{_line(points, "")}</g>')
    return "".join(parts)


def _estimates(view: FlightView, map_image: MapImage) -> str:
    """Track segments of one source label; a frame without position interrupts the track."""
    casing: list[str] = []
    segments: list[str] = []
    run: list[tuple[float, float]] = []
    label = ""
    for row in view.rows:
        point = _xy(row, map_image)
        if point is None or row.source_label != label:
            if run and point is not None:
                run.append(point)  # the new segment begins where the previous one ends
            if len(run) > 1:
                casing.append(_line(run, "casing"))
                segments.append(_line(run, f"l-{label}"))
            run, label = [], row.source_label
        if point is not None:
            run.append(point)
    if len(run) > 1:
        casing.append(_line(run, "casing"))
        segments.append(_line(run, f"l-{label}"))
    return f'<g class="layer estimates">{"".join(casing)}{"".join(segments)}</g>'


def _frame_dots(view: FlightView, map_image: MapImage, u: float, pointed: list[int]) -> str:
    """Dots of frames, the targets of the pointer."""
    parts = []
    for i in pointed:
        row = view.rows[i]
        if (point := _xy(row, map_image)) is not None:
            parts.append(
                f'<circle class="f-{row.source_label}" data-i="{i}" cx="{point[0]:.1f}" '
                f'cy="{point[1]:.1f}" r="{2.2 * u:.1f}"/>'
            )
    return f'<g class="layer dots">{"".join(parts)}</g>'


def _end_labels(view: FlightView, map_image: MapImage, u: float) -> str:
    located = [point for row in view.rows if (point := _xy(row, map_image)) is not None]
    if not located:
        return ""
    parts = []
    for (x, y), text in ((located[0], "start"), (located[-1], "end")):
        side = 1 if text == "start" else -1
        parts.append(
            f'<g class="end" transform="translate({x:.1f} {y:.1f})"><circle r="{6 * u:.1f}"/>'
            f'<text x="{side * 11 * u:.1f}" y="{(-9 if side > 0 else 17) * u:.1f}" '
            f'text-anchor="{"start" if side > 0 else "end"}">{text}</text></g>'
        )
    return "".join(parts)


def _numbers(view: FlightView, map_image: MapImage, u: float, marked: list[int]) -> str:
    parts = []
    for number, i in enumerate(marked, 1):
        if (point := _xy(view.rows[i], map_image)) is not None:
            parts.append(
                f'<a href="#moment-{number}"><g transform="translate({point[0]:.1f} {point[1]:.1f})">'
                f'<circle r="{10 * u:.1f}"/><text y="{4.4 * u:.1f}" text-anchor="middle">{number}</text></g></a>'
            )
    return f'<g class="layer worst-marks">{"".join(parts)}</g>' if parts else ""


def _scale_bar(map_image: MapImage, u: float) -> str:
    room_m = map_image.width_px * map_image.gsd_m * SCALE_BAR_SHARE
    power = 10 ** math.floor(math.log10(room_m))
    length_m = max(step * power for step in (1, 2, 5) if step * power <= room_m)
    x, y, width = 20 * u, map_image.height_px - 20 * u, length_m / map_image.gsd_m
    text = f"{length_m / 1000:g} km" if length_m >= 1000 else f"{length_m:g} m"
    path = f"M{x:.1f} {y - 6 * u:.1f} v{6 * u:.1f} h{width:.1f} v{-6 * u:.1f}"
    return (
        f'<g class="scale"><path class="casing" d="{path}"/><path d="{path}"/>'
        f'<text x="{x + width / 2:.1f}" y="{y - 10 * u:.1f}" text-anchor="middle">{text}</text></g>'
    )
