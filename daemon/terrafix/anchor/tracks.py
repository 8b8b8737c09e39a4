"""Places that a search follows: looks and camera poses along the way decide which of them is right, if any.

One frame never decides: ground repeats itself. A track is found when poses over new ground follow the odometry, and
what speaks for it outweighs both the number of places that there are and every other track."""

from dataclasses import dataclass, replace

import numpy as np

from terrafix.anchor.belief import MIN_HALF_CELLS, cell_for, log_likelihood_ratio
from terrafix.anchor.map_package import LocalMap
from terrafix.anchor.matcher import Fix, FrameMatcher, Hypothesis, View
from terrafix.core.geodesy import local_rotation_up
from terrafix.core.node import Image
from terrafix.messages import Verdict

MOST = 6  # followed from look to look; each costs a pose
NEAR = 0.4  # of the height: places closer than this are one
# What a pose says for its place, natural logarithms. Measured at the right place and at the best wrong ones of nine
# flights and maps: at 70 right places a pose was found on 25 to 90 % of the frames, with 20 inliers in the median; at
# 930 wrong ones on 0.5 %, with 9 to 11 (one had 20).
POSE_LLR = ((8, 3.0), (12, 5.0), (20, 6.0))  # inliers, gain
NO_POSE_LLR = -0.7
# What a look at the track's place says beyond chance: right places gain 4 to 9, the best of a wrong one's surroundings
# 0 to 3.
CHANCE_LLR = 3.0
LOOK_MIN, LOOK_MAX = -2.0, 2.0
LOOK_REACH = 0.08  # of the height: how far odometry may have taken the place aside
NEW_EVIDENCE = 0.4  # of the height: patches over this much new ground are new evidence
SAME_EVIDENCE = 0.05  # the same patches again
WORST = -3.0  # a track that falls below is given up
ENOUGH = 5.0  # above the logarithm of the number of places that could be confused
AHEAD = 5.0  # of the best other track
# Poses of a track, and the way between first and last (share of the height), by how far it leads all other places of
# the map in the joint look, in standard deviations. Measured over 240 joint looks: the best wrong place led the next
# one by more than 1 in 4 %, by 1.7 at most, and by 1.5 at most in two looks that agreed; right places by more than 1 in
# half of the looks and more.
NEEDED = ((2.5, 1, 0.0), (1.2, 2, 0.15), (-np.inf, 3, 0.4))
LEADS = 2  # joint looks in which it must lead; one alone may be chance
LEAD_LLR, LEAD_MOST = 3.0, 3.0  # natural logarithms for each standard deviation of lead, up to so many
LEAD_TRIES = 0.5  # a track that leads by this is tried for a pose, whatever this one frame says
HOPELESS = -1.5  # ... and one that is behind by this costs nothing until it comes up again
AGREE, AGREE_WAY = 0.10, 0.25  # two poses against the way between them: share of the height and of the way
# Of a place that leads: a pose on changed ground takes tilt for position, by ten degrees.
AGREE_LEAD, AGREE_LEADING = 1.2, 0.25


@dataclass
class Track:
    """``e_m, n_m``: where the camera seems to be now. ``last_p_m`` (2,): the camera of the last pose, moved with the
    odometry since. Ways are metres flown since the search began."""

    e_m: float
    n_m: float
    hypothesis: Hypothesis
    score: float = 0.0
    poses: int = 0
    first_way_m: float = 0.0
    last_way_m: float = 0.0
    last_p_m: np.ndarray | None = None
    scored_way_m: float = -np.inf
    leads: tuple[float, ...] = ()

    def looked_at(self, lead: float) -> None:
        """``lead`` over all other places in a joint look, in standard deviations."""
        self.leads = (*self.leads, lead)[-LEADS:]

    @property
    def lead(self) -> float:
        """In the worst of the last joint looks."""
        return min(self.leads) if len(self.leads) == LEADS else min((0.0, *self.leads))

    @property
    def odds(self) -> float:
        """What speaks for it: its own looks and poses, and how the joint look compares it with all other places."""
        return self.score + LEAD_LLR * float(np.clip(self.lead, -LEAD_MOST, LEAD_MOST))

    def moved(self, step_m: np.ndarray) -> None:
        self.e_m += float(step_m[0])
        self.n_m += float(step_m[1])
        if self.last_p_m is not None:
            self.last_p_m = self.last_p_m + step_m

    def is_near(self, e_m: float, n_m: float, agl_m: float) -> bool:
        return float(np.hypot(self.e_m - e_m, self.n_m - n_m)) <= NEAR * agl_m


@dataclass(frozen=True)
class Square:
    """``matcher.Window``"""

    centre: tuple[float, float]
    half_m: float


@dataclass(frozen=True)
class Found:
    track: Track
    fix: Fix


class Tracks:
    def __init__(self, source: LocalMap, matcher: FrameMatcher) -> None:
        self._map = source
        self._matcher = matcher
        self.all: list[Track] = []  # best first

    def move(self, step_m: np.ndarray) -> None:
        """``step_m`` (2,): east, north, by odometry."""
        for track in self.all:
            track.moved(step_m)

    def propose(self, e_m: float, n_m: float, hypothesis: Hypothesis, agl_m: float) -> None:
        """A place that may be right; nothing new where a track is already."""
        if not any(track.is_near(e_m, n_m, agl_m) for track in self.all):
            self.all.append(Track(e_m, n_m, hypothesis))

    def look(self, image: Image, view: View, way_m: float) -> Found | None:
        """A pose at every track; the one that is found by now, with its pose in this frame."""
        tried = [track for track in self.all if max(track.leads[-1:], default=0.0) > HOPELESS]
        fixes = [(track, self._verify(track, image, view, way_m)) for track in tried]
        self.all = sorted((t for t in self.all if t.score > WORST), key=lambda t: -t.odds)[:MOST]
        return next((Found(t, fix) for t, fix in fixes if fix is not None and self._is_found(t, view)), None)

    def _verify(self, track: Track, image: Image, view: View, way_m: float) -> Fix | None:
        """Look and pose at the track's place; None: no pose, or it does not follow the way from the one before."""
        new = float(np.clip((way_m - track.scored_way_m) / (NEW_EVIDENCE * view.agl_m), SAME_EVIDENCE, 1.0))
        track.scored_way_m = way_m
        gain = self._looked(track, image, view)
        if track.lead >= LEAD_TRIES:  # the joint look has this frame, too: what it says against the place is counted
            gain = max(gain, 0.0)
        track.score += new * gain
        if gain <= LOOK_MIN:  # a pose is dear, and here it would be chance
            track.score += new * NO_POSE_LLR
            return None
        up = self._map.elevation(np.array([track.e_m]), np.array([track.n_m]))
        ground_m = view.ground_m if up is None or not np.isfinite(up[0]) else float(up[0])
        here = replace(view, ground_m=ground_m)
        fix = self._matcher.searched_fix(image, here, track.hypothesis, track.e_m, track.n_m)
        if fix is None or fix.pnp.fit is None or fix.pnp.verdict is not Verdict.ACCEPTED:
            track.score += new * NO_POSE_LLR
            return None
        p_m = fix.pnp.fit.p_c_in_w_m[:2]
        if track.last_p_m is None:
            agrees = track.is_near(float(p_m[0]), float(p_m[1]), view.agl_m)
        else:
            off_m = p_m - track.last_p_m
            share = AGREE if track.lead < AGREE_LEAD else AGREE_LEADING
            agrees = float(np.hypot(*off_m)) < share * view.agl_m + AGREE_WAY * (way_m - track.last_way_m)
        if not agrees:
            track.score += new * NO_POSE_LLR
            return None
        track.score += new * pose_gain(int(fix.pnp.inliers.sum()))
        if track.last_p_m is None:
            track.first_way_m = way_m
        else:  # the place follows the poses: the heading on which odometry was laid may be off
            track.e_m += float(off_m[0])
            track.n_m += float(off_m[1])
        track.poses += 1
        track.last_way_m, track.last_p_m = way_m, p_m
        track.hypothesis = _hypothesis_of(fix, view)
        return fix

    def _looked(self, track: Track, image: Image, view: View) -> float:
        """What the frame as a whole says for the track, whose place moves onto the best one within reach."""
        turned = replace(
            view,
            r_w_c=local_rotation_up(track.hypothesis.yaw_rad) @ view.r_w_c,
            agl_m=view.agl_m * track.hypothesis.scale,
            yaw_sigma_rad=0.0,
            scale_sigma=0.0,
        )
        half_m = MIN_HALF_CELLS * cell_for(view.agl_m, self._matcher.look_cell_m(view.agl_m))
        look = self._matcher.look(image, turned, Square((track.e_m, track.n_m), half_m))
        if look.verdict is not Verdict.ACCEPTED:
            return 0.0
        z, e_m, n_m = look.surfaces[0].best(track.e_m, track.n_m, LOOK_REACH * view.agl_m)
        gain = float(log_likelihood_ratio(np.array(z))) - CHANCE_LLR
        if gain > 0.0:
            track.e_m, track.n_m = e_m, n_m
        return float(np.clip(gain, LOOK_MIN, LOOK_MAX))

    def _is_found(self, track: Track, view: View) -> bool:
        e_min, n_min, e_max, n_max = self._map.bounds_m
        places = max((e_max - e_min) * (n_max - n_min) / (NEAR * view.agl_m) ** 2, 1.0)
        rivals = [t.odds for t in self.all if not t.is_near(track.e_m, track.n_m, view.agl_m)]
        poses, span = next((poses, span) for lead, poses, span in NEEDED if track.lead >= lead)
        return (
            track.poses >= poses
            and track.last_way_m - track.first_way_m >= span * view.agl_m
            and track.odds >= float(np.log(places)) + ENOUGH
            and track.odds >= max(rivals, default=0.0) + AHEAD
        )


def pose_gain(inliers: int) -> float:
    """Log likelihood ratio, "here against elsewhere", of a pose on which so many patches agree."""
    return max((gain for least, gain in POSE_LLR if inliers >= least), default=0.0)


def _hypothesis_of(fix: Fix, view: View) -> Hypothesis:
    """Heading and scale of a pose, against the prediction."""
    assert fix.pnp.fit is not None
    turn = fix.pnp.fit.r_w_c @ view.r_w_c.T
    yaw_rad = float(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
    height_m = float(fix.pnp.fit.p_c_in_w_m[2]) - float(fix.points_w_m[:, 2].mean())
    return Hypothesis(yaw_rad, height_m / view.agl_m)
