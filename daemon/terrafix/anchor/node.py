"""Anchor: the newest predicted frame against the map, through the belief, into 2D-3D matches and a pose."""

from collections.abc import Iterable
from pathlib import Path

import msgspec
import numpy as np

from terrafix.anchor.initial_position import answered
from terrafix.anchor.matching.descriptor_cache import Describer
from terrafix.anchor.matching.frame_matcher import view_at
from terrafix.anchor.matching.map_layers import Layers, MapLayer
from terrafix.anchor.matching.match_message import ground_sigma_m, mode_match, pose_match
from terrafix.anchor.matching.point_mass_filter import Belief, cell_for
from terrafix.anchor.matching.predicted_view import ground_plane, view_of
from terrafix.anchor.model_monitor import ModelWatch
from terrafix.anchor.relocalization.hypothesis_tracker import NEAR
from terrafix.anchor.relocalization.position_prior import outside_m
from terrafix.anchor.relocalization.relocalizer import PlaceSearch, mixed_sigma_m, start_around
from terrafix.anchor.verification.lock_monitor import START_ODDS, LockMonitor, claims_little
from terrafix.anchor.verification.place_verifier import SIGMA_FLOOR
from terrafix.anchor.verification.single_frame import LIKELIHOOD_RATIO, PLACES, localize_single_frame
from terrafix.core.camera import CameraCalibration
from terrafix.core.errors import ModelError
from terrafix.core.geodesy import LocalFrame
from terrafix.core.initial_position import SEARCHED_START_M
from terrafix.core.limits import LEAST_LOOK_AGL_M
from terrafix.core.node import FrameStore, NodeContext
from terrafix.core.signature import trusted_keys
from terrafix.map.null_model import FlightBudget
from terrafix.map.package import MapPackage
from terrafix.messages import (
    GnssStart,
    MapMatch,
    Message,
    Origin,
    PositionHint,
    Prediction,
    SearchState,
    SearchStep,
    Start,
    Verdict,
)
from terrafix_engines.features import open_describer
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_engines.runtime import ModelFileError, ModelRunError

NEW_GROUND_SHARE = 0.35  # of the footprint: after this much motion a look counts as a new one
MIN_LOOK = 0.08  # a look at the same ground again still says this much
MODE_MASS = 0.9  # the belief hands a fix to the graph when one mode holds this much
# A pose on which many patches agree is evidence of its own: found at most right places, at hardly any wrong one.
POSE_LIKELIHOOD_RATIO = 20.0
MODES_SAID = 2  # the best place and its best rival
MODE_TRIED = 0.5  # modes below this are not tried at all
COARSE_SCORE = 3.0  # standardised correlation that a coarse fix must have in this very frame

# A start coordinate that is wrong by far more than it claims: how often (lock_monitor.py), and how far it is looked for
# until a pose has placed the flight.
START_STRAY, STRAY_SIGMAS, STRAY_MOST_M = float(np.exp(-START_ODDS)), 8.0, 500.0
START_SIGMA_FLOOR_M = 8.0  # an apparent position also carries the tilt that is not known yet
# Of the height: what the belief follows is the place from which a picture seems to be taken, and a tilt that is a
# degree more than in the frame before moves it. At most: whose tilt is known better sways less. Every frame adds it,
# and a slow copter at two frames a second sees little new ground that would take it away again.
SWAY = 0.02
UNKNOWN_HEADING_RAD = 1.5  # 1-sigma from which a heading says nothing
POOR_SCORE = 2.0  # standardised correlation in the mode; a frame at the right place scores 3 to 10
POOR_LOOKS = 4.0  # full looks below it before the search widens
WIDEN = 1.6
OFF_MAP_SIGMAS = 3.0  # by which a position that lies off the map may be on it
FOUND_SIGMA_M = 10.0  # of the place that a search has found, for the belief that follows it


class AnchorNode:
    def __init__(
        self,
        frames: FrameStore,
        package: MapPackage | None,
        describer: Describer,
        ce90_m: float,
        model: ModelWatch | None = None,
        shelf: Path | None = None,
    ) -> None:
        """``shelf``: folder in memory for what was computed of the map."""
        self._frames = frames
        self._package = package
        self._describer = describer
        self._shelf = shelf
        self._model = model or ModelWatch(describer)
        self._ce90_m = ce90_m  # of imagery that does not state its own
        self._layers: Layers | None = None
        self._origin: Origin | None = None
        self._ground_m = 0.0
        self._hint: PositionHint | None = None  # not answered yet
        self._start: Start | None = None  # the newest answer to a GnssStart
        self._start_ns = 0  # of the Start from which the predictions come
        self._answers: list[Message] = []
        self._said_step = SearchStep.NORMAL
        self._begin()

    def _begin(self) -> None:
        """Nothing is known of the flight yet."""
        self._belief: Belief | None = None
        self._watch = LockMonitor()
        self._search = PlaceSearch()
        self._alone = FlightBudget()  # of single frames
        self._since_look_m = np.inf  # motion since the last look at new ground
        self._poor_looks = 0.0
        self._variance_m2 = 0.0  # of the last prediction
        self._torn = False  # this frame from the one before
        self._apart = False  # all frames since then, from what came before

    def on(self, message: Message) -> Iterable[Message]:
        match message:
            case Origin() if message != self._origin:  # said again after a restart of the source
                self._origin = message
                self._ground_m = message.ground_amsl_m or 0.0
                self._begin()
                self._open_layers(message)
                yield from self._model.opened(message.t_ns)
            case PositionHint():
                self._hint = message  # height and place come with the next frame
            case GnssStart():
                if self._start is None or self._start.t_ns != message.t_ns:
                    self._start = answered(message, self._package)
                yield self._start
            case Prediction():
                if message.start_ns > self._start_ns:  # what was believed before was somewhere else
                    self._start_ns = message.start_ns
                    self._begin()
                match = self._named(self._contained(message))
                yield match
                yield from self._answers
                self._answers.clear()
                if match.step is not self._said_step:
                    self._said_step = match.step
                    yield SearchState(t_ns=message.t_ns, step=match.step)
            case _:
                pass

    def tick(self, now_ns: int) -> Iterable[Message]:
        return ()

    def _open_layers(self, origin: Origin) -> None:
        if self._package is not None:
            frame, camera = LocalFrame(origin.lat_deg, origin.lon_deg), CameraCalibration.of(origin.camera)
            self._layers = Layers(self._package, frame, camera, self._describer, self._ce90_m, self._shelf)

    def _contained(self, prediction: Prediction) -> MapMatch:
        """A learned model that has no answer costs this frame; one that has none for many is given up."""
        try:
            match = self._match(prediction)
        except ModelRunError as error:
            self._answers += self._model.failed(prediction.t_ns, str(error))
            if self._model.given_up:
                self._without_weights(prediction)
            answer = msgspec.structs.replace(self._nothing(prediction, Verdict.MODEL_FAILED), step=SearchStep.SKIP)
            return self._search.answer(answer) if self._search.is_on else answer
        self._answers += self._model.answered(prediction.t_ns)
        return match

    def _named(self, match: MapMatch) -> MapMatch:
        """With the step of the escalation that this frame is."""
        if match.step is SearchStep.SKIP:
            return match
        if self._torn:
            self._apart = True
            return msgspec.structs.replace(match, step=SearchStep.NEW_FRAGMENT)
        if match.found or (self._apart and match.verdict is Verdict.ACCEPTED and not match.coarse):
            self._apart = False
            return msgspec.structs.replace(match, step=SearchStep.MERGE)
        return match

    def _nothing(self, prediction: Prediction, verdict: Verdict) -> MapMatch:
        """The answer while nothing was found."""
        return MapMatch(
            t_ns=prediction.t_ns,
            frame_id=prediction.frame_id,
            verdict=verdict,
            matcher=self._describer.name,
            lost_sigma_m=self._search.sigma_m,
        )

    def _without_weights(self, prediction: Prediction) -> None:
        """From here on; what is believed stays, a search that is under way begins anew."""
        self._describer = GradientDescriber()
        self._model = ModelWatch(self._describer)
        if self._origin is not None and self._layers is not None:
            self._open_layers(self._origin)
            if self._search.is_on:
                self._search.begin(self._layers.best, prediction.agl_m, None)

    def _match(self, prediction: Prediction) -> MapMatch:
        answer = self._nothing(prediction, Verdict.OUTSIDE_MAP)
        image = self._frames.get(prediction.frame_id)
        if self._layers is None or self._origin is None:
            return answer
        self._layers.see_through(prediction.lens)
        best = self._layers.best
        answer = msgspec.structs.replace(answer, map_sigma_m=best.sigma_m, lens=prediction.lens)
        belief = self._moved(prediction, best, self._origin)
        if self._hint is not None:
            self._answers.append(self._search.heed(self._hint, self._origin, prediction, best, self._watch.odds))
            self._hint = None
        if self._search.is_on:
            answer = self._search.look(
                answer, prediction, image if prediction.agl_m >= LEAST_LOOK_AGL_M else None, best, self._ground_m
            )
            if answer.found:
                self._watch = LockMonitor()
                cell_m = cell_for(prediction.agl_m, best.matcher.look_cell_m(prediction.agl_m))
                self._belief = Belief(answer.mode_e_m, answer.mode_n_m, FOUND_SIGMA_M, cell_m)
            return answer
        if image is None:
            return msgspec.structs.replace(answer, verdict=Verdict.BAD_IMAGE, step=SearchStep.SKIP)
        e_m, n_m, _ = prediction.p_c_in_w_m
        ground, relief_m = ground_plane(best.map, e_m, n_m, prediction.agl_m)
        view = view_of(prediction, ground, self._ground_m)
        answer = msgspec.structs.replace(answer, ground=ground, relief_m=relief_m)
        if view.agl_m < LEAST_LOOK_AGL_M:
            return msgspec.structs.replace(answer, verdict=Verdict.TOO_LOW)
        looks = self._layers.looks(image, view, belief)
        new = min(self._since_look_m / (NEW_GROUND_SHARE * max(look.footprint_m for look in looks.values())), 1.0)
        weight = max(new, MIN_LOOK)
        used, look = self._layers.chosen(looks, belief.mode(), weight)
        answer = msgspec.structs.replace(answer, map_sigma_m=used.sigma_m)
        if look.verdict is Verdict.OUTSIDE_MAP and self._may_be_on(best, prediction):
            # Dead reckoning over minutes leads off the map, and no look would ever be made again.
            self._search.begin(best, prediction.agl_m, None)
            return self._search.answer(answer)
        if look.verdict is not Verdict.ACCEPTED:
            return msgspec.structs.replace(answer, verdict=look.verdict)
        self._since_look_m = 0.0
        gain = belief.update(look.surfaces, weight)
        modes = belief.modes(MODES_SAID)
        mode = modes[0]
        hypothesis, score = look.best_at(mode.e_m, mode.n_m)
        self._widen(belief, score, weight)
        ee, en, nn = belief.covariance()
        answer = msgspec.structs.replace(
            answer,
            margin=score,
            mode_mass=mode.mass,
            mode_e_m=mode.e_m,
            mode_n_m=mode.n_m,
            modes=[(m.e_m, m.n_m, m.mass, m.var_m2) for m in modes],
            belief_m=belief.mean,
            belief_cov_m2=(ee, en, en, nn),
        )
        # Without a heading the belief spreads as fast as frames narrow it, until a pose tells the heading.
        tried = mode.mass >= MODE_TRIED or heading_is_open(prediction)
        inliers, likelihood_ratio = 0, POSE_LIKELIHOOD_RATIO
        if tried:
            answer = pose_match(answer, used.matcher.fix(image, view, hypothesis, mode.e_m, mode.n_m), view)
            if answer.verdict is Verdict.ACCEPTED:
                inliers = answer.inliers
            # Single patches that say less than all of them may be aside together: these know it better.
            if answer.verdict is not Verdict.ACCEPTED or ground_sigma_m(answer, view.agl_m) > SIGMA_FLOOR * view.agl_m:
                agreed = used.agreed.at(image, view_at(view, hypothesis, mode.e_m, mode.n_m))
                together = answer if agreed is None else pose_match(answer, agreed, view)
                answer = together if together.verdict is Verdict.ACCEPTED else answer
        claimed_m = float(np.sqrt(max(prediction.cov[0], prediction.cov[7])))
        if not tried and new >= 1.0 and claims_little(claimed_m, view.agl_m):
            self._alone.spend()
            null, share = used.null_at(view.agl_m), self._alone.log_probability
            place = localize_single_frame(image, view, look, belief.modes(PLACES), used.map, used.matcher, null, share)
            if place is not None:
                mode, fix = place
                answer = pose_match(msgspec.structs.replace(answer, mode_e_m=mode.e_m, mode_n_m=mode.n_m), fix, view)
                tried = answer.verdict is Verdict.ACCEPTED
                likelihood_ratio = LIKELIHOOD_RATIO
        self._watch.looked(gain, weight, new, inliers, claimed_m, view.agl_m)
        # Of the mixture "where it is believed to be, or anywhere": the variance that the second part adds.
        tested = self._search.tested(image, view_at(view, hypothesis, mode.e_m, mode.n_m) if tried else None)
        doubt = max(self._watch.doubt, tested)
        self._search.sigma_m = mixed_sigma_m(doubt, best.map)
        answer = msgspec.structs.replace(answer, lost_sigma_m=self._search.sigma_m)
        if self._watch.lost or doubt == 1.0:  # nothing speaks for the place that was believed any more
            self._search.begin(best, prediction.agl_m, prediction.p_c_in_w_m[:2] if tested < 1.0 else None)
            return self._search.answer(answer)
        if not tried:
            return msgspec.structs.replace(answer, verdict=Verdict.AMBIGUOUS)
        if answer.verdict is Verdict.ACCEPTED:
            belief.confirm(mode, likelihood_ratio)
            modes = belief.modes(MODES_SAID)
            said = [(m.e_m, m.n_m, m.mass, m.var_m2) for m in modes]
            enough = Verdict.ACCEPTED if modes[0].mass >= MODE_MASS else Verdict.AMBIGUOUS
            return msgspec.structs.replace(answer, verdict=enough, mode_mass=modes[0].mass, modes=said)
        if mode.mass < MODE_MASS:
            return msgspec.structs.replace(answer, verdict=Verdict.AMBIGUOUS)
        if score < COARSE_SCORE:
            return answer
        return mode_match(answer, mode, belief.cell_m, view, look.scale_at(mode.e_m, mode.n_m))

    @staticmethod
    def _may_be_on(best: MapLayer, prediction: Prediction) -> bool:
        """Whether a position that claims little, and lies off the map, may be on it all the same."""
        e_m, n_m, _ = prediction.p_c_in_w_m
        off_m = outside_m((e_m, n_m), best.map.bounds_m)
        sigma_m = float(np.sqrt(max(prediction.cov[0], prediction.cov[7])))
        return claims_little(sigma_m, prediction.agl_m) and off_m <= OFF_MAP_SIGMAS * sigma_m

    def _moved(self, prediction: Prediction, best: MapLayer, origin: Origin) -> Belief:
        cell_m = cell_for(prediction.agl_m, best.matcher.look_cell_m(prediction.agl_m))
        step_m = float(np.hypot(*prediction.step_m))
        # Blind, the error of the position grows faster than the steps' own errors add up: with that of the velocity.
        variance = max(prediction.cov[0], prediction.cov[7])
        step_var = max(prediction.step_cov_m2[0], prediction.step_cov_m2[3])
        grown = variance - self._variance_m2
        self._variance_m2 = variance
        turned = heading_is_open(prediction)  # a step may lead anywhere
        sigma_m = float(np.sqrt(step_var if turned else max(step_var, grown)))
        self._torn = self._belief is not None and sigma_m > NEAR * prediction.agl_m
        if self._belief is None:
            e_m, n_m, _ = prediction.p_c_in_w_m
            start = float(np.sqrt(variance))
            tilt = prediction.agl_m * float(np.sqrt(max(prediction.cov[21], prediction.cov[28])))
            sigma_m = float(np.hypot(max(start, START_SIGMA_FLOOR_M), tilt))
            reach_m = min(STRAY_SIGMAS * sigma_m, STRAY_MOST_M)
            self._belief = Belief(e_m, n_m, sigma_m, cell_m, START_STRAY, reach_m)
            # A prediction that is better than that start was found before: this process was started again in flight.
            if origin.start_sigma_m > SEARCHED_START_M and start > 0.5 * SEARCHED_START_M:
                around_m = start_around(e_m, n_m, origin.start_sigma_m, best.map)
                self._search.begin(best, prediction.agl_m, around_m)
        elif self._search.is_on:
            # Heading and scale, by which an unknown position grows worse, are the search's own for each place.
            self._search.move(prediction.step_m, float(np.sqrt(step_var)))
        else:
            if turned:
                sigma_m = float(np.sqrt(max(step_var + step_m**2, grown)))
            sway = min(SWAY, float(np.sqrt(max(prediction.cov[21], prediction.cov[28]))))
            self._search.move(prediction.step_m, float(np.sqrt(step_var)))  # a place that was found is tested further
            self._belief.move(*prediction.step_m, float(np.hypot(sigma_m, sway * prediction.agl_m)))
            self._belief.fit_window(0.0)
            if not 0.4 < cell_m / self._belief.cell_m < 2.5:  # an octave is left alone: no flicker at its edge
                self._belief.set_cell(cell_m)
        self._since_look_m += float(np.hypot(step_m, sigma_m))
        return self._belief

    def _widen(self, belief: Belief, score: float, weight: float) -> None:
        """A mode that no longer fits what is seen: look wider."""
        self._poor_looks = self._poor_looks + weight if score < POOR_SCORE else 0.0
        if self._poor_looks >= POOR_LOOKS:
            self._poor_looks = 0.0
            belief.fit_window(belief.half_m * WIDEN)


def heading_is_open(prediction: Prediction) -> bool:
    """Nobody knows it."""
    return prediction.cov[35] > UNKNOWN_HEADING_RAD**2


def make_node(ctx: NodeContext) -> AnchorNode:
    """Opens the map and the model, before take-off. Raises ConfigError, MapError, ModelError; in flight, when this
    process was started again, a model that cannot be opened any more is done without."""
    wanted = ctx.config.map
    trusted = trusted_keys(wanted.trusted_keys, required=wanted.require_signature)
    package = MapPackage.open(ctx.map_path, trusted=trusted) if ctx.map_path is not None else None
    models = ctx.config.models
    not_opened = ""
    try:
        describer: Describer = open_describer(models.xfeat, models.folder)
    except ModelFileError as error:
        if ctx.epoch_ns is None:
            raise ModelError(str(error)) from None
        describer, not_opened = GradientDescriber(), str(error)
    return AnchorNode(ctx.frames, package, describer, wanted.ce90_m, ModelWatch(describer, not_opened), ctx.shelf)
