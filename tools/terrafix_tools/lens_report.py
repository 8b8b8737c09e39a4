"""Operator text about the lens calibration that a flight has estimated."""

import numpy as np

from terrafix.core.camera import distort_division, undistort_division
from terrafix.core.gate import GATE
from terrafix.estimator.measurements.principal_point import PrincipalPointFilter
from terrafix.messages import CalibrationEstimate, Camera

RADIAL_K1 = 4  # index of radial_k1 in CalibrationEstimate.state
MIN_SIGMAS = 3.0  # sigmas by which the estimate must differ from zero to be reported
MIN_WIDTH_SHARE = (
    0.01  # of the image width: least displacement by distortion (corner) or by the principal point that is reported
)


def lens_words(camera: Camera, calibration: CalibrationEstimate) -> str | None:
    """Returns one or two sentences; None when the estimate does not differ significantly from the described lens."""
    return (
        " ".join(
            source
            for source in (_distortion_text(camera, calibration), _principal_point_text(camera, calibration))
            if source
        )
        or None
    )


def _principal_point_text(camera: Camera, calibration: CalibrationEstimate) -> str:
    principal_point = PrincipalPointFilter(camera, calibration.lens)
    px = principal_point.offset * (camera.fx, camera.fy)
    sigma_px = np.sqrt(np.diag(principal_point.cov)) * (camera.fx, camera.fy)
    if (
        not principal_point.offset.any()
        or principal_point.offset @ np.linalg.solve(principal_point.cov, principal_point.offset) < GATE[2]
    ):
        return ""
    if np.hypot(*px) < MIN_WIDTH_SHARE * camera.width:
        return ""
    cx, cy = camera.cx + px[0], camera.cy + px[1]
    return (
        f"The principal point is estimated at {cx:.0f}, {cy:.0f} px (+- {sigma_px[0]:.0f}, {sigma_px[1]:.0f}); "
        f"the positions are corrected for it. Calibrate it, or write cx = {cx:.0f} and cy = {cy:.0f} into [camera]."
    )


def _distortion_text(camera: Camera, calibration: CalibrationEstimate) -> str:
    radial_k1 = calibration.state[RADIAL_K1]
    n = len(calibration.state)
    sigma = float(np.sqrt(calibration.cov[RADIAL_K1 * n + RADIAL_K1]))
    corner = float(
        np.hypot(
            max(camera.cx, camera.width - camera.cx) / camera.fx, max(camera.cy, camera.height - camera.cy) / camera.fy
        )
    )
    distorted = np.column_stack([np.linspace(0.1, 1.0, 10) * corner, np.zeros(10)])
    undistorted = undistort_division(distorted, radial_k1)
    shift_px = float(np.abs(undistorted - distorted).max()) * camera.fx
    if abs(radial_k1) < MIN_SIGMAS * sigma or shift_px < MIN_WIDTH_SHARE * camera.width:
        return ""
    if camera.distortion:
        source, todo = "in addition to the stated distortion", "calibrate it again"
    else:
        source = "and flight.toml states no distortion"
        # A stated distortion shows that the focal length was calibrated as well.
        todo = (
            f"calibrate it, or write {_opencv_distortion(undistorted, radial_k1)}"
            f" and focal_sigma = {camera.focal_sigma:g}"
        )
        todo += " into [camera]"
    return (
        f"The lens distortion is estimated as k1 = {radial_k1:+.2f} (+- {sigma:.2f}), {shift_px:.0f} px at the corner, "
        f"{source}: {todo}."
    )


def _opencv_distortion(undistorted: np.ndarray, radial_k1: float) -> str:
    """Converts the division model to OpenCV coefficients (k1 k2 p1 p2 k3), least squares up to the image corner."""
    r = undistorted[:, 0]
    ratio = distort_division(undistorted, radial_k1)[:, 0] / r - 1.0
    k1, k2, k3 = np.linalg.lstsq(r[:, None] ** [2, 4, 6], ratio, rcond=None)[0]
    return f"distortion = [{k1:.4f}, {k2:.4f}, 0.0, 0.0, {k3:.4f}]"
