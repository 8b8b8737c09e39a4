"""Offset between two layers of a map, by registration of the ground that both show."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from terrafix.anchor.matching.orthorectify import Rectified
from terrafix.anchor.matching.patch_matcher import SearchedMap, match_patches
from terrafix.map.package import LocalMap
from terrafix_engines.features.gradient import GradientDescriber

PATCH_CELLS = 48
REACH_M = 30.0  # search range in each direction: 4.5 sigmas per axis of the offset of two layers with CE90 10 m
MIN_REACH_CELLS = 8
MIN_CELL_M = 0.75  # finer cells take longer without a gain, which imagery of two dates does not allow
GRID = 12  # patches along the longer side of the overlap: at most 144, some 5 s of one core
AGREE_CELLS = 3.0  # patches with offsets within this agree
MIN_VALID = 0.98  # minimum valid fraction of a patch
MIN_AGREEING = 8
# Maximum probability that this many patches agree by chance. Offsets of wrong patches are uniform over the search range
# (binomial tail, times the number of patches around which agreement is counted).
CHANCE = 1e-6
MAD_SIGMAS = 1.4826  # 1-sigma of a normal variable in units of its median absolute deviation
MEDIAN_SIGMAS = 1.2533  # sqrt(n) times the 1-sigma of the median of n normal variables, in their sigma: sqrt(pi / 2)


@dataclass(frozen=True)
class Offset:
    """``east_m``, ``north_m``: position of a point in the second layer minus that in the first; ``scatter_m``: robust
    1-sigma per axis from patch to patch; ``patches``: number of agreeing patches."""

    east_m: float
    north_m: float
    scatter_m: float
    patches: int

    @property
    def sigma_m(self) -> float:
        """1-sigma of the offset per axis."""
        return MEDIAN_SIGMAS * self.scatter_m / math.sqrt(self.patches)


def register(first: LocalMap, second: LocalMap) -> Offset | None:
    """Offset of two layers bound to the same frame. None: no overlap, or they do not show the same ground."""
    cell_m = max(first.gsd_m, second.gsd_m, MIN_CELL_M)
    reach = max(MIN_REACH_CELLS, math.ceil(REACH_M / cell_m))
    found = [offset for at_m in _places(first, second, cell_m) for offset in _patch(first, second, at_m, cell_m, reach)]
    return agreed_offset(np.array(found).reshape(-1, 2), AGREE_CELLS * cell_m, reach * cell_m)


def agreed_offset(offsets_m: np.ndarray, agree_m: float, reach_m: float) -> Offset | None:
    """Consensus of patch offsets (N, 2), some of which are wrong; ``reach_m``: search range in each direction. None:
    the agreement is not significant."""
    if not len(offsets_m):
        return None
    near = np.linalg.norm(offsets_m[:, None] - offsets_m[None], axis=2) <= agree_m
    most = int(near.sum(1).max())
    share = math.pi * agree_m**2 / (2.0 * reach_m) ** 2
    if most < MIN_AGREEING or len(offsets_m) * binomial_tail(most - 1, len(offsets_m) - 1, share) > CHANCE:
        return None
    agreeing = offsets_m[near[int(near.sum(1).argmax())]]
    centre = np.median(agreeing, axis=0)
    scatter_m = MAD_SIGMAS * float(np.median(np.abs(agreeing - centre)))
    return Offset(float(centre[0]), float(centre[1]), scatter_m, most)


def binomial_tail(at_least: int, of: int, probability: float) -> float:
    """Upper tail of a binomial distribution."""
    return sum(math.comb(of, n) * probability**n * (1.0 - probability) ** (of - n) for n in range(at_least, of + 1))


def _places(first: LocalMap, second: LocalMap, cell_m: float) -> Iterator[tuple[float, float]]:
    """North-west corners of patches, on a grid over the common ground."""
    low = np.maximum(first.bounds_m[:2], second.bounds_m[:2])
    high = np.minimum(first.bounds_m[2:], second.bounds_m[2:])
    side_m = PATCH_CELLS * cell_m
    step_m = max(side_m, float((high - low).max()) / GRID)
    for east_m in np.arange(low[0], high[0] - side_m, step_m):
        for north_m in np.arange(high[1], low[1] + side_m, -step_m):
            yield float(east_m), float(north_m)


def _patch(
    first: LocalMap, second: LocalMap, at_m: tuple[float, float], cell_m: float, reach: int
) -> Iterator[np.ndarray]:
    """The offset (2,) of one patch, if it is found."""
    picture, mask = first.window(*at_m, PATCH_CELLS, PATCH_CELLS, cell_m)
    if mask.mean() < MIN_VALID:
        return
    corner_m, side = (at_m[0] - reach * cell_m, at_m[1] + reach * cell_m), PATCH_CELLS + 2 * reach
    ground, valid = second.window(*corner_m, side, side, cell_m)
    describe = GradientDescriber().describe
    template = Rectified(picture, mask, *at_m, cell_m)
    searched = SearchedMap(describe(ground), valid, corner_m)
    found = match_patches(describe(picture), template, mask, cell_m, searched, (0.0, 0.0), PATCH_CELLS, reach)
    yield from found.map_m - found.frame_m
