"""A vehicle that leans, and nobody who reports roll and pitch."""

import numpy as np
import pytest

from simulated_flight import ORIGIN
from terrafix.estimator.measurements.attitude_height import LEAN_S, UNKNOWN_ATTITUDE_RAD, MountedCamera
from terrafix.estimator.measurements.telemetry_buffer import Attitude


def test_the_level_prior_counts_once_in_a_lean() -> None:
    camera = MountedCamera(ORIGIN)
    unreported, reported = Attitude(0.0, None, None, None), Attitude(0.0, 0.0, 0.0, None)
    r_w_c = camera.expected(unreported, np.zeros(6))

    def tilt_information(attitude: Attitude, since_s: float) -> float:
        noise = camera.factor((0, 1), attitude, r_w_c, 0.0, since_s).noiseModel()
        return float(noise.sigmas()[0]) ** -2

    for frames in (2, 10, 50):
        information = frames * tilt_information(unreported, LEAN_S / frames)
        assert information == pytest.approx(UNKNOWN_ATTITUDE_RAD**-2)
    assert tilt_information(unreported, 60.0) == pytest.approx(UNKNOWN_ATTITUDE_RAD**-2)
    assert tilt_information(reported, 0.1) == tilt_information(reported, 60.0)
