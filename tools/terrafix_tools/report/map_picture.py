"""The track over the map: a window of the map as an inlined JPEG, and everything else as vectors on it."""

import base64
import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from terrafix.core.errors import MapError
from terrafix.core.geodesy import LocalFrame
from terrafix.map.package import MapPackage
from terrafix_tools.estimates import Row
from terrafix_tools.report.data import FlightView, ellipse95

WIDTH_PX = 1280  # of the inlined picture: sharp on a laptop, about 300 kB
MARGIN = 0.12  # of the track's extent, around it
MIN_SPAN_M = 160.0  # a hovering flight still gets some ground around it
ASPECT = (1.25, 2.0)  # narrowest and widest picture (width over height)
JPEG_QUALITY = 80
VOID_BGR = (226, 230, 230)  # where the map has nothing
ELLIPSE_SPACING = 1.1  # distance of ellipses in their own lengths: they tile the track and do not hide it
SMALLEST_SPACING_PX = 24.0
SCALE_BAR_SHARE = 0.22  # of the picture's width, at most
LABELS = ("satellite_anchored", "visual_propagated", "dead_reckoned")


@dataclass(frozen=True)
class Picture:
    """Pixels per metre and the corner of the picture in local metres."""

    frame: LocalFrame
    e_min_m: float
    n_max_m: float
    width_px: int
    height_px: int
    gsd_m: float

    def at(self, lat_deg: float, lon_deg: float) -> tuple[float, float]:
        e_m, n_m = self.frame.to_local(lat_deg, lon_deg)
        return (e_m - self.e_min_m) / self.gsd_m, (self.n_max_m - n_m) / self.gsd_m


def map_svg(view: FlightView, map_path: Path | None) -> str:
    """The whole <svg>; without a map, or with one that cannot be read, the tracks stand on a plain ground."""
    points = [(r.lat_deg, r.lon_deg) for r in view.rows if r.lat_deg is not None and r.lon_deg is not None]
    points += [(t.lat_deg, t.lon_deg) for t in view.truth_track]
    if not points and view.origin is not None:
        points = [(view.origin.lat_deg, view.origin.lon_deg)]
    if not points:
        return '<p class="quiet">No position in this record.</p>'
    picture = _picture(points)
    u = picture.width_px / 1000  # line widths stay the same on every picture
    body = [
        _ground(picture, map_path),
        _ellipses(view, picture),
        _estimates(view, picture),
        _refined(view, picture),
        _finalised(view, picture),
        _truth(view, picture),
        _dots(view, picture, u),
        _ends(view, picture, u),
        _scale_bar(picture, u),
        '<circle id="here" r="0"/>',
    ]
    return (
        f'<svg id="map" viewBox="0 0 {picture.width_px} {picture.height_px}" style="--u:{u:.3f}px" role="img" '
        f'aria-label="Track over the map">{"".join(body)}</svg>'
    )


def _picture(points: list[tuple[float, float]]) -> Picture:
    frame = LocalFrame(*points[0])
    local = np.array([frame.to_local(*p) for p in points])
    low, high = local.min(axis=0), local.max(axis=0)
    middle, span = (low + high) / 2, np.maximum(high - low, MIN_SPAN_M) * (1 + 2 * MARGIN)
    width_m, height_m = float(span[0]), float(span[1])
    width_m = max(width_m, height_m * ASPECT[0])
    height_m = max(height_m, width_m / ASPECT[1])
    gsd_m = width_m / WIDTH_PX
    return Picture(
        frame,
        float(middle[0]) - width_m / 2,
        float(middle[1]) + height_m / 2,
        WIDTH_PX,
        round(height_m / gsd_m),
        gsd_m,
    )


def _ground(picture: Picture, map_path: Path | None) -> str:
    size = f'width="{picture.width_px}" height="{picture.height_px}"'
    if map_path is None:
        return f'<rect class="void" {size}/>'
    try:
        package = MapPackage.open(map_path)
    except MapError:
        return f'<rect class="void" {size}/>'
    local = package.bind(picture.frame)
    image, valid = local.window(picture.e_min_m, picture.n_max_m, picture.width_px, picture.height_px, picture.gsd_m)
    package.close()
    image[~valid] = VOID_BGR
    _, coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    uri = base64.b64encode(bytes(coded)).decode()
    return f'<image class="ground" {size} href="data:image/jpeg;base64,{uri}"/>'


def _xy(row: Row, picture: Picture) -> tuple[float, float] | None:
    if row.lat_deg is None or row.lon_deg is None:
        return None
    return picture.at(row.lat_deg, row.lon_deg)


def _line(points: list[tuple[float, float]], css: str) -> str:
    text = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline class="{css}" points="{text}"/>'


def _ellipses(view: FlightView, picture: Picture) -> str:
    parts = []
    last, reach_px = (-math.inf, -math.inf), 0.0
    for row in view.rows:
        place, axes = _xy(row, picture), ellipse95(row)
        if place is None or axes is None:
            continue
        a, b, angle = axes
        spacing_px = max(SMALLEST_SPACING_PX, ELLIPSE_SPACING * (reach_px + a / picture.gsd_m))
        if math.dist(place, last) < spacing_px:
            continue
        last, reach_px = place, a / picture.gsd_m
        # SVG's y points down, so an angle towards north turns the other way.
        parts.append(
            f'<ellipse rx="{a / picture.gsd_m:.1f}" ry="{b / picture.gsd_m:.1f}" '
            f'transform="translate({place[0]:.1f} {place[1]:.1f}) rotate({-math.degrees(angle):.1f})"/>'
        )
    return f'<g class="layer ellipses">{"".join(parts)}</g>'


def _truth(view: FlightView, picture: Picture) -> str:
    if not view.truth_track:
        return ""
    points = [picture.at(t.lat_deg, t.lon_deg) for t in view.truth_track]
    return f'<g class="layer truth">{_line(points, "casing")}{_line(points, "")}</g>'


def _refined(view: FlightView, picture: Picture) -> str:
    points = [
        picture.at(r.refined_lat_deg, r.refined_lon_deg)
        for r in view.rows
        if r.refined_lat_deg is not None and r.refined_lon_deg is not None
    ]
    return f'<g class="layer refined">{_line(points, "casing")}{_line(points, "")}</g>' if points else ""


def _finalised(view: FlightView, picture: Picture) -> str:
    points = [picture.at(*at) for at in view.finalised]
    return f'<g class="layer finalised">{_line(points, "casing")}{_line(points, "")}</g>' if points else ""


def _estimates(view: FlightView, picture: Picture) -> str:
    """The track in pieces of one source label; a frame without position breaks it."""
    casing: list[str] = []
    pieces: list[str] = []
    run: list[tuple[float, float]] = []
    label = ""
    for row in view.rows:
        place = _xy(row, picture)
        if place is None or row.source_label != label:
            if run and place is not None:
                run.append(place)  # the new piece begins where the old one ends
            if len(run) > 1:
                casing.append(_line(run, "casing"))
                pieces.append(_line(run, f"l-{label}"))
            run, label = [], row.source_label
        if place is not None:
            run.append(place)
    if len(run) > 1:
        casing.append(_line(run, "casing"))
        pieces.append(_line(run, f"l-{label}"))
    return f'<g class="layer estimates">{"".join(casing)}{"".join(pieces)}</g>'


def _dots(view: FlightView, picture: Picture, u: float) -> str:
    """One dot a frame; what the pointer finds."""
    parts = []
    for i, row in enumerate(view.rows):
        if (place := _xy(row, picture)) is not None:
            parts.append(
                f'<circle class="f-{row.source_label}" data-i="{i}" cx="{place[0]:.1f}" '
                f'cy="{place[1]:.1f}" r="{2.2 * u:.1f}"/>'
            )
    return f'<g class="layer dots">{"".join(parts)}</g>'


def _ends(view: FlightView, picture: Picture, u: float) -> str:
    located = [place for row in view.rows if (place := _xy(row, picture)) is not None]
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


def _scale_bar(picture: Picture, u: float) -> str:
    room_m = picture.width_px * picture.gsd_m * SCALE_BAR_SHARE
    power = 10 ** math.floor(math.log10(room_m))
    length_m = max(step * power for step in (1, 2, 5) if step * power <= room_m)
    x, y, width = 20 * u, picture.height_px - 20 * u, length_m / picture.gsd_m
    text = f"{length_m / 1000:g} km" if length_m >= 1000 else f"{length_m:g} m"
    path = f"M{x:.1f} {y - 6 * u:.1f} v{6 * u:.1f} h{width:.1f} v{-6 * u:.1f}"
    return (
        f'<g class="scale"><path class="casing" d="{path}"/><path d="{path}"/>'
        f'<text x="{x + width / 2:.1f}" y="{y - 10 * u:.1f}" text-anchor="middle">{text}</text></g>'
    )
