"""Frames of one date against place descriptors of a map of another date."""

import math

import numpy as np

from terrafix.anchor.matching.frame_matcher import Hypothesis
from terrafix.anchor.place_index.recognizer import squares_of
from terrafix_engines.retrieval.places import PlaceDescriber, PooledGradientPlaces
from terrafix_tools.bench.search.views import TwoDates
from terrafix_tools.mapping.place_index import SIDE_PER_AGL, STEPS_PER_SIDE

HEADING_STEP_RAD = 2.0 * math.pi / 29  # between the headings of a search with unknown heading
SEED = 11


def similarities(dates: TwoDates, agl_m: float, count: int, describer: PlaceDescriber | None = None) -> np.ndarray:
    """Similarity (N,) of frames with the nearest of the map's discs: the heading is off by up to half a step of the
    search, the disc by up to a quarter of the distance of the map's discs in each axis: so near is one of the
    squares of the frame."""
    describer, rng = describer or PooledGradientPlaces(), np.random.default_rng(SEED)
    source, matcher = dates.open()
    side_m = SIDE_PER_AGL * agl_m
    gsd_m, most_m = side_m / describer.side_px, side_m / STEPS_PER_SIDE / 4
    found = []
    for view in dates.draw(count, agl_m, SEED):
        # frames are stated with the heading 0: an image turned clockwise by its heading is turned back
        error_rad = rng.uniform(-0.5, 0.5) * HEADING_STEP_RAD
        (frame,) = matcher.rectify_all(
            view.frame, view.predicted, [Hypothesis(error_rad - view.heading_rad, 1.0)], gsd_m, 1
        )
        squares = squares_of(frame, describer.side_px) if frame is not None else []
        if not squares:
            continue
        square = squares[0]
        centre_m = view.place_m + np.array([square.east_m, square.north_m]) + rng.uniform(-most_m, most_m, 2)
        e_min_m, n_max_m = centre_m + np.array([-side_m / 2, side_m / 2])
        ground, _ = source.window(e_min_m, n_max_m, describer.side_px, describer.side_px, gsd_m)
        query, disc = describer.describe(np.array([square.image, ground]))
        found.append(float(query @ disc))
    return np.array(found)
