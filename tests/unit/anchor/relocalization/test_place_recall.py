"""Single frames on imagery of two dates (SV-9): places among the best five, and matches of frames of right heading."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rasterio.transform import Affine

import map_rasters
from terrafix.anchor.relocalization.map_search import MapSearch
from terrafix.anchor.verification.hypothesis_tracker import MERGE_RADIUS
from terrafix.core.errors import MapError
from terrafix.map.null_model import DEFAULT_NULL, FalseAlarmBudget
from terrafix_tools.mapping.check.sight import MatchabilityProbe
from terrafix_tools.models.two_dates import TrueView, TwoDates
from textured_ground import texture

REQUIRED, AMONG, PLACES, SEED = 0.85, 5, 80, 1
NIGHTLY = ("joplin", "adiyaman-6", "gaziantep-2")  # towns
SETS = {
    "joplin": ("imagery/joplin/after.tif", "imagery/joplin/before.tif", 130.0),
    "adiyaman-6": ("imagery/adiyaman-6/winter.tif", "imagery/adiyaman-6/dry.tif", 90.0),
    "gaziantep-2": ("imagery/gaziantep-2/winter.tif", "imagery/gaziantep-2/dry.tif", 90.0),
    "prairie": ("imagery/prairie/20180716.tif", "imagery/prairie/20120731.tif", 800.0),
}
MATCHED = 0.95  # required share of frames of right heading that are matched
UNMATCHED = {"joplin": 0.87, "adiyaman-6": 0.76, "gaziantep-2": 0.79}  # as SHORT, of MATCHED
# Sets that do not reach REQUIRED yet, with the share that they reached when this was written, less three places.
SHORT = {"joplin": 0.68, "adiyaman-6": 0.70, "gaziantep-2": 0.78}


def recall(dates: TwoDates, agl_m: float, places: int) -> float:
    """Share of ``places`` frames of unknown heading whose true place is among the best AMONG that the joint
    correlation of the search proposes."""
    source, matcher = dates.open()

    def is_found(view: TrueView) -> bool:
        search = MapSearch(source, matcher, agl_m, None, DEFAULT_NULL, FalseAlarmBudget())
        search.correlate_region(view.frame, view.predicted)
        best_m = np.array([(place.e_m, place.n_m) for place in search.proposed[:AMONG]])
        return bool((np.hypot(*(best_m - view.place_m).T) <= MERGE_RADIUS * agl_m).any())

    return float(np.mean([is_found(view) for view in dates.draw(places, agl_m, SEED)]))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.nightly) if name in NIGHTLY else name for name in SETS]
)
def test_the_right_place_is_among_the_best_five_as_often_as_required(
    data_set: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first, second, agl_m = SETS[name]
    found = recall(TwoDates(data_set(first), data_set(second)), agl_m, PLACES)
    if name in SHORT:
        assert found >= SHORT[name], f"{name} is known to be short of {REQUIRED}, and became worse"
        assert found <= REQUIRED, f"{name} passes now: take it off the list SHORT"
    else:
        assert found > REQUIRED


@pytest.mark.slow
@pytest.mark.parametrize("name", SETS)
def test_a_frame_of_right_heading_is_matched_as_often_as_required(
    data_set: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first, second, agl_m = SETS[name]
    dates = TwoDates(data_set(first), data_set(second))
    source, matcher = dates.open()
    probe = MatchabilityProbe(source, source.layers[0], matcher.camera, agl_m, start_sigma_m=10.0)
    rng, found = np.random.default_rng(SEED), list[bool]()
    for view in dates.draw(PLACES, agl_m, SEED):
        place_m = float(view.place_m[0]), float(view.place_m[1])
        found.append(probe.is_placed(view.frame, probe.prediction(place_m, -view.heading_rad, rng), place_m))
    share = np.mean(found)
    assert share > MATCHED if name not in UNMATCHED else UNMATCHED[name] <= share <= MATCHED


@pytest.fixture(scope="module")
def dates(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two images of the same ground; the second begins 30 px further east and 20 px further south."""
    folder = tmp_path_factory.mktemp("dates")
    ground = np.ascontiguousarray(texture(6, 300.0)[:880])
    first = map_rasters.utm(folder / "first.tif", ground[:, :, ::-1].transpose(2, 0, 1))
    later = np.ascontiguousarray(ground[20:, 30:, ::-1].transpose(2, 0, 1))
    moved = Affine(0.5, 0, 300_015.0, 0, -0.5, 2_599_990.0)
    return first, map_rasters.write_tif(folder / "second.tif", later, "EPSG:32651", moved)


def test_a_view_shows_the_ground_of_its_place_at_its_heading(
    dates: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The pixel of a ground point by the pinhole model is that of the map's window there."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    pair, agl_m = TwoDates(*dates), 60.0
    source, _ = pair.open()
    for view in pair.draw(2, agl_m, 3):
        assert abs(view.predicted.agl_m / agl_m - 1.0) <= 0.03
        for column, row in ((100, 90), (320, 240), (540, 400)):
            right, down = (column - 319.5) / 554.0 * agl_m, (row - 239.5) / 554.0 * agl_m
            cos, sin = np.cos(view.heading_rad), np.sin(view.heading_rad)
            e_m, n_m = view.place_m + np.array([right * cos - down * sin, -right * sin - down * cos])
            ground, _ = source.window(e_m - 0.5, n_m + 0.5, 10, 10, 0.1)
            seen = view.frame[row - 4 : row + 5, column - 4 : column + 5]
            assert seen.mean(axis=(0, 1)) == pytest.approx(ground.mean(axis=(0, 1)), abs=6.0)


@pytest.mark.slow
def test_places_of_the_same_ground_are_found(
    dates: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    pair = TwoDates(*dates)
    assert recall(pair, 60.0, 3) == 1.0
    with pytest.raises(MapError, match="too small for frames at 900 m"):
        recall(pair, 900.0, 1)
