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

# Least share of the disc that the frame must show; the rest is black.
# [spec: VALID_SHARE of the discs of the map]
SEEN_SHARE = 0.95
# Least share of the frame that the disc covers: a smaller disc is a poor sample of it. At the height of the index it is
# 0.44, at twice that height a quarter of that, so that indices an octave apart serve all heights.
# [spec: pi / 4 * 0.75^2 / 4]
MIN_SHARE_OF_FRAME = 0.11
DISCS_PER_QUERY = 200  # most similar discs of each square of a yaw and scale [measured: docs/search.md]


# Rows and columns, shares of the side, by which the squares of a frame are moved from the middle of its ground. Discs
# of the map are a quarter of the side apart; with these the nearest one is at most a sixteenth off in each axis.
# [spec: half of the distance of the map's discs]
SHIFTS = tuple((row, column) for row in (-1 / 16, 1 / 16) for column in (-1 / 16, 1 / 16))


@dataclass(frozen=True)
class Square:
    """``image`` (S, S, 3), north up; its centre in metres east and north of the camera."""

    image: np.ndarray
    east_m: float
    north_m: float


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
        self._gsd_m = memory.index.header.side_m / memory.describer.side_px

    def fits(self, view: View, hypotheses: Sequence[Hypothesis], matcher: FrameMatcher) -> bool:
        """Whether a frame shows the disc of the index completely at every hypothesis, and the disc is no small part of
        it: the flight is at a height for which the index was made."""
        blank = np.zeros((matcher.camera.height, matcher.camera.width, 3), np.uint8)
        return len(self._squares(blank, view, hypotheses, matcher)) == len(hypotheses) * len(SHIFTS)

    def candidates(
        self, image: Image, view: View, hypotheses: Sequence[Hypothesis], matcher: FrameMatcher
    ) -> list[Candidate]:
        """Possible camera positions, best first; none where the frame does not show the disc. Raises ModelRunError."""
        squares = self._squares(image, view, hypotheses, matcher)
        if not squares:
            return []
        queries = self._describer.describe(np.array([square.image for square in squares]))
        candidates = []
        for found in self._index.find(queries, DISCS_PER_QUERY, self._allowed):
            e_m, n_m = self._frame.to_local(*self._index.position_deg(found.id))
            square = squares[found.query]
            candidates.append(Candidate(e_m - square.east_m, n_m - square.north_m, found.score))
        return candidates

    def _squares(
        self, image: Image, view: View, hypotheses: Sequence[Hypothesis], matcher: FrameMatcher
    ) -> list[Square]:
        frames = matcher.rectify_all(image, view, hypotheses, self._gsd_m, 1)
        return [s for frame in frames if frame is not None for s in squares_of(frame, self._describer.side_px)]


def squares_of(frame: Rectified, side_px: int) -> list[Square]:
    """The squares around the middle of the visible ground, moved by SHIFTS; none if the frame does not show their
    discs, or if these are a small part of it."""
    inside = disc(side_px, 0.0) > 0.0
    if inside.sum() < MIN_SHARE_OF_FRAME * frame.mask.sum():
        return []
    middle = [float(v.mean()) + 0.5 for v in np.nonzero(frame.mask)]
    squares = []
    for shift in SHIFTS:
        row, column = (max(round(m + s * side_px - side_px / 2), 0) for m, s in zip(middle, shift, strict=True))
        seen = frame.mask[row : row + side_px, column : column + side_px]
        if seen.shape != (side_px, side_px) or float(seen[inside].mean()) < SEEN_SHARE:
            return []
        east_m = frame.e_min_m + (column + side_px / 2) * frame.gsd_m
        north_m = frame.n_max_m - (row + side_px / 2) * frame.gsd_m
        squares.append(Square(frame.image[row : row + side_px, column : column + side_px], east_m, north_m))
    return squares
