"""Tracking of place hypotheses: the frames along the flight accumulate evidence for each, and a threshold decides.

Evidence is a log likelihood ratio, "here against the best wrong places of a map". The same ground counts once. A track
is accepted when its evidence exceeds the quantile of the best wrong place of the map (``null_model.py``) and exceeds
that of every other track by ``DECISION_MARGIN``.
"""

from dataclasses import dataclass, replace

import numpy as np

from terrafix.anchor.matching.frame_matcher import FrameMatcher, Hypothesis, PatchFix, View, view_at
from terrafix.anchor.verification.patch_consensus import PATCH_SCALE_SIGMA, YAW_SIGMA_RAD
from terrafix.anchor.verification.patch_null import PatchNull
from terrafix.anchor.verification.place_verifier import FINE_PLACE_CELL_PER_AGL, PLACE_CELL_PER_AGL, PlaceVerifier
from terrafix.core.geodesy import local_rotation_up
from terrafix.core.node import Image

MAX_CHECKS_PER_FRAME = 8  # tracks that one frame is compared with, the most likely first; about 50 ms each [tuned]
# share of the height: places closer than this are neighbours and count as one in the joint correlation [tuned]
NEIGHBOUR_RADIUS = 0.4
# Share of the height: tracks closer than this are merged. Rows of houses repeat at a third of the height, so the best
# place of the joint correlation may be the row beside the right one; both stay separate tracks.
# [measured: docs/search.md]
MERGE_RADIUS = 0.2
# standard deviations above the null model at which right and wrong places are equally frequent
# [measured: docs/search.md]
NULL_SIGMAS = 1.7
# nats per standard deviation beyond that: decay of the tail of wrong places [measured: docs/search.md]
TRACK_LLR_SLOPE = 2.5
# Bounds of one frame's evidence, nats. At a quarter of the right places the patches are no better than the null model,
# because much has changed or leans, and this persists from frame to frame. The upper bound limits repetitive ground:
# one wrong place of about 200 searches came to 21, no other to more than 18. [measured: docs/search.md]
TRACK_LLR_MIN, TRACK_LLR_MAX = -1.4, 9.0
NEW_EVIDENCE = 0.4  # share of the height: a frame over this much new ground is an independent observation [tuned]
MIN_EVIDENCE_WEIGHT = 0.05  # weight of a frame over the same ground [tuned]
MIN_SCORE = -1.0  # nats; a track whose score is lower is dropped for this ground [tuned]
DECISION_MARGIN = 5.0  # nats between the best and the second track [tuned]
CONFIRMATION_LLR = 2.0  # nats of a frame that counts as a confirmation [tuned]
# confirmations that are required: a random agreement in one frame does not persist in the next
# [measured: docs/search.md]
MIN_CONFIRMATIONS = 2
# joint correlations over which the lead must persist, unless the last one is wide; one alone may be random
# [measured: docs/search.md]
LEAD_WINDOW = 2
# Nats per standard deviation of lead, and the largest lead that counts. The lead of the best wrong place over the next
# one is exponentially distributed with a mean of 0.2 to 0.3 standard deviations, that is 3.3 to 5 nats each, over 487
# joint correlations. The lower value is used because the frames observe the same ground. [measured: docs/search.md]
LEAD_LLR, MAX_LEAD = 3.0, 3.0
LEADING_SIGMAS = 0.5  # standard deviations of lead from which a track is kept whatever the single frames score [tuned]
# Nats of a yaw and scale equal to the prediction, for two dimensions: normal density against the uniform density over
# 1.5 sigmas to both sides from which the search draws them; the spread of wrong places is at least as wide.
# [spec: ratio of the two densities]
AS_PREDICTED_LLR = 2.0 * float(np.log(3.0 / np.sqrt(2.0 * np.pi)))
CLEAR_LEAD = 1.0  # standard deviations of lead in a wide joint correlation that count as one confirmation [tuned]
MIN_LEAD = -2.5  # standard deviations of lead below which a track is not compared with frames [tuned]


@dataclass
class PlaceHypothesis:
    """One track: a camera position (local east and north, valid if the tilt is as predicted) with yaw and scale
    relative to the prediction. ``frames``: number of confirming frames."""

    e_m: float
    n_m: float
    hypothesis: Hypothesis
    score: float = 0.0
    frames: int = 0
    scored_path_m: float = -np.inf
    leads: tuple[float, ...] = ()
    wide: bool = False  # whether the last joint correlation was wide, so that no single frame dominates it
    mahalanobis2: float = 2.0 * AS_PREDICTED_LLR  # squared Mahalanobis distance of yaw and scale from the prediction
    # east and north of the last frame's position minus the one predicted from the frames before and odometry
    innovation_m: tuple[float, float] = (0.0, 0.0)

    def add_lead(self, lead: float, *, wide: bool) -> None:
        """Adds a joint correlation. ``lead``: standard deviations over all other places."""
        self.leads, self.wide = (*self.leads, lead)[-LEAD_WINDOW:], wide

    @property
    def lead(self) -> float:
        """Lead in the last joint correlation if that is wide; else the smallest of the last ``LEAD_WINDOW``."""
        if self.wide:
            return self.leads[-1]
        return min(self.leads) if len(self.leads) == LEAD_WINDOW else min((0.0, *self.leads))

    @property
    def total_confirmations(self) -> int:
        """Number of confirming frames, plus one for a clear lead in a wide joint correlation."""
        return self.frames + (self.wide and self.lead >= CLEAR_LEAD)

    @property
    def log_odds(self) -> float:
        """Evidence in nats: score of its frames, lead in the joint correlation, and agreement of yaw and scale with the
        prediction."""
        predicted = AS_PREDICTED_LLR - 0.5 * self.mahalanobis2
        return self.score + LEAD_LLR * float(np.clip(self.lead, -MAX_LEAD, MAX_LEAD)) + predicted

    @property
    def is_active(self) -> bool:
        """Whether it is still compared with frames. A track far behind is kept at no cost until its lead recovers."""
        return self.lead >= LEADING_SIGMAS or (self.score > MIN_SCORE and max(self.leads[-1:], default=0.0) > MIN_LEAD)

    def predict(self, step_m: np.ndarray) -> None:
        """Prediction. ``step_m`` (2,): east and north by odometry under the predicted yaw and height."""
        step_m = self.hypothesis.scale * local_rotation_up(self.hypothesis.yaw_rad)[:2, :2] @ step_m
        self.e_m += float(step_m[0])
        self.n_m += float(step_m[1])

    def is_near(self, e_m: float, n_m: float, agl_m: float) -> bool:
        return float(np.hypot(self.e_m - e_m, self.n_m - n_m)) <= MERGE_RADIUS * agl_m

    def update_score(self, evidence_nats: float, path_m: float, agl_m: float) -> None:
        """Measurement update of the score. ``evidence_nats``: of a frame; ``path_m``: length flown since the search
        began."""
        new = float(np.clip((path_m - self.scored_path_m) / (NEW_EVIDENCE * agl_m), MIN_EVIDENCE_WEIGHT, 1.0))
        self.scored_path_m = path_m
        self.score = max(self.score + new * evidence_nats, TRACK_LLR_MIN)
        self.frames += evidence_nats >= CONFIRMATION_LLR


@dataclass(frozen=True)
class AcceptedPlace:
    track: PlaceHypothesis
    fix: PatchFix


class HypothesisTracker:
    def __init__(self, matcher: FrameMatcher, patches: tuple[float, float] = (0.0, 1.0)) -> None:
        """``patches``: mean and standard deviation of the map's null model for patches."""
        self._matcher = matcher
        self.verifier = PlaceVerifier(matcher)
        self.null = PatchNull(patches)
        self.tracks: list[PlaceHypothesis] = []  # best first
        # standard deviations above the null model, for the tracks compared with the last frame
        self.sigmas: list[float] = []

    def predict(self, step_m: np.ndarray) -> None:
        """Prediction of all tracks. ``step_m`` (2,): east and north by odometry."""
        for track in self.tracks:
            track.predict(step_m)

    def propose(self, e_m: float, n_m: float, hypothesis: Hypothesis, agl_m: float) -> None:
        """New track at a place of the joint correlation. A track without positive score within the merge radius is
        moved there instead."""
        near = next((track for track in self.tracks if track.is_near(e_m, n_m, agl_m)), None)
        if near is None:
            self.tracks.append(PlaceHypothesis(e_m, n_m, hypothesis))
        elif near.score <= 0.0:
            near.e_m, near.n_m, near.hypothesis = e_m, n_m, hypothesis

    def update(self, image: Image, view: View, path_m: float, required: float) -> AcceptedPlace | None:
        """Compares the frame with the best tracks. -> the accepted track with its pose in this frame, or None.

        ``required``: evidence in nats that the best wrong place of the map rarely reaches.
        """
        inactive = [t for t in self.tracks if not t.is_active and t.scored_path_m == -np.inf]
        blocked_m = NEW_EVIDENCE * view.agl_m  # a dropped place is not proposed again over the same ground
        self.tracks = [t for t in self.tracks if t.is_active or path_m - t.scored_path_m < blocked_m]
        active = sorted((t for t in self.tracks if t.is_active), key=lambda t: (t.score <= 0.0, -t.log_odds))
        tried = active[:MAX_CHECKS_PER_FRAME]
        # a track with a large lead has few alternatives from which the null model can be estimated, and may still be
        # wrong
        if not self.null.is_estimated:
            for track in inactive[: MAX_CHECKS_PER_FRAME - len(tried)]:
                if (found := self.verifier.verify(image, self._view_at(track, view), PLACE_CELL_PER_AGL)) is not None:
                    self.null.add(found.consensus, fine=False)
        self.sigmas = []
        fixes = [(track, self._update_track(track, image, view, path_m)) for track in tried]
        self.tracks.sort(key=lambda t: -t.log_odds)
        self.tracks = [t for i, t in enumerate(self.tracks) if not self._is_duplicate(t, self.tracks[:i], view)]
        if not self.tracks or not self._is_accepted(self.tracks[0], required):
            return None
        fix = next((fix for track, fix in fixes if track is self.tracks[0]), None)
        return None if fix is None else AcceptedPlace(self.tracks[0], self._matcher.refine_fix(image, view, fix))

    def _view_at(self, track: PlaceHypothesis, view: View) -> View:
        ground_m = float(self._matcher.ground_at(np.array([[track.e_m, track.n_m]]), view.ground_m)[0])
        return replace(view_at(view, track.hypothesis, track.e_m, track.n_m), ground_m=ground_m)

    def _update_track(self, track: PlaceHypothesis, image: Image, view: View, path_m: float) -> PatchFix | None:
        """Updates a track with the frame and moves it to the position that fits best. None: no evidence, or no pose."""
        here = self._view_at(track, view)
        is_strong = track.score > 0.0 or track.lead >= LEADING_SIGMAS
        found = self.verifier.verify(image, here, FINE_PLACE_CELL_PER_AGL if is_strong else PLACE_CELL_PER_AGL)
        if found is None:  # too little of the frame lies on the map
            track.update_score(TRACK_LLR_MIN, path_m, view.agl_m)
            return None
        z = self.null.sigmas(found.consensus, fine=is_strong)
        self.sigmas.append(z)
        if self.tracks and track is not self.tracks[0]:
            self.null.add(found.consensus, fine=is_strong)
        evidence_nats, had_confirmation = evidence(z), track.frames > 0
        track.update_score(evidence_nats, path_m, view.agl_m)
        track.mahalanobis2 = _mahalanobis2(track.hypothesis, view)
        if evidence_nats <= 0.0:
            return None
        east, north, yaw_rad, scale, tilt_e, tilt_n = (float(v) for v in found.consensus.motion)
        moved_m = (east + tilt_e) * here.agl_m, (north + tilt_n) * here.agl_m
        track.e_m, track.n_m = track.e_m + moved_m[0], track.n_m + moved_m[1]
        track.innovation_m = moved_m if had_confirmation else (0.0, 0.0)
        track.hypothesis = Hypothesis(track.hypothesis.yaw_rad + yaw_rad, track.hypothesis.scale * (1.0 + scale))
        track.mahalanobis2 = _mahalanobis2(track.hypothesis, view)
        return found.fix if found.fix.pnp.fit is not None else None

    def _is_duplicate(self, track: PlaceHypothesis, better: list[PlaceHypothesis], view: View) -> bool:
        return any(b.is_near(track.e_m, track.n_m, view.agl_m) for b in better)

    def _is_accepted(self, best: PlaceHypothesis, required: float) -> bool:
        rivals = self.tracks[1:]
        return best.total_confirmations >= MIN_CONFIRMATIONS and best.log_odds >= max(
            required, max((t.log_odds for t in rivals), default=0.0) + DECISION_MARGIN
        )


def _mahalanobis2(hypothesis: Hypothesis, view: View) -> float:
    """Squared Mahalanobis distance of yaw and scale from the prediction, with the uncertainty of the prediction and of
    one frame's patches."""
    yaw = hypothesis.yaw_rad / np.hypot(view.yaw_sigma_rad, YAW_SIGMA_RAD)
    return float(yaw**2 + ((hypothesis.scale - 1.0) / np.hypot(view.scale_sigma, PATCH_SCALE_SIGMA)) ** 2)


def evidence(z: float) -> float:
    """Log likelihood ratio "here against the best wrong places of a map" of a frame whose consensus is ``z`` standard
    deviations above the null model."""
    return float(np.clip(TRACK_LLR_SLOPE * (z - NULL_SIGMAS), TRACK_LLR_MIN, TRACK_LLR_MAX))
