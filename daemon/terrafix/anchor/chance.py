"""What the patches of a frame come to at wrong places: learnt in the search itself, from all places that it checks.

Ground that repeats itself gives wrong places more: at the best ones of `village-1` a third more than at those of
`adiyaman-6`. Whoever counts the same for both is rash over the one and blind over the other."""

import numpy as np

from terrafix.anchor.agreement import Agreement

PATCHES = 48
# Of so many patches at the best wrong places of eight flights and maps, on coarse and on fine cells: mean and standard
# deviation. They count as so many places.
COARSE, FINE = (8.3, 2.1), (8.4, 2.7)
PRIOR_PLACES = 40.0
LEAST_SHARE = 0.8  # of the patches: fewer say too little


class Chance:
    def __init__(self) -> None:
        self._sums = {
            fine: PRIOR_PLACES * np.array([1.0, mean, mean**2 + sigma**2])
            for fine, (mean, sigma) in ((False, COARSE), (True, FINE))
        }

    def learn(self, found: Agreement, *, fine: bool) -> None:
        """From a place that is hardly the right one."""
        share = len(found.agrees) / PATCHES
        if share >= LEAST_SHARE:
            llr = found.llr / share
            self._sums[fine] += (1.0, llr, llr**2)

    def sigmas(self, found: Agreement, *, fine: bool) -> float:
        """How far a place is above chance, in standard deviations. Fewer patches come to less by chance, too."""
        count, total, squares = self._sums[fine]
        share, mean = len(found.agrees) / PATCHES, total / count
        sigma = float(np.sqrt(max(squares / count - mean**2, 1.0)))
        return float((found.llr - mean * share) / (sigma * np.sqrt(share)))
