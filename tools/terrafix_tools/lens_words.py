"""What a flight has learnt of its lens, in words for whoever can calibrate it."""

import numpy as np

from terrafix.core.camera import bent, straightened
from terrafix.core.gate import GATE
from terrafix.estimator.measurements.principal_point import PrincipalPointFilter
from terrafix.messages import Camera, SlowErrors

LENS = 4  # of SlowErrors.error
SURE = 3.0  # sigmas
LEAST_SHARE = (
    0.01  # of the width, by which the corner is bent, or the middle aside: below it nobody would find the lens at fault
)


def lens_words(camera: Camera, learnt: SlowErrors) -> str | None:
    """A sentence or two; None when the lens is as its description says, as far as the flight could tell."""
    return " ".join(said for said in (_bend(camera, learnt), _middle(camera, learnt)) if said) or None


def _middle(camera: Camera, learnt: SlowErrors) -> str:
    found = PrincipalPointFilter(camera, learnt.lens)
    px = found.offset * (camera.fx, camera.fy)
    sigma_px = np.sqrt(np.diag(found.cov)) * (camera.fx, camera.fy)
    if not found.offset.any() or found.offset @ np.linalg.solve(found.cov, found.offset) < GATE[2]:
        return ""
    if np.hypot(*px) < LEAST_SHARE * camera.width:
        return ""
    cx, cy = camera.cx + px[0], camera.cy + px[1]
    return (
        f"The middle of its picture seems to be at {cx:.0f}, {cy:.0f} px (+- {sigma_px[0]:.0f}, {sigma_px[1]:.0f}); "
        f"that is in the positions. Calibrate it, or write cx = {cx:.0f} and cy = {cy:.0f} into [camera]."
    )


def _bend(camera: Camera, learnt: SlowErrors) -> str:
    bend = learnt.error[LENS]
    n = len(learnt.error)
    sigma = float(np.sqrt(learnt.cov[LENS * n + LENS]))
    corner = float(
        np.hypot(
            max(camera.cx, camera.width - camera.cx) / camera.fx, max(camera.cy, camera.height - camera.cy) / camera.fy
        )
    )
    seen = np.column_stack([np.linspace(0.1, 1.0, 10) * corner, np.zeros(10)])
    straight = straightened(seen, bend)
    off_px = float(np.abs(straight - seen).max()) * camera.fx
    if abs(bend) < SURE * sigma or off_px < LEAST_SHARE * camera.width:
        return ""
    if camera.distortion:
        said, todo = "more than its distortion says", "calibrate it again"
    else:
        said = "and flight.toml states no distortion"
        # A distortion that is stated says that somebody has calibrated the focal length as well.
        todo = f"calibrate it, or write {_distortion(straight, bend)} and focal_sigma = {camera.focal_sigma:g}"
        todo += " into [camera]"
    return (
        f"The lens seems to bend by k1 = {bend:+.2f} (+- {sigma:.2f}), {off_px:.0f} px at the corner, {said}: {todo}."
    )


def _distortion(straight: np.ndarray, bend: float) -> str:
    """The same in OpenCV's terms (k1 k2 p1 p2 k3), as near as they come out to the corner."""
    r = straight[:, 0]
    ratio = bent(straight, bend)[:, 0] / r - 1.0
    k1, k2, k3 = np.linalg.lstsq(r[:, None] ** [2, 4, 6], ratio, rcond=None)[0]
    return f"distortion = [{k1:.4f}, {k2:.4f}, 0.0, 0.0, {k3:.4f}]"
