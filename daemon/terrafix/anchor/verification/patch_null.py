"""Null model of the patch consensus: mean and spread at wrong places, estimated during the search from the places that
it compares.

Repetitive ground scores higher at wrong places: at the best ones of `village-1` a third more than at those of
`adiyaman-6`. One fixed null model would be too permissive over the first and too strict over the second.
"""

import numpy as np

from terrafix.anchor.verification.patch_consensus import PatchConsensus

REFERENCE_PATCHES = 48  # number of patches to which the values below refer [spec: MAX_PATCHES of the patch matcher]
# Mean and standard deviation at the best wrong places of eight flights and maps, on coarse and on fine cells. Learned
# values are expressed in these units, for both kinds of cells at once. [measured: docs/search.md]
COARSE_NULL, FINE_NULL = (8.3, 2.1), (8.4, 2.7)
PRIOR_PLACES = 15.0  # number of places as which the prior counts [tuned]
MIN_VARIANCE = 0.2  # lower bound of the learned variance [tuned]
MIN_PATCH_SHARE = 0.8  # smallest share of REFERENCE_PATCHES for a place to be learned from [tuned]
MIN_PLACES = 24  # number of learned places from which the null model counts as known [measured: docs/search.md]


class PatchNull:
    def __init__(self, patches: tuple[float, float] = (0.0, 1.0)) -> None:
        """``patches``: mean and standard deviation of the map's null model, in units of ``COARSE_NULL`` and
        ``FINE_NULL``."""
        mean, sigma = patches
        self._sums = PRIOR_PLACES * np.array([1.0, mean, mean**2 + sigma**2])  # number, sum and sum of squares

    @property
    def is_estimated(self) -> bool:
        return bool(self._sums[0] >= PRIOR_PLACES + MIN_PLACES)

    def add(self, found: PatchConsensus, *, fine: bool) -> None:
        """Adds a place that is probably wrong."""
        if len(found.inliers) >= MIN_PATCH_SHARE * REFERENCE_PATCHES:
            value = _default_sigmas(found, fine=fine)
            self._sums += (1.0, value, value**2)

    def sigmas(self, found: PatchConsensus, *, fine: bool) -> float:
        """Standard deviations of a place above the null model."""
        mean, sigma = self.patches
        return (_default_sigmas(found, fine=fine) - mean) / sigma

    @property
    def patches(self) -> tuple[float, float]:
        """Mean and standard deviation at wrong places, as estimated so far."""
        count, total, squares = self._sums
        mean = total / count
        return float(mean), float(np.sqrt(max(squares / count - mean**2, MIN_VARIANCE)))


def _default_sigmas(found: PatchConsensus, *, fine: bool) -> float:
    """Standard deviations above the default null model. With fewer patches its mean and spread are smaller."""
    (mean, sigma), share = FINE_NULL if fine else COARSE_NULL, len(found.inliers) / REFERENCE_PATCHES
    return float((found.llr - mean * share) / (sigma * np.sqrt(share)))
