"""Place verifier: evidence and pose at right and wrong places."""

from dataclasses import replace

import cv2
import msgspec
import numpy as np
import pytest

from map_matches import pose_of
from terrafix.anchor.matching.frame_matcher import FrameMatcher, View
from terrafix.anchor.matching.match_message import relocalized_match
from terrafix.anchor.verification.hypothesis_tracker import TRACK_LLR_MAX, evidence
from terrafix.anchor.verification.patch_null import PatchNull
from terrafix.anchor.verification.place_verifier import (
    FINE_PLACE_CELL_PER_AGL,
    PLACE_CELL_PER_AGL,
    PlaceVerifier,
    VerifiedPlace,
)
from terrafix.messages import MapMatch, MatchPlace, Verdict
from terrafix_engines.features.gradient import GradientDescriber
from textured_ground import GSD_M, PINHOLE, FlatMap, rotation, texture, view

AGL_M = 100.0
HEADING_DEG = 40.0
HERE_M = np.array([-20.0, 30.0, AGL_M])
PROPOSED_VIEW = View(
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
def verifier() -> PlaceVerifier:
    source = FlatMap(texture(8, 400.0))
    return PlaceVerifier(FrameMatcher(PINHOLE, source, GradientDescriber()))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    return view(texture(8, 400.0), PINHOLE, rotation(HEADING_DEG), HERE_M)


def verified_place(
    verifier: PlaceVerifier, image: np.ndarray, proposed: View, cell_per_agl: float = PLACE_CELL_PER_AGL
) -> VerifiedPlace:
    found = verifier.verify(image, proposed, cell_per_agl)
    assert found is not None
    return found


@pytest.mark.parametrize("cell_per_agl", [PLACE_CELL_PER_AGL, FINE_PLACE_CELL_PER_AGL])
def test_the_right_place_has_full_evidence_and_the_right_pose(
    verifier: PlaceVerifier, image: np.ndarray, cell_per_agl: float
) -> None:
    found = verified_place(verifier, image, PROPOSED_VIEW, cell_per_agl)
    assert evidence(PatchNull().sigmas(found.consensus, fine=cell_per_agl == FINE_PLACE_CELL_PER_AGL)) == TRACK_LLR_MAX
    pose = found.fix.pnp.fit
    assert pose is not None and found.fix.pnp.verdict is Verdict.ACCEPTED
    off_m = pose.p_c_in_w_m - HERE_M
    # Position and tilt are correlated: five metres correspond to three degrees.
    assert np.linalg.norm(off_m) < 5.0
    assert off_m[:2] @ np.linalg.solve(_position_cov(found), off_m[:2]) < 9.2  # chi-square, 2 degrees of freedom, 99 %


def _position_cov(found: VerifiedPlace) -> np.ndarray:
    fit = found.fix.pnp.fit
    assert fit is not None
    return np.asarray((fit.r_w_c @ fit.cov[3:, 3:] @ fit.r_w_c.T)[:2, :2])


@pytest.mark.parametrize("away_m", [(60.0, -70.0), (50.0, 70.0), (-70.0, -60.0)])
def test_wrong_places_score_like_the_null_model(
    verifier: PlaceVerifier, image: np.ndarray, away_m: tuple[float, float]
) -> None:
    wrong = replace(PROPOSED_VIEW, e_m=PROPOSED_VIEW.e_m + away_m[0], n_m=PROPOSED_VIEW.n_m + away_m[1])
    assert evidence(PatchNull().sigmas(verified_place(verifier, image, wrong).consensus, fine=False)) < 2.0


def test_a_place_off_the_map_is_not_verified(verifier: PlaceVerifier, image: np.ndarray) -> None:
    assert verifier.verify(image, replace(PROPOSED_VIEW, e_m=900.0), PLACE_CELL_PER_AGL) is None


def leaning(ground: np.ndarray, seed: int) -> np.ndarray:
    """The ground in another image: its objects lean, blocks of 80 m together, by 2 m on each axis."""
    rng, side, blocks = np.random.default_rng(seed), len(ground), len(ground) * GSD_M / 80.0
    aside = [rng.normal(0.0, 2.0 / GSD_M, (round(blocks), round(blocks))).astype(np.float32) for _ in range(2)]
    dx, dy = (cv2.resize(a, (side, side), interpolation=cv2.INTER_LINEAR) for a in aside)
    x, y = np.meshgrid(np.arange(side, dtype=np.float32), np.arange(side, dtype=np.float32))
    return cv2.remap(ground, x + dx, y + dy, cv2.INTER_LINEAR)


@pytest.mark.slow
def test_the_covariance_of_a_relocalized_pose_covers_the_displacement_by_leaning_ground(
    verifier: PlaceVerifier,
) -> None:
    """The mean NEES of two numbers over twelve places is below 3.3 with a probability of 97.5 % if the covariance is
    exact."""
    ground, nees = texture(8, 400.0), []
    empty = MapMatch(t_ns=0, frame_id=0, verdict=Verdict.LOST, matcher="gradient")
    for seed in range(12):
        here_m = HERE_M.copy()
        here_m[:2] += np.random.default_rng(seed).uniform(-40.0, 40.0, 2)
        image = view(leaning(ground, seed), PINHOLE, rotation(HEADING_DEG), here_m)
        proposed = replace(PROPOSED_VIEW, e_m=float(here_m[0]) + 5.0, n_m=float(here_m[1]) - 4.0, tilt_sigma_rad=0.005)
        fix = verified_place(verifier, image, proposed, FINE_PLACE_CELL_PER_AGL).fix
        before = msgspec.structs.replace(empty, place=MatchPlace(e_m=proposed.e_m, n_m=proposed.n_m, mass=1.0))
        match = relocalized_match(before, fix, proposed, (0.0, 0.0))
        assert match.verdict is Verdict.ACCEPTED and match.search.relocalized and match.pose is not None
        off_m = np.array(match.pose.p_c_in_w_m[:2]) - here_m[:2]
        nees.append(off_m @ np.linalg.solve(np.array(match.pose.cov).reshape(6, 6)[:2, :2], off_m))
    assert np.mean(nees) < 3.3 and max(nees) < 13.8  # 99.9 % of a single one


def test_the_innovation_between_frames_is_added_to_the_covariance(verifier: PlaceVerifier, image: np.ndarray) -> None:
    fix = verified_place(verifier, image, PROPOSED_VIEW).fix
    before = MapMatch(
        t_ns=0,
        frame_id=0,
        verdict=Verdict.LOST,
        matcher="gradient",
        place=MatchPlace(e_m=PROPOSED_VIEW.e_m, n_m=PROPOSED_VIEW.n_m, mass=1.0),
    )
    still, jumped = (
        pose_of(relocalized_match(before, fix, PROPOSED_VIEW, innovation_m)).cov
        for innovation_m in ((0.0, 0.0), (6.0, -8.0))
    )
    more = (np.array(jumped) - np.array(still)).reshape(6, 6)
    assert more[:2, :2] == pytest.approx(np.array([[36.0, -48.0], [-48.0, 64.0]]))
    assert not more[2:].any()
