"""Places that a search follows: what frames along the way say for each decides which of them is right, if any.

Evidence is a log likelihood ratio, "here against the best wrong places of a map". It counts once for the same ground.
A track is found when it has more of it than the best wrong place of the map may come to (``null_model.py``), and more
than every other track."""

from dataclasses import dataclass, replace

import numpy as np

from terrafix.anchor.matching.frame_matcher import Fix, FrameMatcher, Hypothesis, View
from terrafix.anchor.verification.patch_consensus import SCALE_SIGMA, YAW_SIGMA_RAD
from terrafix.anchor.verification.patch_null import PatchNull
from terrafix.anchor.verification.place_verifier import CELL_PER_AGL, FINE_PER_AGL, PlaceCheck
from terrafix.core.geodesy import local_rotation_up
from terrafix.core.node import Image
from terrafix.map.package import LocalMap

AT_A_TIME = 8  # places that one frame is compared with, the most likely first: some 50 ms each
NEAR = 0.4  # of the height: places closer than this are neighbours, and one place for the joint look
# Tracks closer than this are one. Rows of houses repeat at a third of the height: the best place of the joint look may
# be the row next to the right one, and both are followed.
SAME = 0.2
CHANCE_MOST = 1.7  # standard deviations above what chance comes to: as often at right places as at wrong ones
LLR_SLOPE = 2.5  # beyond, the tail of wrong places falls off by this for each
# At a quarter of the right places the patches come to no more than chance, because much has changed or leans; and then
# they do so frame after frame. Ground that repeats may come to anything; one wrong place of some 200
# searches came to 21, no other to 18.
LLR_MIN, LLR_MAX = -1.4, 9.0
NEW_EVIDENCE = 0.4  # of the height: a frame over this much new ground is new evidence
SAME_EVIDENCE = 0.05  # the same ground again
WORST = -1.0  # a track that falls below is given up for this ground
AHEAD = 5.0  # of the best other track
SPEAKS = 2.0  # nats of a frame that speaks for its place
MIN_FRAMES = 2  # that must speak for it: what chance gave in one frame is gone in the next
LEADS = 2  # joint looks in which it must lead; one alone may be chance, unless it is a wide one
# Nats for each standard deviation of lead, up to so many. By how much the best wrong place leads the next one falls off
# as an exponential does, by 0.2 to 0.3 standard deviations: 3.3 to 5 nats for each, measured over 487 looks. The frames
# know the same ground.
LEAD_LLR, LEAD_MOST = 3.0, 3.0
LEADING = 0.5  # standard deviations: a place that leads by this is followed, whatever single frames say
# Nats for a heading and a height as predicted: a search tries them evenly over one and a half sigmas, and what wrong
# places come to is spread as wide and wider.
AS_PREDICTED_LLR = 2.0 * float(np.log(3.0 / np.sqrt(2.0 * np.pi)))
CLEAR_LEAD = 1.0  # of a wide look: speaks for a place as one more frame does
HOPELESS = -2.5  # standard deviations behind the best place of the joint look


@dataclass
class PlaceHypothesis:
    """``e_m, n_m``: where the camera seems to be now, if its tilt is as predicted. ``frames``: that spoke for it."""

    e_m: float
    n_m: float
    hypothesis: Hypothesis
    score: float = 0.0
    frames: int = 0
    scored_way_m: float = -np.inf
    leads: tuple[float, ...] = ()
    wide: bool = False  # the last joint look: no single frame decides it
    off_sigmas2: float = 2.0 * AS_PREDICTED_LLR  # heading and height against the prediction, squares added
    jump_m: tuple[float, float] = (0.0, 0.0)  # of the last frame, against where those before and odometry had it

    def looked_at(self, lead: float, *, wide: bool) -> None:
        """``lead`` over all other places in a joint look, in standard deviations."""
        self.leads, self.wide = (*self.leads, lead)[-LEADS:], wide

    @property
    def lead(self) -> float:
        """In the last joint look, if that is a wide one; else in the worst of the last ones."""
        if self.wide:
            return self.leads[-1]
        return min(self.leads) if len(self.leads) == LEADS else min((0.0, *self.leads))

    @property
    def witnesses(self) -> int:
        """Frames that spoke for it, and a wide look in which it leads clearly."""
        return self.frames + (self.wide and self.lead >= CLEAR_LEAD)

    @property
    def odds(self) -> float:
        """What speaks for it: its own frames, how the joint look compares it with all other places, and whether heading
        and height are as predicted."""
        predicted = AS_PREDICTED_LLR - 0.5 * self.off_sigmas2
        return self.score + LEAD_LLR * float(np.clip(self.lead, -LEAD_MOST, LEAD_MOST)) + predicted

    @property
    def is_open(self) -> bool:
        """Whether it may still be the place; one that is far behind costs nothing until it comes up again."""
        return self.lead >= LEADING or (self.score > WORST and max(self.leads[-1:], default=0.0) > HOPELESS)

    def moved(self, step_m: np.ndarray) -> None:
        """``step_m`` (2,): east, north, by odometry, as the predicted heading and height have it."""
        step_m = self.hypothesis.scale * local_rotation_up(self.hypothesis.yaw_rad)[:2, :2] @ step_m
        self.e_m += float(step_m[0])
        self.n_m += float(step_m[1])

    def is_near(self, e_m: float, n_m: float, agl_m: float) -> bool:
        return float(np.hypot(self.e_m - e_m, self.n_m - n_m)) <= SAME * agl_m

    def checked(self, gain: float, way_m: float, agl_m: float) -> None:
        """``gain`` of a frame, after ``way_m`` of the search."""
        new = float(np.clip((way_m - self.scored_way_m) / (NEW_EVIDENCE * agl_m), SAME_EVIDENCE, 1.0))
        self.scored_way_m = way_m
        self.score = max(self.score + new * gain, LLR_MIN)
        self.frames += gain >= SPEAKS


@dataclass(frozen=True)
class Found:
    track: PlaceHypothesis
    fix: Fix


class HypothesisTracker:
    def __init__(self, source: LocalMap, matcher: FrameMatcher, patches: tuple[float, float] = (0.0, 1.0)) -> None:
        """``patches``: what chance comes to by the map's null model."""
        self._map = source
        self._matcher = matcher
        self.check = PlaceCheck(source, matcher)
        self.chance = PatchNull(patches)
        self.all: list[PlaceHypothesis] = []  # best first
        self.sigmas: list[float] = []  # above chance, of the places that the last frame was compared with

    def move(self, step_m: np.ndarray) -> None:
        """``step_m`` (2,): east, north, by odometry."""
        for track in self.all:
            track.moved(step_m)

    def propose(self, e_m: float, n_m: float, hypothesis: Hypothesis, agl_m: float) -> None:
        """A place that may be right. A track near it that no frame has spoken for is this place from now on."""
        near = next((track for track in self.all if track.is_near(e_m, n_m, agl_m)), None)
        if near is None:
            self.all.append(PlaceHypothesis(e_m, n_m, hypothesis))
        elif near.score <= 0.0:
            near.e_m, near.n_m, near.hypothesis = e_m, n_m, hypothesis

    def look(self, image: Image, view: View, way_m: float, enough: float) -> Found | None:
        """The frame at the tracks; the one that is found by now, with its pose in this frame. ``enough``: evidence that
        the best wrong place of the map hardly comes to."""
        hopeless = [t for t in self.all if not t.is_open and t.scored_way_m == -np.inf]
        kept_m = NEW_EVIDENCE * view.agl_m  # a place that was given up is not proposed again over the same ground
        self.all = [t for t in self.all if t.is_open or way_m - t.scored_way_m < kept_m]
        tried = sorted((t for t in self.all if t.is_open), key=lambda t: (t.score <= 0.0, -t.odds))[:AT_A_TIME]
        if not self.chance.is_known:  # a place far ahead has hardly a rival to learn from, and may yet be wrong
            for track in hopeless[: AT_A_TIME - len(tried)]:
                if (found := self.check.at(image, self._at(track, view), CELL_PER_AGL)) is not None:
                    self.chance.learn(found.agreement, fine=False)
        self.sigmas = []
        fixes = [(track, self._checked(track, image, view, way_m)) for track in tried]
        self.all.sort(key=lambda t: -t.odds)
        self.all = [t for i, t in enumerate(self.all) if not self._is_second(t, self.all[:i], view)]
        if not self.all or not self._is_found(self.all[0], enough):
            return None
        fix = next((fix for track, fix in fixes if track is self.all[0]), None)
        return None if fix is None else Found(self.all[0], self._matcher.refined(image, view, fix))

    def _at(self, track: PlaceHypothesis, view: View) -> View:
        up = self._map.elevation(np.array([track.e_m]), np.array([track.n_m]))
        return replace(
            view,
            e_m=track.e_m,
            n_m=track.n_m,
            r_w_c=local_rotation_up(track.hypothesis.yaw_rad) @ view.r_w_c,
            agl_m=view.agl_m * track.hypothesis.scale,
            ground_m=view.ground_m if up is None or not np.isfinite(up[0]) else float(up[0]),
        )

    def _checked(self, track: PlaceHypothesis, image: Image, view: View, way_m: float) -> Fix | None:
        """What the frame says for the track, which moves to where it fits best; None: nothing, or no pose."""
        here = self._at(track, view)
        speaks = track.score > 0.0 or track.lead >= LEADING
        found = self.check.at(image, here, FINE_PER_AGL if speaks else CELL_PER_AGL)
        if found is None:  # hardly any of it lies on the map
            track.checked(LLR_MIN, way_m, view.agl_m)
            return None
        z = self.chance.sigmas(found.agreement, fine=speaks)
        self.sigmas.append(z)
        if self.all and track is not self.all[0]:
            self.chance.learn(found.agreement, fine=speaks)
        gain, placed = evidence(z), track.frames > 0
        track.checked(gain, way_m, view.agl_m)
        track.off_sigmas2 = _off_sigmas2(track.hypothesis, view)
        if gain <= 0.0:
            return None
        east, north, yaw_rad, scale, tilt_e, tilt_n = (float(v) for v in found.agreement.motion)
        moved_m = (east + tilt_e) * here.agl_m, (north + tilt_n) * here.agl_m
        track.e_m, track.n_m = track.e_m + moved_m[0], track.n_m + moved_m[1]
        track.jump_m = moved_m if placed else (0.0, 0.0)
        track.hypothesis = Hypothesis(track.hypothesis.yaw_rad + yaw_rad, track.hypothesis.scale * (1.0 + scale))
        track.off_sigmas2 = _off_sigmas2(track.hypothesis, view)
        return found.fix if found.fix.pnp.fit is not None else None

    def _is_second(self, track: PlaceHypothesis, better: list[PlaceHypothesis], view: View) -> bool:
        return any(b.is_near(track.e_m, track.n_m, view.agl_m) for b in better)

    def _is_found(self, best: PlaceHypothesis, enough: float) -> bool:
        rivals = self.all[1:]
        return best.witnesses >= MIN_FRAMES and best.odds >= max(
            enough, max((t.odds for t in rivals), default=0.0) + AHEAD
        )


def _off_sigmas2(hypothesis: Hypothesis, view: View) -> float:
    """How far heading and height are from the prediction, by what that and the patches of one frame leave open."""
    yaw = hypothesis.yaw_rad / np.hypot(view.yaw_sigma_rad, YAW_SIGMA_RAD)
    return float(yaw**2 + ((hypothesis.scale - 1.0) / np.hypot(view.scale_sigma, SCALE_SIGMA)) ** 2)


def evidence(z: float) -> float:
    """Log likelihood ratio, "here against the best wrong places of a map", of a frame that agrees by so many standard
    deviations more than chance does."""
    return float(np.clip(LLR_SLOPE * (z - CHANCE_MOST), LLR_MIN, LLR_MAX))
