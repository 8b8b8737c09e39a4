"""What is not known of a lens that nobody has calibrated."""

from terrafix.messages import Camera

# 1-sigma of what a lens bends beyond its description (custom_factors.py): after a calibration, or as its maker says ...
LENS_SIGMA = 0.02
# ... and by the 1-sigma of the focal length. Whoever knows that to 10 % only has calibrated nothing: an action camera
# bends by -0.3, and that is two sigmas.
LENS_PER_FOCAL_SIGMA = 1.5
# 1-sigma of the middle of the picture, a share of its width, by that of the focal length: of a lens that nobody has
# calibrated it is 2 % aside (a sensor that is glued on, a picture that is cut to 16:9 or held still by software).
CENTRE_PER_FOCAL_SIGMA = 0.2
CALIBRATED = 0.01  # 1-sigma of the focal length: who knows it so well knows the middle to a pixel or two


def lens_sigma(camera: Camera) -> float:
    """1-sigma of what the lens bends beyond its description, before anything was seen."""
    return LENS_SIGMA if camera.distortion else max(LENS_SIGMA, LENS_PER_FOCAL_SIGMA * camera.focal_sigma)


def centre_sigma(camera: Camera) -> float:
    """1-sigma by which all ground is seen aside, along each axis of the picture, a share of the height above it.

    Rays that are all aside by as much are a place that is: no picture, and no map, tells one from the other. So no
    number of fixes makes less of it, as of the map's own error."""
    if camera.focal_sigma <= CALIBRATED:
        return 0.0
    return CENTRE_PER_FOCAL_SIGMA * camera.focal_sigma * camera.width / camera.fx
