"""The alternative position: where the vehicle is if the estimate follows wrong map matches (``Cause.ELSEWHERE``).

Map matches that agree with each other and not with the graph mean that one of the two is wrong, and no on-board
measurement can decide between them: rows of houses and fields are self-consistent for minutes. Whichever position the
estimate follows, the published covariance includes the other one until the images fit the map better at the estimate
(anchor/verification/alternative_place.py)."""

from dataclasses import dataclass, field

import numpy as np

from terrafix.core.agreement import RANGES, Agreement, Cause

MIN_CONSISTENT = 2  # consecutive rejected matches that agree with each other; a single one is an outlier [tuned]
# Smallest probability at which the published 3-sigma ellipse reaches the alternative position.
REACHED_PROBABILITY = 1 / 9  # [spec: probability p gives sigma = offset * sqrt(p)]


@dataclass
class AlternativePosition:
    """``offset_m`` (2,): from the estimate to the alternative position, with covariance ``cov_m2`` (2, 2); its
    probability is that of ``Cause.ELSEWHERE`` in ``agreement``, by default without any other cause. ``first_frame``:
    frames from this one on are predicted with it."""

    agreement: Agreement = field(default_factory=lambda: Agreement({Cause.ELSEWHERE: RANGES[Cause.ELSEWHERE]}))
    offset_m: np.ndarray = field(default_factory=lambda: np.zeros(2))
    cov_m2: np.ndarray = field(default_factory=lambda: np.zeros((2, 2)))
    first_frame: int = 0

    @property
    def weight(self) -> float:
        """Weight, 0..1, of the alternative position in the mixture; 0: there is none."""
        return self.agreement.weight(Cause.ELSEWHERE)

    def spawn(self, offsets_m: list[np.ndarray], cov_m2: np.ndarray, first_frame: int = 0) -> None:
        """Consecutive rejected matches, as offsets (2,) from the estimate; ``cov_m2`` (2, 2): of the last one. No
        effect for fewer than MIN_CONSISTENT matches."""
        if len(offsets_m) >= MIN_CONSISTENT:
            self._begin(np.mean(offsets_m, axis=0), cov_m2, first_frame)

    def switch(self, offset_m: np.ndarray, cov_m2: np.ndarray, first_frame: int = 0) -> None:
        """The estimate was moved by ``offset_m`` (2,) to the alternative; its old position becomes the alternative."""
        self._begin(-offset_m, cov_m2, first_frame)

    def _begin(self, offset_m: np.ndarray, cov_m2: np.ndarray, first_frame: int = 0) -> None:
        self.offset_m, self.cov_m2, self.first_frame = offset_m, cov_m2, first_frame
        self.agreement.begin(Cause.ELSEWHERE)

    def on_match(self, frame_id: int, nats: float | None) -> None:
        """A map match of ``frame_id`` agreed with the estimate. ``nats``: MapMatch.alternative_nats."""
        if nats is not None and frame_id >= self.first_frame:
            self.agreement.add(Cause.ELSEWHERE, nats)

    def moments_m2(self) -> np.ndarray:
        """Second moments (2, 2) of the alternative about the estimate, times its weight.

        In the moments of a mixture ``cov_m2`` is weighted by the probability, too. Here it has its full weight from
        REACHED_PROBABILITY on: the true position may lie aside of the offset by as much as ever, and an ellipse that
        reaches as far as the offset must reach that position."""
        aside_m2 = min(1.0, self.weight / REACHED_PROBABILITY) * self.cov_m2
        return np.asarray(self.weight * np.outer(self.offset_m, self.offset_m) + aside_m2)
