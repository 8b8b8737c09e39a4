"""Hints and user fixes of an operator as the PositionHint that the nodes know."""

import math
from collections.abc import Mapping

import numpy as np

from terrafix.core.camera import CameraCalibration, camera_rotation
from terrafix.core.gate import SIGMAS_95
from terrafix.core.geodesy import LocalFrame
from terrafix.messages import Camera, NavEstimate, PositionHint
from terrafix_tools.console.payloads import Hint, UserFix

SOURCE = "console"
# 1-sigma of a distance by odometry alone, as a share of it [spec: docs/records.md, error of the scale]
ODOMETRY_SHARE = 0.1
MIN_DESCENT = 0.1  # least downward component of the unit ray of a user fix: 6 degrees [spec: no ground above]
ROTATION = slice(3, 6)  # of the covariance of a pose


def hint_message(given: Hint, t_ns: int) -> PositionHint:
    return PositionHint(t_ns=t_ns, lat_deg=given.lat, lon_deg=given.lon, radius_m=given.radius_m, source=SOURCE)


def fix_message(
    fix: UserFix, pixel: tuple[float, float], camera: Camera, estimates: Mapping[int, NavEstimate], now_ns: int
) -> PositionHint | None:
    """The position of the vehicle by a user fix. ``pixel``: (u, v) of the frame as it is read; ``camera``: of such
    frames; ``estimates``: the last one of each frame. None: the frame has no attitude, or the pixel shows no ground.

    The attitude and height of the frame give the way from the place to the vehicle. If odometry connects the frame to
    the newest one, the position is carried on to it; else it is that at the frame and grows old (``aged_radius_m``)."""
    seen = estimates.get(fix.frame_id)
    if seen is None:
        return None
    frame = LocalFrame(fix.lat, fix.lon)
    r_w_c = camera_rotation(seen, camera)
    x, y = CameraCalibration.of(camera).normalise(np.array([pixel]))[0]
    ray = r_w_c @ np.array([x, y, 1.0])
    ray /= np.linalg.norm(ray)
    if ray[2] > -MIN_DESCENT:
        return None
    offset_m = -seen.agl_m / ray[2] * ray[:2]  # from the vehicle to the place
    tilt_sigma, yaw_sigma = _rotation_sigmas(seen)
    away_m = float(np.hypot(*offset_m))
    variance_m2 = fix.sigma_m**2 + (seen.agl_m * tilt_sigma / ray[2] ** 2) ** 2 + (away_m * yaw_sigma) ** 2
    at_m, t_ns, frame_id = -offset_m, seen.t_ns, seen.frame_id
    newest = max(estimates.values(), key=lambda estimate: estimate.frame_id)
    if newest.fragment_id == seen.fragment_id >= 0:
        before, now = (np.array(frame.to_local(e.lat_deg, e.lon_deg)) for e in (seen, newest))
        at_m, t_ns, frame_id = at_m + now - before, now_ns, newest.frame_id
        variance_m2 += (ODOMETRY_SHARE * float(np.hypot(*(now - before)))) ** 2
    lat_deg, lon_deg = frame.to_wgs84(*at_m)
    radius_m = SIGMAS_95 * math.sqrt(variance_m2)
    return PositionHint(
        t_ns=t_ns,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        radius_m=radius_m,
        source=SOURCE,
        frame_id=frame_id,
        sigma_m=math.sqrt(variance_m2),
    )


def _rotation_sigmas(estimate: NavEstimate) -> tuple[float, float]:
    """1-sigma of the tilt (the larger one) and of the heading, rad."""
    cov = np.reshape(estimate.cov, (6, 6))[ROTATION, ROTATION]
    tilt = math.sqrt(max(float(np.linalg.eigvalsh(cov[:2, :2])[-1]), 0.0))
    return tilt, min(math.sqrt(max(float(cov[2, 2]), 0.0)), math.pi)
