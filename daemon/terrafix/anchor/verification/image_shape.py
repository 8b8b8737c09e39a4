"""Whether both axes of the images have the scale of the camera description: a pipeline that scales 16:9 into 4:3, or
crops 3:2, has stretched one of them.

The map decides. A frame is correlated as described, with both axes larger and smaller, and with either axis alone. The
patches of a single frame cannot tell: those that agree with one camera pose lie where the shapes agree."""

import math
from collections.abc import Mapping

import numpy as np

from terrafix.anchor.matching.point_mass_filter import BELIEF_LLR_MAX
from terrafix.core.agreement import NATS_PER_SCORE, STATED, WRONG_SCORE, Agreement, Cause, Range

# Scale of a stretched axis. [spec: 4:3, 3:2 and 16:9 differ by 1.19 and 1.33; a correlation tolerates a tenth]
STRETCH = 1.25
Stretch = tuple[float, float]  # focal lengths in x and y over the described ones
AS_DESCRIBED: Stretch = (1.0, 1.0)  # [spec: identity]
# Height and focal length of a description may be wrong as well: both axes are. [spec: geometry]
SAME_SHAPE: tuple[Stretch, ...] = (AS_DESCRIBED, (STRETCH, STRETCH), (1.0 / STRETCH, 1.0 / STRETCH))
# By the scale of the x axis over that of the y axis. [spec: geometry]
OTHER_SHAPES: dict[float, tuple[Stretch, ...]] = {
    STRETCH: ((STRETCH, 1.0), (1.0, 1.0 / STRETCH)),
    1.0 / STRETCH: ((1.0, STRETCH), (1.0 / STRETCH, 1.0)),
}
STRETCHES = (*SAME_SHAPE, *(one for shapes in OTHER_SHAPES.values() for one in shapes))
# Standard deviations by which another shape has to fit better: the lead of the best of some wrong ones, where no shape
# fits. [measured: docs/decisions/059-images-against-inertial-sensors.md]
LEAD = 0.5
CERTAIN = math.log(1000.0)  # nats, for and against [spec: one in a thousand]
# Share of the height: error of a position by an image with one axis stretched. [spec: of what is seen a height away]
STRETCHED_SHARE = STRETCH - 1.0


class ImageShape:
    """Posterior of another shape, one for each ratio of the axes. ``ratio``: that of the images, x over y, where it is
    certain; 1: as described."""

    def __init__(self) -> None:
        limits = {Cause.DESCRIPTION: Range(STATED.prior, -CERTAIN, CERTAIN)}
        self._agreements = {ratio: Agreement(limits) for ratio in OTHER_SHAPES}
        self._tested = False
        self.ratio: float | None = None

    def is_due(self, score: float, new_ground: float) -> bool:
        """Whether a frame with this standardised correlation, as described, is to be tested, ``new_ground`` after the
        last one (1: counts in full). One that fits as a wrong place does may have another shape than those before it,
        and one that fits better, after others that had another shape, the described one."""
        odds = max(self._log_odds.values())
        if new_ground >= 1.0:
            return score < WRONG_SCORE or odds > -CERTAIN
        return score >= WRONG_SCORE and odds > 0.0

    def add(self, scores: Mapping[Stretch, float]) -> None:
        """``scores``: highest standardised correlation of a frame with each of STRETCHES."""
        self._tested = True
        as_described = max(scores[one] for one in SAME_SHAPE)
        for ratio, shapes in OTHER_SHAPES.items():
            nats = NATS_PER_SCORE * (max(scores[one] for one in shapes) - as_described - LEAD)
            bounded = float(np.clip(nats, -BELIEF_LLR_MAX, BELIEF_LLR_MAX))
            self._agreements[ratio].add(Cause.DESCRIPTION, bounded)
        ratio, log_odds = max(self._log_odds.items(), key=lambda item: item[1])
        if log_odds >= CERTAIN:
            self.ratio = ratio
        elif log_odds < 0.0:
            self.ratio = 1.0 if log_odds <= -CERTAIN else None

    def sigma_m(self, agl_m: float) -> float:
        """1-sigma per axis [m] that the mixture component of another shape adds to a position ``agl_m`` above
        ground; 0 before a frame was tested: a drawn map shows no shape."""
        if not self._tested:
            return 0.0
        probability = max(one.weight(Cause.DESCRIPTION) for one in self._agreements.values())
        return math.sqrt(probability) * STRETCHED_SHARE * agl_m

    @property
    def _log_odds(self) -> dict[float, float]:
        return {ratio: one.log_odds[Cause.DESCRIPTION] for ratio, one in self._agreements.items()}
