"""Localization of one frame on the map: correlation, point-mass filter, camera pose, verdict."""

from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np

from terrafix.anchor.fragment_labels import FragmentLabels
from terrafix.anchor.frame_pose import (
    COARSE_SCORE,
    MIN_POSE_MODE_MASS,
    MODE_MASS,
    REPORTED_MODES,
    Observation,
    PoseResult,
    decide,
    estimate_pose,
    heading_is_unknown,
    with_belief,
)
from terrafix.anchor.matching.descriptor_cache import Describer
from terrafix.anchor.matching.frame_matcher import AS_PREDICTED, Hypothesis, View, view_at
from terrafix.anchor.matching.layer_selector import POOR_SCORE
from terrafix.anchor.matching.map_layers import MapLayer, MapLayers
from terrafix.anchor.matching.match_message import mode_match, pose_match
from terrafix.anchor.matching.point_mass_filter import MAX_HALF_CELLS, Belief, Mode, belief_cell_m
from terrafix.anchor.matching.predicted_view import (
    VAR_E,
    VAR_N,
    VAR_STEP_E,
    VAR_STEP_N,
    ground_plane,
    position_sigma_m,
    tilt_sigma_rad,
    view_of,
)
from terrafix.anchor.relocalization.map_search import MapSearch
from terrafix.anchor.relocalization.position_prior import distance_outside_m
from terrafix.anchor.relocalization.relocalizer import (
    LOST_SIGMA_M,
    Relocalizer,
    mixed_sigma_m,
    search_centre,
    unknown_sigma_m,
)
from terrafix.anchor.verification.alternative_place import alternative_nats
from terrafix.anchor.verification.converged_place import PlaceTest
from terrafix.anchor.verification.image_shape import AS_DESCRIBED, STRETCHES, ImageShape
from terrafix.anchor.verification.lock_monitor import START_LOG_ODDS, LockMonitor, has_wide_sigma
from terrafix.anchor.verification.single_frame import LIKELIHOOD_RATIO, MAX_MODES, localize_single_frame
from terrafix.core.camera import CameraCalibration, Readout
from terrafix.core.gate import SIGMAS_95
from terrafix.core.geodesy import LocalFrame, rot_from_quat
from terrafix.core.initial_position import SEARCH_START_SIGMA_M, START_WINDOW_MAX_M, START_WINDOW_SIGMAS
from terrafix.core.limits import MIN_MATCHING_AGL_M
from terrafix.core.node import Image
from terrafix.map.null_model import FalseAlarmBudget
from terrafix.messages import (
    ON_DRAWN,
    HintVerdict,
    MapMatch,
    MatchPlace,
    Origin,
    PositionHint,
    Prediction,
    SearchResult,
    SearchStep,
    Verdict,
)

NEW_GROUND_SHARE = 0.35  # share of the footprint: motion after which an observation counts in full [tuned]
MIN_OBSERVATION_WEIGHT = 0.08  # weight of another observation of the same ground [tuned]
# Of a start coordinate that is wrong by far more than its 1-sigma: the belief's uniform share until a pose confirms the
# position. [tuned]
START_UNIFORM_SHARE = float(np.exp(-START_LOG_ODDS))
# 1-sigma, metres: the apparent position also contains the tilt error, which is not known at the start [tuned]
START_SIGMA_FLOOR_M = 8.0
# Radians, upper bound of the process noise by tilt: the belief follows the position from which the image seems to be
# taken, and a change of the tilt error by one degree between frames moves it. A tilt that is known better contributes
# less. It is added per frame, and a slow copter at two frames a second observes little new ground to remove it. [tuned]
TILT_JITTER = 0.02
MAX_POOR_WEIGHT = 4.0  # consecutive full observations below it before the window is widened [tuned]
WIDEN_FACTOR = 1.6  # of the window's half width [tuned]
CELL_RATIO_MIN, CELL_RATIO_MAX = 0.4, 2.5  # hysteresis of a belief cell's octave [tuned]
OFF_MAP_SIGMAS = 3.0  # sigmas outside of the map within which the vehicle may still be over it [tuned]
SEARCH_SIGMAS = 2.0  # 1-sigmas of the position that the belief of a search holds at least [spec: 95 % per axis]
FOUND_SIGMA_M = 10.0  # 1-sigma of a relocalized place, for the initial belief there [tuned]


class Localizer:
    """State of the localization in one flight. Per frame: ``predict``, ``apply_prior`` if there is one, ``localize``,
    ``label_step``.

    ``layers``: the map in the local frame of a flight, for its camera; None: there is no map.
    """

    def __init__(
        self, describer: Describer, layers: Callable[[LocalFrame, CameraCalibration, Describer], MapLayers] | None
    ) -> None:
        self._describer, self._layers_of = describer, layers
        self._layers: MapLayers | None = None
        self._origin: Origin | None = None
        self._ground_m = 0.0
        self.reset()

    def reset(self) -> None:
        """Discards all knowledge of the position."""
        self._belief: Belief | None = None
        self._lock_monitor = LockMonitor()
        self._relocalizer = Relocalizer()
        self._single_frame_budget = FalseAlarmBudget()
        self._place_test: PlaceTest | None = None  # while a drawn map is searched
        self._place_budget = FalseAlarmBudget()
        self._shape = ImageShape()
        self._untested_weight = 0.0  # of the observations since the shape of the images was tested
        self._since_observation_m = np.inf  # motion since the last observation
        self._since_single_frame_m = np.inf  # motion since a place was last sought by the patches of one frame
        self._scale_matched = False  # the last frame had a pose at the predicted scale
        self._poor_weight = 0.0
        self._variance_m2 = 0.0  # horizontal position variance of the last prediction
        self._labels = FragmentLabels()

    @property
    def is_ready(self) -> bool:
        """Whether there is a map, and an origin of the flight on it."""
        return self._layers is not None

    @property
    def search(self) -> MapSearch | None:
        """The running search, for who shows it; None: none."""
        return self._relocalizer.search

    def begin_flight(self, origin: Origin) -> None:
        """Binds the map to the flight's local frame and camera."""
        self._origin = origin
        self._ground_m = origin.ground_amsl_m or 0.0
        self.reset()
        self._open_layers(origin)

    def _open_layers(self, origin: Origin) -> None:
        if self._layers_of is not None:
            frame, camera = LocalFrame(origin.lat_deg, origin.lon_deg), CameraCalibration.of(origin.camera)
            self._layers = self._layers_of(frame, camera, self._describer)

    def replace_describer(self, describer: Describer, agl_m: float) -> None:
        """Continues with another describer. The belief is kept; a running search restarts."""
        self._describer = describer
        if self._origin is not None and self._layers is not None:
            self._open_layers(self._origin)
            if self._relocalizer.is_active:
                self._relocalizer.start(self._layers.best, agl_m, None)

    def _start_search(self, best: MapLayer, agl_m: float, around_m: tuple[float, float] | None, sigma_m: float) -> None:
        """Searches the map around a position with 1-sigma ``sigma_m``; None: the whole map. On a drawn layer the belief
        itself is the search: no patch of it tells one place from another."""
        if not best.drawn:
            self._relocalizer.start(best, agl_m, around_m)
            return
        e_min, n_min, e_max, n_max = best.map.bounds_m
        e_m, n_m = around_m or (0.5 * (e_min + e_max), 0.5 * (n_min + n_max))
        cell_m = belief_cell_m(agl_m, best.matcher.correlation_cell_m(agl_m))
        spread_m = min(sigma_m, 0.5 * max(e_max - e_min, n_max - n_min))  # there is no likelihood beyond the map
        while SEARCH_SIGMAS * spread_m > MAX_HALF_CELLS * cell_m:
            cell_m *= 2.0
        self._belief = Belief(e_m, n_m, spread_m, cell_m)
        self._place_test = PlaceTest(self._place_budget)
        self._relocalizer.sigma_m = unknown_sigma_m(best.map)

    def predict(self, prediction: Prediction) -> None:
        """Moves belief and search by odometry. The first prediction of a flight initialises the belief."""
        if self._layers is None or self._origin is None:
            return
        r_w_c = rot_from_quat(prediction.q_w_c)
        readout = Readout.of(self._origin.camera, prediction.readout_motion, r_w_c)
        self._layers.set_lens(prediction.radial_k1, readout)
        best = self._layers.best
        cell_m = belief_cell_m(prediction.agl_m, best.matcher.correlation_cell_m(prediction.agl_m))
        step_m = float(np.hypot(*prediction.step_m))
        variance = max(prediction.cov[VAR_E], prediction.cov[VAR_N])
        step_var = max(prediction.step_cov_m2[VAR_STEP_E], prediction.step_cov_m2[VAR_STEP_N])
        # Without matches the position error grows by the velocity error, faster than the sum of the steps' own errors.
        growth = variance - self._variance_m2
        self._variance_m2 = variance
        unknown_heading = heading_is_unknown(prediction)  # the direction of the step is unknown
        sigma_m = float(np.sqrt(step_var if unknown_heading else max(step_var, growth)))
        if self._belief is None:
            sigma_m = self._initialize_belief(prediction, best, self._origin, cell_m)
        elif self._relocalizer.is_active:
            # The search has its own yaw and scale per track, so their error is not part of the step's error.
            self._relocalizer.predict(prediction.step_m, float(np.sqrt(step_var)))
        else:
            if unknown_heading:
                sigma_m = float(np.sqrt(max(step_var + step_m**2, growth)))
            self._relocalizer.predict(prediction.step_m, float(np.sqrt(step_var)))  # for the sequential test
            predict_belief(self._belief, prediction, sigma_m, cell_m)
        moved_m = float(np.hypot(step_m, sigma_m))
        self._since_observation_m += moved_m
        self._since_single_frame_m += moved_m

    def _initialize_belief(self, prediction: Prediction, best: MapLayer, origin: Origin, cell_m: float) -> float:
        """Belief around the first prediction; starts a search if the start is unknown. -> 1-sigma of the belief."""
        e_m, n_m, _ = prediction.p_c_in_w_m
        start = position_sigma_m(prediction)
        self._belief, sigma_m = initial_belief(prediction, cell_m)
        # A prediction more precise than that start was found before: this process was restarted in flight.
        if origin.start_sigma_m > SEARCH_START_SIGMA_M and start > 0.5 * SEARCH_START_SIGMA_M:
            around_m = search_centre(e_m, n_m, origin.start_sigma_m, best.map)
            self._start_search(best, prediction.agl_m, around_m, origin.start_sigma_m)
        return sigma_m

    def apply_prior(self, hint: PositionHint, prediction: Prediction) -> HintVerdict:
        """An external position prior at this prediction; needs ``is_ready``."""
        assert self._layers is not None and self._origin is not None
        best = self._layers.best
        verdict = self._relocalizer.apply_prior(hint, self._origin, prediction, best, self._lock_monitor.log_odds)
        if best.drawn and self._relocalizer.is_active:
            self._relocalizer.stop()
            place_m = LocalFrame(self._origin.lat_deg, self._origin.lon_deg).to_local(hint.lat_deg, hint.lon_deg)
            self._start_search(best, prediction.agl_m, place_m, hint.radius_m / SIGMAS_95)
        return verdict

    def localize(self, prediction: Prediction, image: Image | None) -> MapMatch:
        """Matches the frame of this prediction with the map. ``image`` None: the frame is not usable. Raises
        ModelRunError."""
        match = self.no_match(prediction, Verdict.OUTSIDE_MAP)
        if self._layers is None or self._belief is None:
            return match
        best = self._layers.best
        match = msgspec.structs.replace(match, map_sigma_m=best.sigma_m, radial_k1=prediction.radial_k1)
        if self._relocalizer.is_active:
            return self._search(match, prediction, image, best)
        if image is None:
            return with_step(msgspec.structs.replace(match, verdict=Verdict.BAD_IMAGE), SearchStep.SKIP)
        return self._track(match, prediction, image, self._layers, self._belief)

    def no_match(self, prediction: Prediction, verdict: Verdict) -> MapMatch:
        """A MapMatch without a result."""
        return MapMatch(
            t_ns=prediction.t_ns,
            frame_id=prediction.frame_id,
            verdict=verdict,
            matcher=self._describer.name,
            search=SearchResult(sigma_m=self._relocalizer.sigma_m),
            aspect_ratio=self._shape.ratio,
        )

    def skipped(self, prediction: Prediction, verdict: Verdict) -> MapMatch:
        """The MapMatch of a frame that was not matched: the learned model failed, or the computer is hot. A running
        search stays LOST."""
        match = with_step(self.no_match(prediction, verdict), SearchStep.SKIP)
        return self._relocalizer.search_match(match) if self._relocalizer.is_active else match

    def label_step(self, match: MapMatch, prediction: Prediction) -> MapMatch:
        """``match`` with the step of the search escalation, where that is a new fragment or a merge."""
        step = self._labels.step_of(match, prediction)
        return match if step is None else with_step(match, step)

    def _search(self, match: MapMatch, prediction: Prediction, image: Image | None, best: MapLayer) -> MapMatch:
        usable = image if prediction.agl_m >= MIN_MATCHING_AGL_M else None
        match = self._relocalizer.process_frame(match, prediction, usable, best, self._ground_m)
        if match.search.relocalized:
            assert match.place is not None
            self._lock_monitor = LockMonitor()
            cell_m = belief_cell_m(prediction.agl_m, best.matcher.correlation_cell_m(prediction.agl_m))
            self._belief = Belief(match.place.e_m, match.place.n_m, FOUND_SIGMA_M, cell_m)
        return match

    def _track(
        self, match: MapMatch, prediction: Prediction, image: Image, layers: MapLayers, belief: Belief
    ) -> MapMatch:
        """Update of the belief with one frame, and the pose in its best mode."""
        best = layers.best
        e_m, n_m, _ = prediction.p_c_in_w_m
        ground = ground_plane(best.map, e_m, n_m, prediction.agl_m)
        view = self._tracked_view(view_of(prediction, ground, self._ground_m))
        match = msgspec.structs.replace(match, ground=ground)
        if view.agl_m < MIN_MATCHING_AGL_M:
            return msgspec.structs.replace(match, verdict=Verdict.TOO_LOW)
        seen = self._correlate(image, view, layers, belief)
        matcher = f"{match.matcher}{ON_DRAWN}" if seen.layer.drawn else match.matcher
        match = msgspec.structs.replace(match, map_sigma_m=seen.layer.sigma_m, matcher=matcher)
        if seen.correlation.verdict is Verdict.OUTSIDE_MAP and self._may_be_on_map(best, prediction):
            # Dead reckoning over minutes can leave the map; no further correlation would be possible there.
            self._start_search(best, prediction.agl_m, None, unknown_sigma_m(best.map))
            return self._relocalizer.search_match(match)
        if seen.correlation.verdict is not Verdict.ACCEPTED:
            return msgspec.structs.replace(match, verdict=seen.correlation.verdict)
        self._since_observation_m = 0.0
        evidence_nats = belief.update(seen.correlation.surfaces, seen.weight)
        modes = belief.modes(REPORTED_MODES)
        hypothesis, score = seen.correlation.best_at(modes[0].e_m, modes[0].n_m)
        self._widen_if_poor(belief, score, seen.weight)
        match = with_belief(match, belief, modes, score)
        nats = alternative_nats(prediction, modes[0], seen)
        match = msgspec.structs.replace(match, alternative_nats=nats)
        self._test_shape(seen, belief, hypothesis, score)
        found = self._place_test is not None
        if self._place_test is not None:
            passed = self._has_passed(self._place_test, modes[0], seen, score, evidence_nats)
            # A position alone does not give a heading that nobody reports.
            if not passed or heading_is_unknown(prediction):
                return with_step(self._relocalizer.search_match(match), SearchStep.WHOLE_MAP)
            self._place_test, self._relocalizer.sigma_m, self._lock_monitor = None, 0.0, LockMonitor()
        sigma_m = position_sigma_m(prediction)
        pose = estimate_pose(match, prediction, seen, modes[0], hypothesis)
        # Not "seen.new >= 1": a copter's observations are closer to each other than that, and none would be used.
        is_new_ground = self._since_single_frame_m >= NEW_GROUND_SHARE * seen.footprint_m
        is_placed = pose.match.verdict is Verdict.ACCEPTED
        if not is_placed and not seen.layer.drawn and is_new_ground and has_wide_sigma(sigma_m, view.agl_m):
            pose = self._localize_alone(pose, seen, belief)
        self._lock_monitor.update(evidence_nats, seen.weight, seen.new, pose.inliers, sigma_m, view.agl_m)
        mode_view = view_at(view, hypothesis, pose.mode.e_m, pose.mode.n_m) if pose.attempted else None
        refuted = self._relocalizer.refutes_place(image, mode_view)
        # Mixture "believed position, or anywhere": the variance that the second component adds.
        wrong = max(self._lock_monitor.wrong_probability, self._relocalizer.wrong_probability)
        self._relocalizer.sigma_m = float(np.hypot(mixed_sigma_m(wrong, best.map), self._shape.sigma_m(view.agl_m)))
        search = SearchResult(sigma_m=self._relocalizer.sigma_m, relocalized=found)
        match = msgspec.structs.replace(pose.match, search=search, aspect_ratio=self._shape.ratio)
        if self._lock_monitor.lost or refuted:
            around_m = None if refuted else prediction.p_c_in_w_m[:2]
            self._start_search(seen.layer if seen.layer.drawn else best, prediction.agl_m, around_m, LOST_SIGMA_M)
            return self._relocalizer.search_match(match)
        decided = decide(match, pose, belief, seen, score)
        has_pose = decided.verdict is Verdict.ACCEPTED and not decided.position_only
        self._scale_matched = has_pose and hypothesis.scale == AS_PREDICTED.scale
        return decided

    def _tracked_view(self, view: View) -> View:
        """``view`` without the uncertainty of its scale if the last frame matched at the predicted scale and the ground
        is mostly the same: an error of the height that did not matter there does not matter here either. One scale is
        correlated then instead of three."""
        matched, self._scale_matched = self._scale_matched, False
        is_same_ground = self._since_observation_m < NEW_GROUND_SHARE * view.agl_m
        return replace(view, scale_sigma=0.0) if matched and is_same_ground else view

    def _test_shape(self, seen: Observation, belief: Belief, hypothesis: Hypothesis, score: float) -> None:
        """Updates the posterior of another shape of the images, after as much new ground as counts in full: the same
        ground would give the same scores. ``hypothesis``, ``score``: of the best mode."""
        self._untested_weight += seen.weight
        if seen.layer.drawn or not self._shape.is_due(score, self._untested_weight):
            return
        hypotheses = tuple(replace(hypothesis, stretch=stretch) for stretch in STRETCHES[1:])
        found = seen.layer.matcher.correlate_as(seen.image, seen.view, belief, hypotheses)
        scores = {one.stretch: best for one, best in zip(found.hypotheses, found.scores, strict=True)}
        scores[AS_DESCRIBED] = seen.correlation.scores[seen.correlation.hypotheses.index(hypothesis)]
        if len(scores) == len(STRETCHES):
            self._shape.add(scores)
            self._untested_weight %= 1.0

    @staticmethod
    def _has_passed(test: PlaceTest, mode: Mode, seen: Observation, score: float, evidence_nats: float) -> bool:
        """Whether the search of a drawn map ends with this observation, which then is a position-only match."""
        if not seen.correlation.is_mapped_at(mode.e_m, mode.n_m):
            return False
        passed = test.update(evidence_nats, seen.weight, dominant=mode.mass >= MIN_POSE_MODE_MASS)
        return passed and mode.mass >= MODE_MASS and score >= COARSE_SCORE

    def _correlate(self, image: Image, view: View, layers: MapLayers, belief: Belief) -> Observation:
        results = layers.correlate(image, view, belief)
        footprint_m = max(result.footprint_m for result in results.values())
        new = min(self._since_observation_m / (NEW_GROUND_SHARE * footprint_m), 1.0)
        weight = max(new, MIN_OBSERVATION_WEIGHT)
        used, correlation = layers.select(results, belief, weight)
        return Observation(image, view, used, correlation, new, weight, footprint_m)

    @staticmethod
    def _may_be_on_map(best: MapLayer, prediction: Prediction) -> bool:
        """Whether a position outside of the map has so large a sigma that the vehicle may be over the map."""
        e_m, n_m, _ = prediction.p_c_in_w_m
        off_m = distance_outside_m((e_m, n_m), best.map.bounds_m)
        sigma_m = position_sigma_m(prediction)
        return has_wide_sigma(sigma_m, prediction.agl_m) and off_m <= OFF_MAP_SIGMAS * sigma_m

    def _widen_if_poor(self, belief: Belief, score: float, weight: float) -> None:
        """Widens the window after several observations that do not fit the best mode."""
        self._poor_weight = self._poor_weight + weight if score < POOR_SCORE else 0.0
        if self._poor_weight >= MAX_POOR_WEIGHT:
            self._poor_weight = 0.0
            belief.fit_window(belief.half_m * WIDEN_FACTOR)

    def _localize_alone(self, pose: PoseResult, seen: Observation, belief: Belief) -> PoseResult:
        """Selection of a mode by this frame alone; ``pose`` itself if no mode is selected."""
        view = seen.view
        self._since_single_frame_m = 0.0
        self._single_frame_budget.spend()
        log_probability = self._single_frame_budget.log_probability
        place = localize_single_frame(
            seen.image, view, seen.correlation, belief.modes(MAX_MODES), seen.layer.matcher, log_probability
        )
        if place is None:
            return pose
        mode = place.mode
        assert pose.match.place is not None
        there = MatchPlace(e_m=mode.e_m, n_m=mode.n_m, mass=pose.match.place.mass)
        match = msgspec.structs.replace(pose.match, place=there)
        if place.fix is not None:
            match = pose_match(match, place.fix, view)
        if match.verdict is not Verdict.ACCEPTED:
            scale = seen.correlation.scale_at(mode.e_m, mode.n_m)
            turned = replace(view, r_w_c=place.view.r_w_c)
            match = mode_match(match, mode, belief.cell_m, turned, scale, alone=True)
        return PoseResult(match, mode, attempted=True, likelihood_ratio=LIKELIHOOD_RATIO)


def initial_belief(prediction: Prediction, cell_m: float) -> tuple[Belief, float]:
    """Belief around a start coordinate, and its 1-sigma [m]."""
    e_m, n_m, _ = prediction.p_c_in_w_m
    tilt = prediction.agl_m * tilt_sigma_rad(prediction)
    sigma_m = float(np.hypot(max(position_sigma_m(prediction), START_SIGMA_FLOOR_M), tilt))
    window_m = min(START_WINDOW_SIGMAS * sigma_m, START_WINDOW_MAX_M)
    return Belief(e_m, n_m, sigma_m, cell_m, START_UNIFORM_SHARE, window_m), sigma_m


def predict_belief(belief: Belief, prediction: Prediction, sigma_m: float, cell_m: float) -> None:
    """Moves the belief by the step of odometry, with the 1-sigma ``sigma_m`` of that step."""
    jitter = min(TILT_JITTER, tilt_sigma_rad(prediction))
    belief.predict(*prediction.step_m, float(np.hypot(sigma_m, jitter * prediction.agl_m)))
    belief.fit_window(0.0)
    if not CELL_RATIO_MIN < cell_m / belief.cell_m < CELL_RATIO_MAX:
        belief.set_cell(cell_m)


def with_step(match: MapMatch, step: SearchStep) -> MapMatch:
    """``match`` with another stage of the search."""
    return msgspec.structs.replace(match, search=msgspec.structs.replace(match.search, step=step))
