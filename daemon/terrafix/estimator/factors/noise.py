"""Noise models of the factors, and what they share."""

import gtsam
import numpy as np

# Huber threshold, in sigmas, of poses and motion increments: a measurement that passed its gate but lies in the tail
# gets less weight. [tuned]
FACTOR_HUBER_K = 2.0
MIN_HEIGHT_M = 1.0  # lower bound of a height by which a factor scales [tuned]


def robust_noise(cov: np.ndarray) -> gtsam.noiseModel.Robust:
    """Gaussian noise of covariance ``cov`` under a Huber loss."""
    huber = gtsam.noiseModel.mEstimator.Huber.Create(FACTOR_HUBER_K)
    return gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Gaussian.Covariance(cov, False))


def whiten_common(full: np.ndarray, by_noise: np.ndarray) -> np.ndarray:
    """``full`` (N, K), rows of unit noise, whitened also for errors that they have in common: ``by_noise`` (N, P), by
    each of these in its 1-sigma.

    (1 + P P^T)^(-1/2), where only a few directions of the noise are not white: from the eigenvalues of P^T P."""
    s2, v = np.linalg.eigh(by_noise.T @ by_noise)
    root = np.sqrt(1.0 + s2)
    return np.asarray(full - by_noise @ ((v / (root * (1.0 + root))) @ (v.T @ (by_noise.T @ full))))
