"""Pictures of a moment: the frame with its matches, and the map around the estimate at the same scale and heading."""

import math
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from terrafix.core.camera import CameraCalibration
from terrafix.core.geodesy import LocalFrame
from terrafix.map.package import LocalMap
from terrafix.messages import Origin
from terrafix_tools.estimates import Row
from terrafix_tools.evaluate import Truth
from terrafix_tools.pages.pictures import data_uri
from terrafix_tools.report.data import ellipse95
from terrafix_tools.report.map_crop import Crop, crop_around, picture
from terrafix_tools.report.moment_geometry import (
    Matches,
    Pose,
    calibration_of,
    estimated_pose,
    footprint,
    matched_pose,
    matches_of,
)
from terrafix_tools.report.moment_record import FrameRecord

MIN_RATIO, MAX_RATIO = 0.5, 4.0  # bounds of the ratio of the widths of map and frame on the page


@dataclass(frozen=True)
class Pictures:
    """``frame``: SVG, empty without a picture and without matches. ``ground``: SVG, or "" without an estimate.
    ``ratio``: width of ``ground`` over that of ``frame`` at the same scale."""

    frame: str
    ground: str
    ratio: float
    has_map: bool
    matches: Matches | None
    shows_rejected: bool  # the dashed footprint of a map match that was not used


def pictures(
    record: FrameRecord, jpeg: bytes | None, origin: Origin, row: Row, truth: Truth | None, local: LocalMap | None
) -> Pictures:
    """``row``: the estimate of that frame, whose 95 % ellipse is drawn."""
    camera, matches, pose = calibration_of(origin, record.match), matches_of(record), estimated_pose(record, origin)
    frame = _frame(jpeg, camera, matches, pose)
    if pose is None:
        return Pictures(frame, "", 1.0, False, matches, False)
    border_m = footprint(pose, camera)
    crop = crop_around(border_m, pose.p_m[:2], pose.heading_rad)
    matched = matched_pose(record, pose.ground_m)
    rejected = matched if not any(v.measurement == "map" and v.verdict == "accepted" for v in record.verdicts) else None
    uri = picture(crop, local) if local is not None else None
    parts = [_image(uri, crop.width_px, crop.height_px), _polygon(crop.xy(border_m), "foot")]
    if rejected is not None:
        parts.append(_polygon(crop.xy(footprint(rejected, camera)), "foot other"))
    if matches is not None:
        parts += _marks(crop.xy(pose.ground(matches.xy)), crop.xy(matches.points_m[:, :2]), matches.inlier)
    if record.estimate is not None:
        parts.append(_ellipse(row, pose, crop))
    if truth is not None:
        e_m, n_m = LocalFrame(origin.lat_deg, origin.lon_deg).to_local(truth.lat_deg, truth.lon_deg)
        x, y = crop.xy(np.array([[e_m, n_m]]))[0]
        parts.append(f'<path class="true" d="M{x - 7:.1f} {y:.1f}h14M{x:.1f} {y - 7:.1f}v14"/>')
    parts.append(_north(crop))
    ground = _svg(crop.width_px, crop.height_px, "Map around the estimate", parts)
    centre = np.array([[0.0, 0.0]])
    range_m = float(np.linalg.norm([*(pose.ground(centre)[0] - pose.p_m[:2]), pose.agl_m]))
    ratio = crop.width_px * crop.gsd_m / (camera.width * range_m / camera.fx)
    return Pictures(
        frame, ground, min(MAX_RATIO, max(MIN_RATIO, ratio)), uri is not None, matches, rejected is not None
    )


def _frame(jpeg: bytes | None, camera: CameraCalibration, matches: Matches | None, pose: Pose | None) -> str:
    """Marks at the matched points; lines to where the estimate puts their places on the map."""
    uri = data_uri("image/jpeg", jpeg) if jpeg is not None else None
    parts = [_image(uri, camera.width, camera.height)]
    if matches is not None:
        seen = camera.project(np.column_stack([matches.xy, np.ones(len(matches.xy))]))
        expected = np.full_like(seen, np.nan)
        if pose is not None:
            xy = pose.seen(matches.points_m)
            visible = np.isfinite(xy).all(axis=1)
            expected[visible] = camera.project(np.column_stack([xy[visible], np.ones(int(visible.sum()))]))
        parts += _marks(seen + 0.5, expected + 0.5, matches.inlier)  # pixel 0 spans 0 to 1 in SVG
    return _svg(camera.width, camera.height, "Frame with its matches", parts)


def _marks(points: np.ndarray, others: np.ndarray, inlier: np.ndarray | None) -> list[str]:
    """Dots at ``points`` (N, 2) and lines from them to ``others`` (N, 2), by class; no line to NaN."""
    everyone = [("unknown", np.ones(len(points), bool))]
    groups = everyone if inlier is None else [("outlier", ~inlier), ("inlier", inlier)]
    parts = []
    for css, which in groups:
        pairs = np.column_stack([points, others])[which]
        lines = "".join(
            f"M{x:.0f} {y:.0f}L{u:.0f} {v:.0f}" for x, y, u, v in pairs if math.isfinite(u) and math.isfinite(v)
        )
        dots = "".join(f"M{x:.0f} {y:.0f}h0" for x, y, _, _ in pairs)
        parts.append(f'<path class="pairs {css}" d="{lines}"/><path class="ends {css}" d="{dots}"/>')
    return parts


def _ellipse(row: Row, pose: Pose, crop: Crop) -> str:
    x, y = crop.xy(pose.p_m[None, :2])[0]
    mark = f'<circle class="at" cx="{x:.1f}" cy="{y:.1f}" r="5"/>'
    shape = ellipse95(row)
    if shape is None:
        return mark
    a_m, b_m, angle_rad = shape
    # SVG turns clockwise; the picture is turned by the heading.
    turn_deg = -math.degrees(angle_rad + crop.heading_rad)
    return (
        f'<ellipse class="claim" rx="{a_m / crop.gsd_m:.1f}" ry="{b_m / crop.gsd_m:.1f}" '
        f'transform="translate({x:.1f} {y:.1f}) rotate({turn_deg:.1f})"/>{mark}'
    )


def _north(crop: Crop) -> str:
    x, y = crop.width_px - 46, 46
    turn_deg = -math.degrees(crop.heading_rad)
    return (
        f'<g class="north" transform="translate({x} {y}) rotate({turn_deg:.1f})"><path d="M0 14V-14M-6 -6L0 -14L6 -6"/>'
        '<text y="-19" text-anchor="middle">N</text></g>'
    )


def _polygon(points: np.ndarray, css: str) -> str:
    return f'<polygon class="{css}" points="{" ".join(f"{x:.1f},{y:.1f}" for x, y in points)}"/>'


def _image(uri: str | None, width: int, height: int) -> str:
    size = f'width="{width}" height="{height}"'
    return f'<image class="ground" {size} href="{uri}"/>' if uri else f'<rect class="void" {size}/>'


def _svg(width: int, height: int, label: str, parts: list[str]) -> str:
    return Markup(
        f'<svg class="shot" viewBox="0 0 {width} {height}" role="img" aria-label="{label}">{"".join(parts)}</svg>'
    )
