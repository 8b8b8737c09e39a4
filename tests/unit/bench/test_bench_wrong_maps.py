"""Benchmark of flights on maps of other places: segments, scores and rows."""

from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

import map_rasters
from single_map_place import AGL_M, ORIGIN, TRUE_M, R, predicted
from terrafix.messages import Prediction
from terrafix_tools.bench.search import wrong_maps
from terrafix_tools.bench.search.wrong_maps import UNKNOWN_START_M, WrongMap, row, searched
from terrafix_tools.mapping.build import build
from textured_ground import PINHOLE, texture, view

STEP_M = 20.0


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wrong")
    return build(map_rasters.utm(folder / "i.tif", map_rasters.texture(500, 500, seed=4)), folder / "m.gpkg")


def flight(frames: int) -> Iterator[tuple[Prediction, np.ndarray]]:
    ground = texture(8, 400.0)
    for i in range(frames):
        at_m = TRUE_M + np.array([STEP_M * i - 60.0, 0.0, 0.0])
        yield predicted(i, 10.0, at_m=at_m, step_m=STEP_M if i else 0.0), view(ground, PINHOLE, R, at_m)


@pytest.mark.slow
def test_a_flight_on_another_map_has_a_best_score_per_segment_and_finds_no_position(package: Path) -> None:
    result = searched(flight(6), PINHOLE, package, 0.3, 3)
    assert len(result.best) == 3  # every second frame, one segment each
    assert result.found == 0 and max(result.best) < result.needed
    assert len(result.sigmas) > 3 and result.places > 10.0


def test_a_row_shows_the_scores_of_the_best_wrong_positions() -> None:
    result = WrongMap(5000.0, [float(v) for v in range(11)], [0.0], 14.25, 1)
    assert row("a on b", result).split() == ["a", "on", "b", "11", "9.0", "10.0", "14.2", "1", "5000"]


def test_the_start_of_the_flight_is_replaced_by_an_unknown_one() -> None:
    unknown = msgspec.structs.replace(ORIGIN, start_sigma_m=float("inf"))
    assert wrong_maps._with_unknown_start(unknown).start_sigma_m == UNKNOWN_START_M
    assert wrong_maps._with_unknown_start(ORIGIN).start_sigma_m == UNKNOWN_START_M
    assert wrong_maps._with_unknown_start(ORIGIN).lat_deg == ORIGIN.lat_deg
    assert wrong_maps._with_unknown_start(unknown).lat_deg == 0.0
    assert predicted(0, 1.0).agl_m == AGL_M
