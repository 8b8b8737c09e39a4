"""Pose of one frame in the best mode of the belief, and the verdict of its MapMatch."""

from dataclasses import dataclass

import msgspec

from terrafix.anchor.matching.frame_matcher import CorrelationResult, Hypothesis, View, view_at
from terrafix.anchor.matching.map_layers import MapLayer
from terrafix.anchor.matching.match_message import ground_sigma_m, mode_match, pose_match
from terrafix.anchor.matching.point_mass_filter import Belief, Mode
from terrafix.anchor.matching.predicted_view import VAR_YAW
from terrafix.anchor.verification.place_verifier import SIGMA_FLOOR
from terrafix.core.node import Image
from terrafix.messages import BeliefMode, BeliefSummary, MapMatch, MatchPlace, Prediction, Verdict

MODE_MASS = 0.9  # mass of one mode from which its position is published as a measurement [tuned]
# Likelihood ratio of a pose with enough inliers, for the belief: such poses are found at most right places and in 0.5 %
# of the frames at wrong ones (docs/search.md). [tuned]
POSE_LIKELIHOOD_RATIO = 20.0
REPORTED_MODES = 2  # the best mode and the second one [spec: BeliefSummary.modes]
MIN_POSE_MODE_MASS = 0.5  # mass of the mode from which a pose is estimated there [tuned]
COARSE_SCORE = 3.0  # standardised correlation in the current frame that a position-only match needs [tuned]
UNKNOWN_HEADING_RAD = 1.5  # 1-sigma above which the heading counts as unknown [tuned]


@dataclass(frozen=True)
class Observation:
    """One frame correlated with a map layer. ``new``: share of new ground, 0 to 1; ``weight``: that share, at least
    ``MIN_OBSERVATION_WEIGHT``; ``footprint_m``: side of a square of the ground that the correlated frame shows."""

    image: Image
    view: View
    layer: MapLayer
    correlation: CorrelationResult
    new: float
    weight: float
    footprint_m: float


@dataclass(frozen=True)
class PoseResult:
    """Outcome of the pose estimation. ``attempted``: a pose was estimated at ``mode``; ``inliers``: of an accepted pose
    from single patches, 0 without; ``likelihood_ratio``: weight of an accepted pose for the belief."""

    match: MapMatch
    mode: Mode
    attempted: bool
    inliers: int = 0
    likelihood_ratio: float = POSE_LIKELIHOOD_RATIO


def estimate_pose(
    match: MapMatch, prediction: Prediction, seen: Observation, mode: Mode, hypothesis: Hypothesis
) -> PoseResult:
    """Pose from single patches in the mode; from all patches together where that fails or is imprecise.

    On a drawn layer there is none, and the position of the mode is the measurement: a patch holds one piece of a road,
    along which it fits everywhere."""
    # With an unknown heading the belief spreads as fast as frames narrow it, until a pose gives the heading.
    if not (mode.mass >= MIN_POSE_MODE_MASS or heading_is_unknown(prediction)):
        return PoseResult(match, mode, attempted=False)
    if seen.layer.drawn:
        return PoseResult(msgspec.structs.replace(match, verdict=Verdict.FEW_INLIERS), mode, attempted=True)
    view, inliers = seen.view, 0
    fix = seen.layer.matcher.fix(seen.image, view, hypothesis, mode.e_m, mode.n_m)
    match = pose_match(match, fix, view)
    if match.verdict is Verdict.ACCEPTED:
        inliers = match.inliers
    # Single patches with less information than all together may share a bias; the consensus is more precise.
    fit = None if fix is None else fix.pnp.fit
    if (
        match.verdict is not Verdict.ACCEPTED
        or fit is None
        or ground_sigma_m(fit, view.agl_m) > SIGMA_FLOOR * view.agl_m
    ):
        consensus = seen.layer.consensus.estimate(seen.image, view_at(view, hypothesis, mode.e_m, mode.n_m))
        joint = match if consensus is None else pose_match(match, consensus, view)
        match = joint if joint.verdict is Verdict.ACCEPTED else match
    return PoseResult(match, mode, attempted=True, inliers=inliers)


def heading_is_unknown(prediction: Prediction) -> bool:
    """Whether the 1-sigma of the heading exceeds ``UNKNOWN_HEADING_RAD``."""
    return prediction.cov[VAR_YAW] > UNKNOWN_HEADING_RAD**2


def with_belief(match: MapMatch, belief: Belief, modes: list[Mode], score: float) -> MapMatch:
    """``match`` with the belief, and its best mode as the place of the pose."""
    ee, en, nn = belief.covariance()
    return msgspec.structs.replace(
        match,
        place=MatchPlace(e_m=modes[0].e_m, n_m=modes[0].n_m, mass=modes[0].mass),
        belief=BeliefSummary(
            mean_m=belief.mean, cov_m2=(ee, en, en, nn), modes=reported_modes(modes), mode_score=score
        ),
    )


def reported_modes(modes: list[Mode]) -> list[BeliefMode]:
    return [BeliefMode(e_m=m.e_m, n_m=m.n_m, mass=m.mass, variance_m2=m.var_m2) for m in modes]


def decide(match: MapMatch, pose: PoseResult, belief: Belief, seen: Observation, score: float) -> MapMatch:
    """The verdict: an accepted pose in a dominant mode, the position of a dominant mode alone, or none."""
    if not pose.attempted:
        return msgspec.structs.replace(match, verdict=Verdict.AMBIGUOUS)
    if match.verdict is Verdict.ACCEPTED:
        return confirm_pose(match, pose.mode, pose.likelihood_ratio, belief)
    if pose.mode.mass < MODE_MASS:
        return msgspec.structs.replace(match, verdict=Verdict.AMBIGUOUS)
    if score < COARSE_SCORE:
        return match
    scale = seen.correlation.scale_at(pose.mode.e_m, pose.mode.n_m)
    return mode_match(match, pose.mode, belief.cell_m, seen.view, scale)


def confirm_pose(match: MapMatch, mode: Mode, likelihood_ratio: float, belief: Belief) -> MapMatch:
    """``match`` with an accepted pose at ``mode``, after the belief has been updated with it; AMBIGUOUS unless one mode
    holds ``MODE_MASS`` of the belief then."""
    belief.confirm(mode, likelihood_ratio)
    modes = belief.modes(REPORTED_MODES)
    assert match.place is not None and match.belief is not None
    return msgspec.structs.replace(
        match,
        verdict=Verdict.ACCEPTED if modes[0].mass >= MODE_MASS else Verdict.AMBIGUOUS,
        place=msgspec.structs.replace(match.place, mass=modes[0].mass),
        belief=msgspec.structs.replace(match.belief, modes=reported_modes(modes)),
    )
