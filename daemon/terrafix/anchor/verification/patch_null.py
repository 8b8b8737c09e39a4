"""What the patches of a frame come to at wrong places: learnt in the search itself, from the places that it checks.

Ground that repeats itself gives wrong places more: at the best ones of `village-1` a third more than at those of
`adiyaman-6`. Whoever counts the same for both is rash over the one and blind over the other."""

import numpy as np

from terrafix.anchor.verification.patch_consensus import PatchConsensus

PATCHES = 48
# Of so many patches at the best wrong places of eight flights and maps, on coarse and on fine cells: mean and standard
# deviation. What is learnt is learnt in these units, for both kinds of cells at once.
COARSE, FINE = (8.3, 2.1), (8.4, 2.7)
PRIOR_PLACES = 15.0  # that they count as
LEAST_VARIANCE = 0.2
LEAST_SHARE = 0.8  # of the patches: fewer say too little
LEARNT_PLACES = 24  # enough to know what chance comes to here


class PatchNull:
    def __init__(self, patches: tuple[float, float] = (0.0, 1.0)) -> None:
        """``patches``: mean and standard deviation of the map's null model, in units of ``COARSE`` and ``FINE``."""
        mean, sigma = patches
        self._sums = PRIOR_PLACES * np.array([1.0, mean, mean**2 + sigma**2])  # places, values, squares

    @property
    def is_known(self) -> bool:
        return bool(self._sums[0] >= PRIOR_PLACES + LEARNT_PLACES)

    def learn(self, found: PatchConsensus, *, fine: bool) -> None:
        """From a place that is hardly the right one."""
        if len(found.agrees) >= LEAST_SHARE * PATCHES:
            value = _usual_sigmas(found, fine=fine)
            self._sums += (1.0, value, value**2)

    def sigmas(self, found: PatchConsensus, *, fine: bool) -> float:
        """How far a place is above chance, in standard deviations."""
        mean, sigma = self.patches
        return (_usual_sigmas(found, fine=fine) - mean) / sigma

    @property
    def patches(self) -> tuple[float, float]:
        """Mean and standard deviation of what wrong places come to, as far as they are known by now."""
        count, total, squares = self._sums
        mean = total / count
        return float(mean), float(np.sqrt(max(squares / count - mean**2, LEAST_VARIANCE)))


def _usual_sigmas(found: PatchConsensus, *, fine: bool) -> float:
    """By what chance usually comes to. Fewer patches come to less by chance, too."""
    (mean, sigma), share = FINE if fine else COARSE, len(found.agrees) / PATCHES
    return float((found.llr - mean * share) / (sigma * np.sqrt(share)))
