"""Anchor on a map that is drawn from roads, water and buildings: positions alone, and the search by the belief."""

from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from single_map_place import ORIGIN, TRUE_M, R, SingleMapPackage, predicted
from terrafix.anchor.matching.ncc import CorrelationWindow
from terrafix.anchor.node import AnchorNode
from terrafix.core.frames import MemoryFrameStore
from terrafix.messages import MapMatch, SearchStep, Verdict
from terrafix_engines.features.gradient import GradientDescriber
from textured_ground import PINHOLE, view

STEP_M, FRAMES = 20.0, 11
SEARCHED_M = 101.0  # 1-sigma of a start that is searched for


class DrawnMap(SingleMapPackage):
    manifest = SimpleNamespace(
        layers=(SimpleNamespace(table="drawn", ce90_m=6.0, ce90_origin=None, null_model=None, is_drawn=True),)
    )


class BesideOldImagery(SingleMapPackage):
    """Imagery of ground that has been rebuilt, and the drawn layer of today's."""

    manifest = SimpleNamespace(layers=(*SingleMapPackage.manifest.layers, *DrawnMap.manifest.layers))

    def bind(self, _frame: object, layer: str) -> SingleMapPackage:
        return DrawnMap(self._ground) if layer == "drawn" else SingleMapPackage(self._ground[::-1, ::-1].copy())


def started_on(
    ground: np.ndarray, start_sigma_m: float, kind: type[SingleMapPackage] = DrawnMap
) -> tuple[AnchorNode, MemoryFrameStore]:
    package: Any = kind(ground)
    frames = MemoryFrameStore(8)
    node = AnchorNode(frames, package, GradientDescriber(), 1.0)
    assert list(node.on(msgspec.structs.replace(ORIGIN, start_sigma_m=start_sigma_m))) == []
    return node, frames


def flown(
    ground: np.ndarray,
    sigma_m: float,
    count: int = FRAMES,
    *,
    mirrored: bool = False,
    kind: type[SingleMapPackage] = DrawnMap,
) -> list[MapMatch]:
    """-> matches of a flight to the east through the middle of the map, predicted without an error. ``sigma_m``: of the
    start."""
    node, frames = started_on(ground, sigma_m, kind)
    matches = []
    for i in range(count):
        at_m = TRUE_M + np.array([(i - FRAMES / 2) * STEP_M, 0.0, 0.0])
        image = view(ground, PINHOLE, R, at_m)
        frames.put(i, np.ascontiguousarray(image[:, ::-1]) if mirrored else image)
        answer, *_ = node.on(predicted(i, sigma_m, at_m=at_m, step_m=STEP_M if i else 0.0))
        assert isinstance(answer, MapMatch)
        matches.append(answer)
    return matches


def error_m(match: MapMatch, i: int) -> float:
    assert match.pose is not None
    true_m = TRUE_M[:2] + np.array([(i - FRAMES / 2) * STEP_M, 0.0])
    return float(np.hypot(*(np.array(match.pose.p_c_in_w_m[:2]) - true_m)))


def test_a_match_on_a_drawn_map_is_a_position_alone(ground: np.ndarray) -> None:
    last = flown(ground, 10.0, 3)[-1]
    assert last.verdict is Verdict.ACCEPTED and last.position_only and last.matches == [] and last.inliers == 0
    assert (last.matcher, last.on_drawn) == ("gradient on vectors", True)
    assert last.map_sigma_m == pytest.approx(6.0 / 2.146, abs=0.001) and error_m(last, 2) < 3.0


def test_the_first_frame_over_rebuilt_ground_is_placed_by_the_drawn_layer(ground: np.ndarray) -> None:
    (match,) = flown(ground, 10.0, 1, kind=BesideOldImagery)
    assert match.on_drawn and match.place is not None
    assert np.hypot(match.place.e_m - (TRUE_M[0] - FRAMES / 2 * STEP_M), match.place.n_m - TRUE_M[1]) < 4.0


@pytest.mark.slow
def test_an_unknown_start_on_a_drawn_map_is_found_by_the_belief(ground: np.ndarray) -> None:
    matches = flown(ground, SEARCHED_M)
    found = next(i for i, match in enumerate(matches) if match.verdict is Verdict.ACCEPTED)
    assert found >= 4  # one frame gives at most 2 nats of the 8.3 that are needed
    lost = matches[:found]
    assert all(match.verdict is Verdict.LOST and match.search.step is SearchStep.WHOLE_MAP for match in lost)
    assert all(match.pose is None and match.search.sigma_m == 1000.0 for match in lost)
    assert matches[found].search.relocalized and matches[found].position_only
    assert matches[found].search.sigma_m == 0.0 and error_m(matches[found], found) < 4.0


@pytest.mark.slow
def test_ground_that_is_not_on_a_drawn_map_is_not_found(ground: np.ndarray) -> None:
    matches = flown(ground, SEARCHED_M, mirrored=True)
    assert {match.verdict for match in matches} == {Verdict.LOST}


def test_places_without_a_mapped_feature_have_no_correlation() -> None:
    rng = np.random.default_rng(3)
    window = rng.uniform(0.0, 1.0, (2, 40, 60)).astype(np.float32)
    template, mask = window[:, 5:15, 8:18].copy(), np.ones((10, 10), bool)
    window[:, :, 30:] = 0.0
    drawn, imagery = (
        CorrelationWindow(window, np.ones((40, 60), bool), drawn).correlate(template, mask) for drawn in (True, False)
    )
    assert np.isneginf(drawn[:, 30:]).all() and np.isfinite(drawn[:, :20]).all()
    assert np.array_equal(drawn[:, :20], imagery[:, :20]) and np.isfinite(imagery).all()
    assert np.unravel_index(int(np.argmax(drawn)), drawn.shape) == (5, 8)
