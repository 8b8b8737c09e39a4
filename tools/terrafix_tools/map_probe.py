"""Which factor of the height (or focal length), or which turn of the heading, makes the first frames fit the map about
the start: asked of a flight that found nothing, when no monitor has measured it."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from terrafix.anchor.matching.frame_matcher import (
    AS_PREDICTED,
    FrameMatcher,
    Hypothesis,
    View,
    view_at,
)
from terrafix.core.camera import CameraCalibration, Mount
from terrafix.core.geodesy import LocalFrame, rot_w_b
from terrafix.map.package import MapPackage
from terrafix.messages import Origin
from terrafix.vision.sources.contract import Shot
from terrafix_engines.features.gradient import GradientDescriber

FRAMES = 5  # the first ones, which are still about the start
REACH_M = 80.0  # half of the window beside three sigmas of the start: a few seconds of flight
MAX_START_SIGMA_M = 100.0  # of a start about which a window is small enough
SCALE_STEP, SCALE_STEPS = 1.1, 14  # of the height, to 3.8 times and the inverse; gradients fit within 5 %
YAW_STEP_DEG = 8.0  # gradients fit within 4 degrees
# Highest standardised correlation of a frame at the right factor; at 24 wrong ones of four frames it was 4.6 at most,
# at the right one 7.3 and 5.4. [measured: photos of a generated copter, 480 px, twice the focal length]
MIN_SCORE = 6.0
MIN_AGREEING = 2  # frames whose own best factor is the same to a step


@dataclass(frozen=True)
class _Window:
    """Candidate positions about the start; a SearchWindow."""

    half_m: float
    centre: tuple[float, float] = (0.0, 0.0)


def likely_factor(shots: Iterable[Shot], origin: Origin, package: Path) -> str:
    """The factor or turn in words; empty where none stands out, or heading, height or start are not stated."""
    if not origin.start_sigma_m <= MAX_START_SIGMA_M:
        return ""
    views = [view for shot in islice(shots, FRAMES) if (view := reported_view(shot, origin)) is not None]
    opened = MapPackage.open(package)
    try:
        local = opened.bind(LocalFrame(origin.lat_deg, origin.lon_deg))
        matcher = FrameMatcher(CameraCalibration.of(origin.camera), local, GradientDescriber())
        window = _Window(REACH_M + 3.0 * origin.start_sigma_m)
        scales = [SCALE_STEP**k for k in range(-SCALE_STEPS, SCALE_STEPS + 1)]
        best = best_index(
            [[_score(matcher, i, v, window, Hypothesis(0.0, s)) for s in scales] for i, v in views], wraps=False
        )
        if best is not None and not math.isclose(scales[best], 1.0, abs_tol=SCALE_STEP - 1.0):
            scale = scales[best]
            factors = f"{1.0 / scale:.2g} times the true one, or the focal length {scale:.2g} times"
            return f"the height is some {factors}: so the first frames fit the map"
        turns = np.arange(0.0, 360.0, YAW_STEP_DEG)
        scores = [[_score(matcher, i, v, window, Hypothesis(math.radians(t), 1.0)) for t in turns] for i, v in views]
        best = best_index(scores, wraps=True)
        if best is not None and YAW_STEP_DEG < turns[best] < 360.0 - YAW_STEP_DEG:
            # a hypothesis turns the camera counter-clockwise, a heading counts clockwise
            off_deg = math.remainder(float(turns[best]), 360.0)
            where = f"the heading, or the yaw of the mount, is off by some {off_deg:+.0f} degrees"
            return f"{where}: so the first frames fit the map"
        return ""
    finally:
        opened.close()


def reported_view(shot: Shot, origin: Origin) -> tuple[np.ndarray, View] | None:
    """Image and reported camera of a frame over the start, without sigmas; None: something is not stated."""
    yaw_rad = next((s.yaw_rad for s in reversed(shot.states) if s.yaw_rad is not None), None)
    agl_m = next((s.agl_m for s in reversed(shot.states) if s.agl_m is not None), None)
    if shot.image is None or yaw_rad is None or agl_m is None or agl_m <= 0.0:
        return None
    tilted = next((s for s in reversed(shot.states) if s.roll_rad is not None and s.pitch_rad is not None), None)
    pitch_rad, roll_rad = (0.0, 0.0) if tilted is None else (tilted.pitch_rad or 0.0, tilted.roll_rad or 0.0)
    r_w_c = rot_w_b(yaw_rad, pitch_rad, roll_rad) @ Mount.of(origin.camera).r_b_c()
    view = View(0.0, 0.0, r_w_c, agl_m, origin.ground_amsl_m or 0.0, 0.0, 0.0, 0.0)
    return shot.image, view


def _score(matcher: FrameMatcher, grey: np.ndarray, view: View, window: _Window, hypothesis: Hypothesis) -> float:
    """Highest standardised correlation of a frame in the window; 0 where it cannot be correlated."""
    turned = view_at(view, hypothesis, view.e_m, view.n_m)
    pyramid, gsd_m = matcher.pyramid(grey, matcher.gradients), matcher.correlation_cell_m(turned.agl_m)
    found = matcher.correlate_on(pyramid, turned, window, (AS_PREDICTED,), gsd_m)
    return max((float(np.nan_to_num(surface.z, nan=-np.inf).max()) for surface in found.surfaces), default=0.0)


def best_index(scores: list[list[float]], *, wraps: bool) -> int | None:
    """Index of the factor at which a frame correlates best, if MIN_AGREEING frames say so; ``wraps``: the last factor
    is beside the first."""
    peaks = [int(np.argmax(row)) for row in scores]
    highest = max(range(len(peaks)), key=lambda i: scores[i][peaks[i]], default=None)
    if highest is None or scores[highest][peaks[highest]] < MIN_SCORE:
        return None
    count = len(scores[0])
    steps = [abs(peak - peaks[highest]) for peak in peaks]
    near = [min(step, count - step) if wraps else step for step in steps]
    return peaks[highest] if sum(step <= 1 for step in near) >= MIN_AGREEING else None
