"""Evidence of a frame for the alternative position of its prediction, over one textured ground."""

import msgspec
import numpy as np
import pytest

from anchor_rig import started
from single_map_place import SIDE_M, TRUE_M, R, predicted
from terrafix.anchor.localizer import MIN_OBSERVATION_WEIGHT
from terrafix.anchor.node import AnchorNode
from terrafix.anchor.verification.alternative_place import MAX_PLACE_NATS
from terrafix.messages import MapMatch
from textured_ground import GSD_M, PINHOLE, view

ERROR_M = np.array([7.0, -5.0, 0.0])  # of the estimate
PERIOD_M = 150.0


def nats(node: AnchorNode, frame_id: int, away_m: tuple[float, float] | None) -> float | None:
    """``away_m``: from the estimate to the alternative position."""
    at_m = TRUE_M + ERROR_M
    alternative_m = None if away_m is None else (float(at_m[0]) + away_m[0], float(at_m[1]) + away_m[1])
    prediction = msgspec.structs.replace(predicted(frame_id, 10.0, at_m=at_m), alternative_m=alternative_m)
    answer, *_ = node.on(prediction)
    assert isinstance(answer, MapMatch)
    return answer.alternative_nats


def test_a_frame_that_fits_at_the_estimate_alone_is_full_evidence_once_for_the_same_ground(ground: np.ndarray) -> None:
    node, frames = started(ground)
    for frame_id in (1, 2):
        frames.put(frame_id, view(ground, PINHOLE, R, TRUE_M))
    assert nats(node, 1, (-90.0, 60.0)) == -MAX_PLACE_NATS
    assert nats(node, 2, (-90.0, 60.0)) == pytest.approx(-MAX_PLACE_NATS * MIN_OBSERVATION_WEIGHT)


def test_a_frame_that_fits_alike_at_both_places_is_no_evidence(ground: np.ndarray) -> None:
    """Rows of houses. The image is as far from the alternative position as from the estimate."""
    period = round(PERIOD_M / GSD_M)
    repeated = ground.copy()
    repeated[:, period:] = repeated[:, :-period]
    repeated[:, 2 * period :] = repeated[:, period:-period]
    node, frames = started(repeated)
    frames.put(1, view(repeated, PINHOLE, R, TRUE_M))
    found = nats(node, 1, (-PERIOD_M, 0.0))
    assert found is not None and abs(found) < 0.5 * MAX_PLACE_NATS


@pytest.mark.parametrize("away_m", [None, (10.0 * SIDE_M, 0.0)])
def test_without_an_alternative_position_on_the_map_there_is_no_evidence(
    ground: np.ndarray, away_m: tuple[float, float] | None
) -> None:
    node, frames = started(ground)
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    assert nats(node, 1, away_m) is None
