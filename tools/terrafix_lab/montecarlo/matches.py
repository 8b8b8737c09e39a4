"""MapMatch as the anchor publishes it: patches of the frame on a map with errors, then the real PnP.

The mode of the belief is the camera position that the frame shows, if that lies in the search window of the prediction.
Elsewhere the anchor's filter runs on simulated correlation surfaces (tracked_belief.py). Views, ground planes and
verdicts are computed as in the anchor."""

import math

import msgspec
import numpy as np

from terrafix.anchor.frame_pose import (
    COARSE_SCORE,
    MIN_POSE_MODE_MASS,
    POSE_LIKELIHOOD_RATIO,
    confirm_pose,
    reported_modes,
    with_belief,
)
from terrafix.anchor.localizer import MIN_OBSERVATION_WEIGHT, NEW_GROUND_SHARE
from terrafix.anchor.matching.frame_matcher import FIX_GSD_PER_AGL, PATCH_PER_AGL, PatchFix, View
from terrafix.anchor.matching.match_message import mode_match, pose_match
from terrafix.anchor.matching.patch_matcher import MAX_PATCHES
from terrafix.anchor.matching.point_mass_filter import Mode, belief_cell_m
from terrafix.anchor.verification.alternative_place import weighed
from terrafix.core.geodesy import quat_from_rot, rot_from_quat
from terrafix.core.limits import MIN_MATCHING_AGL_M
from terrafix.core.pnp import INLIER_THRESHOLD, PNP_MIN_INLIERS, SEARCH_RADIUS, solve
from terrafix.core.pose import log_so3
from terrafix.messages import BeliefSummary, GroundPlane, MapMatch, MatchPlace, PnpInput, Prediction, Verdict
from terrafix_lab.montecarlo.flown import Shot
from terrafix_lab.montecarlo.ground import MAP_SEES_TOPS, MapError, Terrain
from terrafix_lab.montecarlo.lens import TrueLens, footprint_m
from terrafix_lab.montecarlo.tracked_belief import TrackedBelief

FOUND_SHARE = (0.4, 0.9)  # of the patches that are found, on poor and on good ground ...
RIGHT_SHARE = (0.5, 0.98)  # ... and of these at the right place
TEXTURE_S = 25.0  # time constant of the change between poor and good ground
WHITE_SHARE = 0.002  # of the height: 1-sigma of the white error of a patch
WEIGHT = (math.log(0.09), 0.5)  # of the logarithm of a patch weight: mean and 1-sigma on village-1
DEM_ERROR_M = 1.0  # 1-sigma of a constant per flight; the elevation has no local error here
WINDOW_M, WINDOW_SIGMAS = 120.0, 4.0  # half of the search window: at least, and in sigmas of the prediction
HYPOTHESES = 1.5  # sigmas of heading and scale that are searched ...
YAW_TOLERANCE_RAD, SCALE_TOLERANCE = math.radians(6.0), 0.08  # ... and the tolerance of the descriptors beyond
ELSEWHERE_SCORE = 1.5  # mean of the best cell of a mode elsewhere, with a spread of one
MASS, SCORE, SCORE_SPREAD = 0.995, 6.5, 2.0  # of the belief's mode; real flights: mass 0.97 to 1, score 2.8 to 10
GRID = np.array([-0.4, 0.0, 0.4])  # of a patch: points at which the height of objects is sampled


class MapMatches:
    """Call ``match`` for every Prediction, with the true pose of its frame."""

    def __init__(
        self, lens: TrueLens, terrain: Terrain, error: MapError, *, has_dem: bool, map_sigma_m: float, seed: int
    ) -> None:
        self._lens = lens
        self._terrain, self._error = terrain, error
        self._has_dem, self._map_sigma_m = has_dem, map_sigma_m
        self._rng = np.random.default_rng([seed, 56])
        self._texture = float(self._rng.normal())
        self._last_s = 0.0
        self._home_m = terrain.bare_at_m(0.0, 0.0)
        self._dem_error_m = DEM_ERROR_M * float(self._rng.normal())
        self._belief_rng = np.random.default_rng([seed, 62])
        self._belief: TrackedBelief | None = None  # while the frames are not found near their predictions
        self._has_found = False
        self._seen_m = np.full(2, np.inf)  # place that the last frame showed

    def match(self, prediction: Prediction, shot: Shot, *, usable: bool = True) -> MapMatch:
        """``usable`` False: the belief is not updated, since a search is active."""
        result = self.no_match(prediction, shot, verdict=Verdict.AMBIGUOUS)
        good = self._texture_quality(shot.t_s)
        agl_m = _agl_m(prediction, result.ground)
        if agl_m < MIN_MATCHING_AGL_M:
            return msgspec.structs.replace(result, verdict=Verdict.TOO_LOW)
        place = self._apparent(shot, rot_from_quat(prediction.q_w_c), agl_m)
        in_range = self._in_range(prediction, shot, agl_m)
        if not (in_range and self._in_window(prediction, place)):
            return self._match_in_belief(result, prediction, shot, place if in_range else None) if usable else result
        self._belief, self._has_found = None, True
        score = SCORE + SCORE_SPREAD * (float(self._rng.normal()) + 0.5 * (good - 0.5))
        result = msgspec.structs.replace(result, alternative_nats=self._alternative_nats(prediction, place, score))
        mode = Mode(float(place[0]), float(place[1]), MASS, 0.0, belief_cell_m(agl_m, 0.0) ** 2)
        view = _view_at(mode, prediction, agl_m)
        result = msgspec.structs.replace(
            result,
            place=MatchPlace(e_m=mode.e_m, n_m=mode.n_m, mass=MASS),
            belief=BeliefSummary(
                mean_m=(mode.e_m, mode.n_m),
                cov_m2=(mode.var_m2, 0.0, 0.0, mode.var_m2),
                modes=reported_modes([mode]),
                mode_score=score,
            ),
        )
        result = pose_match(result, self._fix(shot, good, view), view)
        if result.verdict is Verdict.ACCEPTED or score < COARSE_SCORE:
            return result
        return mode_match(result, mode, belief_cell_m(agl_m, 0.0), view, None)

    def _alternative_nats(self, prediction: Prediction, place_m: np.ndarray, score: float) -> float | None:
        """Of a frame that shows ``place_m`` (2,), with a correlation of ``score``."""
        new_m, self._seen_m = float(np.hypot(*(place_m - self._seen_m))), place_m
        if prediction.alternative_m is None:
            return None
        new_ground = new_m / (NEW_GROUND_SHARE * footprint_m(self._lens.described, prediction.agl_m))
        there = ELSEWHERE_SCORE + float(self._belief_rng.normal())
        return weighed(there, score, min(max(new_ground, MIN_OBSERVATION_WEIGHT), 1.0))

    def no_match(self, prediction: Prediction, shot: Shot, *, verdict: Verdict, usable: bool = True) -> MapMatch:
        """The match of a frame that is not compared with the map; the arguments of ``match``, and its verdict."""
        return MapMatch(
            t_ns=prediction.t_ns,
            frame_id=prediction.frame_id,
            verdict=verdict,
            matcher="gradient",
            ground=self._plane(prediction),
            map_sigma_m=self._map_sigma_m,
        )

    def _fix(self, shot: Shot, good: float, view: View) -> PatchFix:
        xy, points = self._patches(shot, good)
        weights = np.exp(self._rng.normal(*WEIGHT, len(xy)))
        gsd_share = FIX_GSD_PER_AGL["gradient"]
        given = PnpInput(
            q_w_c=quat_from_rot(view.r_w_c),
            agl_m=view.agl_m,
            sigma_floor=0.3 * gsd_share,
            threshold=INLIER_THRESHOLD,
            search_radius=SEARCH_RADIUS,
            min_inliers=PNP_MIN_INLIERS,
        )
        return PatchFix(xy, points, weights, solve(points, xy, weights, given), gsd_share * view.agl_m, given)

    def _patches(self, shot: Shot, good: float) -> tuple[np.ndarray, np.ndarray]:
        """2D-3D matches: normalised (N, 2) and world points (N, 3), as the map and its elevation have them."""
        rng, camera = self._rng, self._lens.described
        agl_m = float(shot.p_m[2]) - self._terrain.bare_at_m(float(shot.p_m[0]), float(shot.p_m[1]))
        count = round(MAX_PATCHES * _between(FOUND_SHARE, good))
        margin_px = 0.5 * PATCH_PER_AGL * camera.fx
        size = np.array([camera.width, camera.height])
        px = margin_px + rng.uniform(size=(count, 2)) * np.maximum(size - 2.0 * margin_px, 1.0)
        xy = camera.normalise(px)
        rays = self._lens.showing(shot.scale).rays(px) @ shot.r_w_c.T
        places = shot.p_m[:2] + rays[:, :2] * (agl_m / np.maximum(-rays[:, 2:], 0.2))
        for _ in range(3):  # intersection of the ray with the ground plus MAP_SEES_TOPS of the objects on it
            up_m = self._terrain.bare_m(places) + MAP_SEES_TOPS * self._standing(places, PATCH_PER_AGL * agl_m)
            places = shot.p_m[:2] + rays[:, :2] * ((shot.p_m[2] - up_m) / np.maximum(-rays[:, 2], 0.2))[:, None]
        on_map = places + self._error.at(places) + WHITE_SHARE * agl_m * rng.normal(size=(count, 2))
        wrong = rng.uniform(size=count) > _between(RIGHT_SHARE, good)
        on_map[wrong] += SEARCH_RADIUS * agl_m * rng.uniform(-1.0, 1.0, (int(wrong.sum()), 2))
        return xy, np.column_stack([on_map, self._elevation(on_map)])

    def _standing(self, places_m: np.ndarray, side_m: float) -> np.ndarray:
        """Mean height of objects in patches around (N, 2)."""
        de, dn = (axis.ravel() * side_m for axis in np.meshgrid(GRID, GRID))
        asked = places_m[:, None, :] + np.stack([de, dn], 1)[None]
        return self._terrain.standing_m(asked.reshape(-1, 2)).reshape(len(places_m), -1).mean(axis=1)

    def _elevation(self, places_m: np.ndarray) -> np.ndarray:
        """(N,) of the map's elevation model; without one the height of the start."""
        if not self._has_dem:
            return np.full(len(places_m), self._home_m)
        return self._terrain.bare_m(places_m) + self._dem_error_m

    def _plane(self, prediction: Prediction) -> GroundPlane | None:
        """Plane through the ground around the predicted camera, as the anchor fits it."""
        if not self._has_dem:
            return None
        axis = np.linspace(-0.7, 0.7, 7) * prediction.agl_m
        de, dn = (a.ravel() for a in np.meshgrid(axis, axis))
        up = self._elevation(np.stack([de, dn], 1) + prediction.p_c_in_w_m[:2])
        design = np.column_stack([np.ones(len(de)), de, dn])
        plane = np.linalg.lstsq(design, up, rcond=None)[0]
        relief_m = float(np.sqrt(np.mean((up - design @ plane) ** 2)))
        return GroundPlane(amsl_m=float(plane[0]), slope_e=float(plane[1]), slope_n=float(plane[2]), relief_m=relief_m)

    def _apparent(self, shot: Shot, r_w_c: np.ndarray, agl_m: float) -> np.ndarray:
        """(2,) camera position that follows from the assumed rotation and height: the optical axis meets the same
        ground as with the true ones."""
        true, assumed = shot.r_w_c[:, 2], r_w_c[:, 2]
        agl_true_m = float(shot.p_m[2]) - self._terrain.bare_at_m(float(shot.p_m[0]), float(shot.p_m[1]))
        ground_m = shot.p_m[:2] + true[:2] * agl_true_m / max(-float(true[2]), 0.2)
        on_map = ground_m + self._error.at(ground_m[None])[0]
        return np.asarray(on_map - assumed[:2] * agl_m / max(-float(assumed[2]), 0.2))

    def _in_window(self, prediction: Prediction, place_m: np.ndarray) -> bool:
        cov = np.array(prediction.cov).reshape(6, 6)
        window_m = max(WINDOW_M, WINDOW_SIGMAS * float(np.sqrt(max(cov[0, 0], cov[1, 1]))))
        return float(np.abs(place_m - prediction.p_c_in_w_m[:2]).max()) < window_m

    def _in_range(self, prediction: Prediction, shot: Shot, agl_m: float) -> bool:
        """Whether heading, scale and tilt are within the search range of the anchor."""
        cov = np.array(prediction.cov).reshape(6, 6)
        turn = log_so3(shot.r_w_c @ rot_from_quat(prediction.q_w_c).T)
        agl_true_m = float(shot.p_m[2]) - self._terrain.bare_at_m(float(shot.p_m[0]), float(shot.p_m[1]))
        scale_sigma = prediction.agl_sigma_m / max(agl_m, 1.0)
        magnified = shot.scale[0] * shot.scale[1]  # both axes together; below zero: mirrored, which no map shows
        if magnified < 0.0:
            return False
        agl_true_m /= math.sqrt(magnified)
        return bool(
            abs(turn[2]) < HYPOTHESES * math.sqrt(cov[5, 5]) + YAW_TOLERANCE_RAD
            and abs(agl_true_m / agl_m - 1.0) < HYPOTHESES * scale_sigma + SCALE_TOLERANCE
            and float(np.hypot(*turn[:2])) < math.radians(20.0)
        )

    def _match_in_belief(
        self, result: MapMatch, prediction: Prediction, shot: Shot, place_m: np.ndarray | None
    ) -> MapMatch:
        """``place_m`` (2,): apparent position of the camera; None: the frame correlates nowhere."""
        if self._belief is None:
            side_m = footprint_m(self._lens.described, prediction.agl_m)
            self._belief = TrackedBelief(prediction, side_m, at_start=not self._has_found, rng=self._belief_rng)
        tracked, good = self._belief, self._texture_quality(shot.t_s)
        score = SCORE + SCORE_SPREAD * (float(self._belief_rng.normal()) + 0.5 * (good - 0.5))
        modes = tracked.update(prediction, place_m, score)
        result = with_belief(result, tracked.belief, modes, score)
        if modes[0].mass < MIN_POSE_MODE_MASS or not tracked.is_at(modes[0], place_m):
            return result
        view = _view_at(modes[0], prediction, _agl_m(prediction, result.ground))
        result = pose_match(result, self._fix(shot, good, view), view)
        if result.verdict is not Verdict.ACCEPTED:
            return result
        return confirm_pose(result, modes[0], POSE_LIKELIHOOD_RATIO, tracked.belief)

    def _texture_quality(self, t_s: float) -> float:
        """0..1: quality of the ground below for matching, a first-order process in time."""
        keep = math.exp(-(t_s - self._last_s) / TEXTURE_S)
        self._last_s = t_s
        self._texture = keep * self._texture + math.sqrt(1.0 - keep * keep) * float(self._rng.normal())
        return 0.5 * (1.0 + math.erf(self._texture / math.sqrt(2.0)))


def _agl_m(prediction: Prediction, ground: GroundPlane | None) -> float:
    """Predicted height above the map's ground, or the prediction's own without a map elevation."""
    return prediction.agl_m if ground is None else float(prediction.p_c_in_w_m[2]) - ground.amsl_m


def _view_at(mode: Mode, prediction: Prediction, agl_m: float) -> View:
    up_m = float(prediction.p_c_in_w_m[2])
    return View(mode.e_m, mode.n_m, rot_from_quat(prediction.q_w_c), agl_m, up_m - agl_m, 0.0, 0.0, 0.0)


def _between(limits: tuple[float, float], share: float) -> float:
    return limits[0] + share * (limits[1] - limits[0])
