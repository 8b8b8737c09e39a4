"""Prior uncertainty of radial distortion and principal point of a camera that is described and not calibrated."""

from terrafix.messages import Camera

# 1-sigma of the radial coefficient beyond the description of the lens, after a calibration or by its maker's data ...
RADIAL_K1_SIGMA = 0.02  # [tuned]
# ... and per 1-sigma of the focal length. With a focal length known to 10 % only, nothing was calibrated: an action
# camera has a coefficient of -0.3, which is two sigmas. [tuned]
RADIAL_K1_PER_FOCAL_SIGMA = 1.5
# 1-sigma of the principal point, share of the image width, per 1-sigma of the focal length: without a calibration it is
# 2 % off (sensor glue, crop to 16:9, electronic stabilisation). [tuned]
PRINCIPAL_POINT_PER_FOCAL_SIGMA = 0.2
# 1-sigma of the focal length at which a camera counts as calibrated: its principal point is then known to a pixel or
# two. [tuned]
MAX_CALIBRATED_FOCAL_SIGMA = 0.01


def radial_k1_sigma(camera: Camera) -> float:
    """1-sigma of the radial coefficient beyond the description of the lens, before flight."""
    return (
        RADIAL_K1_SIGMA if camera.distortion else max(RADIAL_K1_SIGMA, RADIAL_K1_PER_FOCAL_SIGMA * camera.focal_sigma)
    )


def principal_point_sigma(camera: Camera) -> float:
    """1-sigma of the ground offset by the principal point, along each image axis, as a share of the height.

    An equal offset of all rays cannot be told from a shift of position, by any image or map. So it does not average out
    over fixes, like the map's own error."""
    if camera.focal_sigma <= MAX_CALIBRATED_FOCAL_SIGMA:
        return 0.0
    return PRINCIPAL_POINT_PER_FOCAL_SIGMA * camera.focal_sigma * camera.width / camera.fx
