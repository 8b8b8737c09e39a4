"""A place that a search proposes, checked with one frame: evidence and pose, right and wrong."""

from dataclasses import replace

import numpy as np
import pytest
from ground import PINHOLE, FlatMap, rotation, texture, view

from terrafix.anchor.matcher import FrameMatcher, View
from terrafix.anchor.place_check import CELL_PER_AGL, FINE_PER_AGL, Checked, PlaceCheck
from terrafix.anchor.tracks import LLR_MAX, evidence
from terrafix.messages import Verdict
from terrafix_engines.features.gradient import GradientDescriber

AGL_M = 100.0
HEADING_DEG = 40.0
HERE_M = np.array([-20.0, 30.0, AGL_M])
PROPOSED = View(
    float(HERE_M[0]) + 5.0,
    float(HERE_M[1]) - 4.0,
    rotation(HEADING_DEG + 5.0),
    1.04 * AGL_M,
    0.0,
    float(np.radians(10.0)),
    0.05,
    float(np.radians(2.0)),
)


@pytest.fixture(scope="module")
def check() -> PlaceCheck:
    source = FlatMap(texture(8, 400.0))
    return PlaceCheck(source, FrameMatcher(PINHOLE, source, GradientDescriber()))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    return view(texture(8, 400.0), PINHOLE, rotation(HEADING_DEG), HERE_M)


def at(check: PlaceCheck, picture: np.ndarray, proposed: View, cell_per_agl: float = CELL_PER_AGL) -> Checked:
    found = check.at(picture, proposed, cell_per_agl)
    assert found is not None
    return found


@pytest.mark.parametrize("cell_per_agl", [CELL_PER_AGL, FINE_PER_AGL])
def test_the_right_place_is_told_with_its_pose(check: PlaceCheck, picture: np.ndarray, cell_per_agl: float) -> None:
    found = at(check, picture, PROPOSED, cell_per_agl)
    assert evidence(found.agreement) == LLR_MAX
    pose = found.fix.pnp.fit
    assert pose is not None and found.fix.pnp.verdict is Verdict.ACCEPTED
    off_m = pose.p_c_in_w_m - HERE_M
    # Place and tilt change places: five metres are three degrees.
    assert np.linalg.norm(off_m) < 5.0
    assert off_m[:2] @ np.linalg.solve(_position_cov(found), off_m[:2]) < 9.2  # 99 % of two numbers


def _position_cov(found: Checked) -> np.ndarray:
    fit = found.fix.pnp.fit
    assert fit is not None
    return np.asarray((fit.r_w_c @ fit.cov[3:, 3:] @ fit.r_w_c.T)[:2, :2])


@pytest.mark.parametrize("away_m", [(60.0, -70.0), (50.0, 70.0), (-70.0, -60.0)])
def test_wrong_places_come_to_what_chance_does(
    check: PlaceCheck, picture: np.ndarray, away_m: tuple[float, float]
) -> None:
    wrong = replace(PROPOSED, e_m=PROPOSED.e_m + away_m[0], n_m=PROPOSED.n_m + away_m[1])
    assert evidence(at(check, picture, wrong).agreement) < 2.0


def test_off_the_map_there_is_nothing_to_check(check: PlaceCheck, picture: np.ndarray) -> None:
    assert check.at(picture, replace(PROPOSED, e_m=900.0), CELL_PER_AGL) is None
