"""Place recognition of a frame: where on the map may it be, for every yaw and scale hypothesis?"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from terrafix.anchor.matching.frame_matcher import FrameMatcher, Hypothesis, View
from terrafix.anchor.matching.orthorectify import Rectified
from terrafix.anchor.place_index.format import IndexedLayer
from terrafix.anchor.place_index.index import PlaceIndex
from terrafix.core.config import Places
from terrafix.core.errors import MapError, ModelError
from terrafix.core.geodesy import LocalFrame
from terrafix.core.node import Image
from terrafix_engines.retrieval.places import PlaceDescriber, disc, open_place_describer
from terrafix_engines.runtime import ModelFileError

SEEN_SHARE = 0.97  # least share of the disc that the frame must show [tuned]
MIN_SHARE_OF_FRAME = 0.15  # least share of the frame that the disc covers: a smaller disc is a poor sample [tuned]
DISCS_PER_HYPOTHESIS = 200  # most similar discs of each yaw and scale [tuned]


@dataclass(frozen=True)
class Candidate:
    """A possible camera position (local east, north) and the similarity there."""

    e_m: float
    n_m: float
    score: float


class PlaceMemory:
    """A place index with the descriptor that it was made with."""

    def __init__(self, index: PlaceIndex, describer: PlaceDescriber) -> None:
        """Raises MapError: the index was made with another descriptor, or with other weights."""
        if index.header.descriptor != describer.name:
            raise MapError(
                f"the place index was made with {index.header.descriptor}, not with {describer.name}; "
                "make it again (terrafix map index), or install the model that made it"
            )
        self.index, self.describer = index, describer

    @classmethod
    def open(cls, config: Places, models_folder: str, *, verify: bool) -> "PlaceMemory | None":
        """As configured; None: no index is. Raises MapError, ModelError, UsageError."""
        if not config.index:
            return None
        index = PlaceIndex.open(Path(config.index), config.search, verify=verify)
        try:
            return cls(index, open_place_describer(index.header.model, models_folder))
        except ModelFileError as error:
            raise ModelError(str(error)) from None


class PlaceRecognizer:
    """Recognition on one map layer, in the local frame of a flight."""

    def __init__(self, memory: PlaceMemory, layer: IndexedLayer, frame: LocalFrame) -> None:
        self._index, self._describer, self._frame = memory.index, memory.describer, frame
        self._allowed = memory.index.within(layer)
        side_px = memory.describer.side_px
        self._gsd_m = memory.index.header.side_m / side_px
        self._disc = disc(side_px, 0.0) > 0.0

    def fits(self, view: View, hypotheses: Sequence[Hypothesis], matcher: FrameMatcher) -> bool:
        """Whether a frame shows the disc of the index completely at every hypothesis, and the disc is no small part of
        it: the flight is at a height for which the index was made."""
        blank = np.zeros((matcher.camera.height, matcher.camera.width, 3), np.uint8)
        return len(self._squares(blank, view, hypotheses, matcher)) == len(hypotheses)

    def candidates(
        self, image: Image, view: View, hypotheses: Sequence[Hypothesis], matcher: FrameMatcher
    ) -> list[Candidate]:
        """Possible camera positions, best first; none where the frame does not show the disc. Raises ModelRunError."""
        squares = self._squares(image, view, hypotheses, matcher)
        if not squares:
            return []
        queries = self._describer.describe(np.array([pixels for pixels, _ in squares]))
        candidates = []
        for found in self._index.find(queries, DISCS_PER_HYPOTHESIS, self._allowed):
            e_m, n_m = self._frame.to_local(*self._index.position_deg(found.id))
            offset_m = squares[found.query][1]
            candidates.append(Candidate(e_m - offset_m[0], n_m - offset_m[1], found.score))
        return candidates

    def _squares(
        self, image: Image, view: View, hypotheses: Sequence[Hypothesis], matcher: FrameMatcher
    ) -> list[tuple[np.ndarray, tuple[float, float]]]:
        frames = matcher.rectify_all(image, view, hypotheses, self._gsd_m, 1)
        found = [self._square(frame) for frame in frames if frame is not None]
        return [square for square in found if square is not None]

    def _square(self, frame: Rectified) -> tuple[np.ndarray, tuple[float, float]] | None:
        """The square around the middle of the visible ground, and its centre east and north of the camera."""
        side = self._describer.side_px
        middle = [round(float(v.mean() + 0.5 - side / 2)) for v in np.nonzero(frame.mask)]
        row, column = (max(v, 0) for v in middle)
        inside = frame.mask[row : row + side, column : column + side]
        if inside.shape != (side, side) or self._disc.sum() < MIN_SHARE_OF_FRAME * frame.mask.sum():
            return None
        if float(inside[self._disc].mean()) < SEEN_SHARE:
            return None
        centre_m = (
            frame.e_min_m + (column + side / 2) * frame.gsd_m,
            frame.n_max_m - (row + side / 2) * frame.gsd_m,
        )
        return frame.image[row : row + side, column : column + side], centre_m
