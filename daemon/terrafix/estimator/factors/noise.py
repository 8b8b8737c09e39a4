"""Robust noise model of the factors."""

import gtsam
import numpy as np

# Huber threshold, in sigmas, of poses and motion increments: a measurement that passed its gate but lies in the tail
# gets less weight. [tuned]
HUBER_K = 2.0


def robust_noise(cov: np.ndarray) -> gtsam.noiseModel.Robust:
    """Gaussian noise of covariance ``cov`` under a Huber loss."""
    huber = gtsam.noiseModel.mEstimator.Huber.Create(HUBER_K)
    return gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Gaussian.Covariance(cov, False))
