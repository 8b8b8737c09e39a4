"""A place that a search proposes, checked with one frame: evidence and pose, right and wrong."""

from dataclasses import replace

import cv2
import msgspec
import numpy as np
import pytest

from ground import GSD_M, PINHOLE, FlatMap, rotation, texture, view
from terrafix.anchor.matching.frame_matcher import FrameMatcher, View
from terrafix.anchor.matching.match_message import found as said_found
from terrafix.anchor.relocalization.hypothesis_tracker import LLR_MAX, evidence
from terrafix.anchor.verification.patch_null import PatchNull
from terrafix.anchor.verification.place_verifier import CELL_PER_AGL, FINE_PER_AGL, Checked, PlaceCheck
from terrafix.messages import MapMatch, Verdict
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
    assert evidence(PatchNull().sigmas(found.agreement, fine=cell_per_agl == FINE_PER_AGL)) == LLR_MAX
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
    assert evidence(PatchNull().sigmas(at(check, picture, wrong).agreement, fine=False)) < 2.0


def test_off_the_map_there_is_nothing_to_check(check: PlaceCheck, picture: np.ndarray) -> None:
    assert check.at(picture, replace(PROPOSED, e_m=900.0), CELL_PER_AGL) is None


def leaning(ground: np.ndarray, seed: int) -> np.ndarray:
    """The ground of another picture: what stands on it leans, whole blocks of 80 m together, by 2 m on each axis."""
    rng, side, blocks = np.random.default_rng(seed), len(ground), len(ground) * GSD_M / 80.0
    aside = [rng.normal(0.0, 2.0 / GSD_M, (round(blocks), round(blocks))).astype(np.float32) for _ in range(2)]
    dx, dy = (cv2.resize(a, (side, side), interpolation=cv2.INTER_LINEAR) for a in aside)
    x, y = np.meshgrid(np.arange(side, dtype=np.float32), np.arange(side, dtype=np.float32))
    return cv2.remap(ground, x + dx, y + dy, cv2.INTER_LINEAR)


def test_what_is_found_claims_what_leaning_ground_takes_it_aside(check: PlaceCheck) -> None:
    """Mean NEES of two numbers over twelve places is below 3.3 in 97.5 of 100 cases when claims are exact."""
    ground, nees = texture(8, 400.0), []
    empty = MapMatch(t_ns=0, frame_id=0, verdict=Verdict.LOST, matcher="gradient")
    for seed in range(12):
        here_m = HERE_M.copy()
        here_m[:2] += np.random.default_rng(seed).uniform(-40.0, 40.0, 2)
        picture = view(leaning(ground, seed), PINHOLE, rotation(HEADING_DEG), here_m)
        proposed = replace(PROPOSED, e_m=float(here_m[0]) + 5.0, n_m=float(here_m[1]) - 4.0, tilt_sigma_rad=0.005)
        fix = at(check, picture, proposed, FINE_PER_AGL).fix
        before = msgspec.structs.replace(empty, mode_e_m=proposed.e_m, mode_n_m=proposed.n_m)
        said = said_found(before, fix, proposed, (0.0, 0.0))
        assert said.verdict is Verdict.ACCEPTED and said.found and said.p_c_in_w_m is not None and said.cov is not None
        off_m = np.array(said.p_c_in_w_m[:2]) - here_m[:2]
        nees.append(off_m @ np.linalg.solve(np.array(said.cov).reshape(6, 6)[:2, :2], off_m))
    assert np.mean(nees) < 3.3 and max(nees) < 13.8  # 99.9 % of one


def test_a_place_that_jumps_from_frame_to_frame_claims_as_little(check: PlaceCheck, picture: np.ndarray) -> None:
    fix = at(check, picture, PROPOSED).fix
    before = MapMatch(
        t_ns=0, frame_id=0, verdict=Verdict.LOST, matcher="gradient", mode_e_m=PROPOSED.e_m, mode_n_m=PROPOSED.n_m
    )
    still, jumped = (said_found(before, fix, PROPOSED, jump_m).cov for jump_m in ((0.0, 0.0), (6.0, -8.0)))
    assert still is not None and jumped is not None
    more = (np.array(jumped) - np.array(still)).reshape(6, 6)
    assert more[:2, :2] == pytest.approx(np.array([[36.0, -48.0], [-48.0, 64.0]]))
    assert not more[2:].any()
