"""Random walk of the calibration state B_k, and the prior of its height scale."""

import numpy as np

from terrafix.estimator.state import HEADING, HEIGHT

# Random walk of B_k per square root of a second: mount tilt (a gimbal creeps), heading (a gyro drifts), barometer (a
# front brings 1 hPa, 8 m, in an hour), lens (it warms up: a tenth of its error in ten minutes), height scale (air warms
# up by 4 degrees an hour, 1.5 %). With a larger barometer term, minutes of dead reckoning carry the height off. [tuned]
WALK_SIGMAS = np.array([np.radians(0.15), np.radians(0.15), np.radians(0.3), 0.15, 2e-5, 2.5e-4])
# Further walk of the heading bias, rad per square root of a radian turned: iron on board. [tuned]
COMPASS_BY_TURN_RAD = np.radians(2.5)
# 1-sigma of the barometer's part of the height scale, as a share: air that is 14 degrees warmer than the standard
# atmosphere makes all barometric heights 5 % too small. The other part of the scale is the error of the focal length,
# which scales seen heights. [spec: standard atmosphere, 14 K of 288 K]
BAROMETER_SCALE_SIGMA = 0.05


def walk_sigmas(dt_s: float, turned_rad: float, rise_sigma_m: float) -> np.ndarray:
    """1-sigma (CALIBRATION_SIZE,) of the change of B_k within ``dt_s``. ``turned_rad``: change of heading.
    ``rise_sigma_m``: 1-sigma of the change of ground elevation where no DEM gives it, part of the height bias."""
    sigmas = WALK_SIGMAS * np.sqrt(dt_s)
    sigmas[HEADING] = np.hypot(sigmas[HEADING], COMPASS_BY_TURN_RAD * np.sqrt(abs(turned_rad)))
    sigmas[HEIGHT] = np.hypot(sigmas[HEIGHT], rise_sigma_m)
    return sigmas
