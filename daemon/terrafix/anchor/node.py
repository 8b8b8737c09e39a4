"""Anchor: the newest predicted frame against the map, through the belief, into 2D-3D matches and a pose."""

from collections.abc import Iterable

import msgspec
import numpy as np

from terrafix.anchor.answer import coarse, judged
from terrafix.anchor.belief import Belief, cell_for
from terrafix.anchor.hint import SIGMAS_95, Believed, radius_now_m, weigh
from terrafix.anchor.layers import Layers
from terrafix.anchor.lost import LostWatch
from terrafix.anchor.map_features import Describer
from terrafix.anchor.map_package import LocalMap, MapPackage
from terrafix.anchor.matcher import FrameMatcher
from terrafix.anchor.model_watch import ModelWatch
from terrafix.anchor.retrieval import MapSearch
from terrafix.anchor.views import ground_plane, view_of
from terrafix.core.camera import CameraCalibration
from terrafix.core.errors import ModelError
from terrafix.core.geodesy import LocalFrame
from terrafix.core.node import FrameStore, Image, NodeContext
from terrafix.core.signature import trusted_keys
from terrafix.core.start import SEARCHED_START_M
from terrafix.messages import (
    HintVerdict,
    MapMatch,
    Message,
    Origin,
    PositionHint,
    Prediction,
    SearchState,
    SearchStep,
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
MODE_TRIED = 0.5  # modes below this are not tried at all
COARSE_SCORE = 3.0  # standardised correlation that a coarse fix must have in this very frame
MIN_AGL_M = 30.0  # below this a frame shows a few roofs and cars
START_SIGMA_FLOOR_M = 8.0  # an apparent position also carries the tilt that is not known yet
POOR_SCORE = 2.0  # standardised correlation in the mode; a frame at the right place scores 3 to 10
POOR_LOOKS = 4.0  # full looks below it before the search widens
WIDEN = 1.6
LOST_SIGMA_M = 1000.0  # 1-sigma of a position that is not known, at least; more on a larger map
FOUND_SIGMA_M = 10.0  # of the place that a search has found, for the belief that follows it
SCALE_CHANGED = 1.5  # ratio of heights beyond which a search begins anew


class AnchorNode:
    def __init__(
        self,
        frames: FrameStore,
        package: MapPackage | None,
        describer: Describer,
        ce90_m: float,
        model: ModelWatch | None = None,
    ) -> None:
        self._frames = frames
        self._package = package
        self._describer = describer
        self._model = model or ModelWatch(describer)
        self._ce90_m = ce90_m  # of imagery that does not state its own
        self._layers: Layers | None = None
        self._belief: Belief | None = None
        self._origin: Origin | None = None
        self._ground_m = 0.0
        self._since_look_m = np.inf  # motion since the last look at new ground
        self._poor_looks = 0.0
        self._variance_m2 = 0.0  # of the last prediction
        self._watch = LostWatch()
        self._search: MapSearch | None = None  # while lost
        self._lost_sigma_m = 0.0
        self._hint: PositionHint | None = None  # not answered yet
        self._answers: list[Message] = []
        self._said_step = SearchStep.NORMAL

    def on(self, message: Message) -> Iterable[Message]:
        match message:
            case Origin() if message != self._origin:  # said again after a restart of the source
                self._origin = message
                self._ground_m = message.ground_amsl_m or 0.0
                self._belief, self._search, self._watch = None, None, LostWatch()
                self._open_layers(message)
                yield from self._model.opened(message.t_ns)
            case PositionHint():
                self._hint = message  # height and place come with the next frame
            case Prediction():
                match = self._contained(message)
                yield match
                yield from self._answers
                self._answers.clear()
                step = match.step if match.verdict is Verdict.LOST else SearchStep.NORMAL
                if step is not self._said_step:
                    self._said_step = step
                    yield SearchState(t_ns=message.t_ns, step=step)
            case _:
                pass

    def tick(self, now_ns: int) -> Iterable[Message]:
        return ()

    def _open_layers(self, origin: Origin) -> None:
        if self._package is not None:
            frame, camera = LocalFrame(origin.lat_deg, origin.lon_deg), CameraCalibration.of(origin.camera)
            self._layers = Layers(self._package, frame, camera, self._describer, self._ce90_m)

    def _contained(self, prediction: Prediction) -> MapMatch:
        """A learned model that has no answer costs this frame; one that has none for many is given up."""
        try:
            match = self._match(prediction)
        except ModelRunError as error:
            self._answers += self._model.failed(prediction.t_ns, str(error))
            if self._model.given_up:
                self._without_weights(prediction)
            answer = msgspec.structs.replace(self._nothing(prediction, Verdict.MODEL_FAILED), step=SearchStep.SKIP)
            return answer if self._search is None else self._searching(answer, self._search)
        self._answers += self._model.answered(prediction.t_ns)
        return match

    def _nothing(self, prediction: Prediction, verdict: Verdict) -> MapMatch:
        """The answer while nothing was found."""
        return MapMatch(
            t_ns=prediction.t_ns,
            frame_id=prediction.frame_id,
            verdict=verdict,
            matcher=self._describer.name,
            lost_sigma_m=self._lost_sigma_m,
        )

    def _without_weights(self, prediction: Prediction) -> None:
        """From here on; what is believed stays, a search that is under way begins anew."""
        self._describer = GradientDescriber()
        self._model = ModelWatch(self._describer)
        if self._origin is not None and self._layers is not None:
            self._open_layers(self._origin)
            best = self._layers.best
            if self._search is not None:
                self._begin_search(MapSearch(best.map, best.matcher, prediction.agl_m, None), best.map)

    def _match(self, prediction: Prediction) -> MapMatch:
        answer = self._nothing(prediction, Verdict.OUTSIDE_MAP)
        image = self._frames.get(prediction.frame_id)
        if self._layers is None or self._origin is None:
            return answer
        best = self._layers.best
        answer = msgspec.structs.replace(answer, map_sigma_m=best.sigma_m)
        belief = self._moved(prediction, best.map, best.matcher, self._origin)
        if self._hint is not None:
            self._heed(self._hint, self._origin, prediction, best.map, best.matcher)
            self._hint = None
        if self._search is not None:
            return self._searched(answer, prediction, image, self._search, best.map, best.matcher)
        if image is None:
            return msgspec.structs.replace(answer, verdict=Verdict.BAD_IMAGE, step=SearchStep.SKIP)
        e_m, n_m, _ = prediction.p_c_in_w_m
        ground, relief_m = ground_plane(best.map, e_m, n_m, prediction.agl_m)
        view = view_of(prediction, ground, self._ground_m)
        answer = msgspec.structs.replace(answer, ground=ground, relief_m=relief_m)
        if view.agl_m < MIN_AGL_M:
            return msgspec.structs.replace(answer, verdict=Verdict.TOO_LOW)
        looks = self._layers.looks(image, view, belief)
        new = min(self._since_look_m / (NEW_GROUND_SHARE * max(look.footprint_m for look in looks.values())), 1.0)
        weight = max(new, MIN_LOOK)
        used, look = self._layers.chosen(looks, belief.mode(), weight)
        answer = msgspec.structs.replace(answer, map_sigma_m=used.sigma_m)
        if look.verdict is not Verdict.ACCEPTED:
            return msgspec.structs.replace(answer, verdict=look.verdict)
        self._since_look_m = 0.0
        gain = belief.update(look.surfaces, weight)
        mode = belief.mode()
        hypothesis, score = look.best_at(mode.e_m, mode.n_m)
        self._widen(belief, score, weight)
        ee, en, nn = belief.covariance()
        answer = msgspec.structs.replace(
            answer,
            margin=score,
            mode_mass=mode.mass,
            mode_e_m=mode.e_m,
            mode_n_m=mode.n_m,
            belief_cov_m2=(ee, en, en, nn),
        )
        tried = mode.mass >= MODE_TRIED
        if tried:
            answer = judged(answer, used.matcher.fix(image, view, hypothesis, mode.e_m, mode.n_m), view)
        claimed_m = float(np.sqrt(max(prediction.cov[0], prediction.cov[7])))
        inliers = answer.inliers if answer.verdict is Verdict.ACCEPTED else 0
        self._watch.looked(gain, weight, new, inliers, claimed_m, view.agl_m)
        # Of the mixture "where it is believed to be, or anywhere": the variance that the second part adds.
        self._lost_sigma_m = float(np.sqrt(self._watch.doubt)) * _anywhere_m(best.map)
        answer = msgspec.structs.replace(answer, lost_sigma_m=self._lost_sigma_m)
        if self._watch.lost:
            return self._lost(answer, prediction, best.map, best.matcher)
        if not tried:
            return msgspec.structs.replace(answer, verdict=Verdict.AMBIGUOUS)
        if answer.verdict is Verdict.ACCEPTED:
            belief.confirm(mode, POSE_LIKELIHOOD_RATIO)
            mass = belief.mode().mass
            enough = Verdict.ACCEPTED if mass >= MODE_MASS else Verdict.AMBIGUOUS
            return msgspec.structs.replace(answer, verdict=enough, mode_mass=mass)
        if mode.mass < MODE_MASS:
            return msgspec.structs.replace(answer, verdict=Verdict.AMBIGUOUS)
        if score < COARSE_SCORE:
            return answer
        return coarse(answer, mode, belief.cell_m, view, look.scale_at(mode.e_m, mode.n_m))

    def _moved(self, prediction: Prediction, source: LocalMap, matcher: FrameMatcher, origin: Origin) -> Belief:
        cell_m = cell_for(prediction.agl_m, matcher.look_cell_m(prediction.agl_m))
        step_m = float(np.hypot(*prediction.step_m))
        # Blind, the error of the position grows faster than the steps' own errors add up: with that of the velocity.
        variance = max(prediction.cov[0], prediction.cov[7])
        grown = variance - self._variance_m2
        self._variance_m2 = variance
        sigma_m = float(np.sqrt(max(prediction.step_cov_m2[0], prediction.step_cov_m2[3], grown)))
        if self._belief is None:
            e_m, n_m, _ = prediction.p_c_in_w_m
            start = float(np.sqrt(max(prediction.cov[0], prediction.cov[7])))
            tilt = prediction.agl_m * float(np.sqrt(max(prediction.cov[21], prediction.cov[28])))
            self._belief = Belief(e_m, n_m, float(np.hypot(max(start, START_SIGMA_FLOOR_M), tilt)), cell_m)
            # A prediction that is better than that start was found before: this process was started again in flight.
            if origin.start_sigma_m > SEARCHED_START_M and start > 0.5 * SEARCHED_START_M:
                hint = self._start_hint(e_m, n_m, origin.start_sigma_m, source)
                self._begin_search(MapSearch(source, matcher, prediction.agl_m, hint), source)
        elif self._search is not None:
            self._search.move(*prediction.step_m, sigma_m)
        else:
            self._belief.move(*prediction.step_m, sigma_m)
            self._belief.fit_window(0.0)
            if not 0.4 < cell_m / self._belief.cell_m < 2.5:  # an octave is left alone: no flicker at its edge
                self._belief.set_cell(cell_m)
        self._since_look_m += float(np.hypot(step_m, sigma_m))
        return self._belief

    def _heed(
        self, hint: PositionHint, origin: Origin, prediction: Prediction, source: LocalMap, matcher: FrameMatcher
    ) -> None:
        """The operator's hint: where the search goes on, or a comparison with what is believed."""
        e_m, n_m = LocalFrame(origin.lat_deg, origin.lon_deg).to_local(hint.lat_deg, hint.lon_deg)
        radius_m = radius_now_m(hint.radius_m, (prediction.t_ns - hint.t_ns) * 1e-9)
        sigma_m = float(np.hypot(np.sqrt(max(prediction.cov[0], prediction.cov[7])), self._lost_sigma_m))
        believed = Believed(*prediction.p_c_in_w_m[:2], sigma_m, self._watch.odds)
        weighed = weigh((e_m, n_m), radius_m, believed, source.bounds_m, searching=self._search is not None)
        tracks = self._search.tracks.all if self._search is not None else []
        follows = any(t.frames and np.hypot(t.e_m - e_m, t.n_m - n_m) <= radius_m for t in tracks)
        around = self._start_hint(e_m, n_m, radius_m / SIGMAS_95, source)
        # What a search knows by now is kept where poses speak for a place within the hint, and where the hint says no
        # more than the map.
        if weighed.begins_search and not follows and (around is not None or self._search is None):
            self._begin_search(MapSearch(source, matcher, prediction.agl_m, around), source)
        self._answers.append(
            HintVerdict(
                t_ns=prediction.t_ns,
                hint_t_ns=hint.t_ns,
                verdict=weighed.verdict,
                distance_m=weighed.distance_m,
                sigma_m=sigma_m,
                text=weighed.text,
            )
        )

    def _start_hint(self, e_m: float, n_m: float, sigma_m: float, source: LocalMap) -> tuple[float, float] | None:
        """Where the search begins: around a start that says something, None when it says no more than the map."""
        e_min, n_min, e_max, n_max = source.bounds_m
        return (e_m, n_m) if sigma_m < 0.25 * max(e_max - e_min, n_max - n_min) else None

    def _lost(self, answer: MapMatch, prediction: Prediction, source: LocalMap, matcher: FrameMatcher) -> MapMatch:
        """Nothing speaks for the place that was believed any more: the position is withdrawn and searched."""
        search = MapSearch(source, matcher, prediction.agl_m, prediction.p_c_in_w_m[:2])
        self._begin_search(search, source)
        return self._searching(answer, search)

    def _begin_search(self, search: MapSearch, source: LocalMap) -> None:
        self._search = search
        self._lost_sigma_m = _anywhere_m(source)

    def _searching(self, answer: MapMatch, search: MapSearch) -> MapMatch:
        return msgspec.structs.replace(
            answer,
            verdict=Verdict.LOST,
            matches=[],
            p_c_in_w_m=None,
            q_w_c=None,
            cov=None,
            inliers=0,
            step=search.step,
            lost_sigma_m=self._lost_sigma_m,
        )

    def _searched(
        self,
        answer: MapMatch,
        prediction: Prediction,
        image: Image | None,
        search: MapSearch,
        source: LocalMap,
        matcher: FrameMatcher,
    ) -> MapMatch:
        """One look of the search; ACCEPTED and ``found`` when it has come to an end."""
        if not 1 / SCALE_CHANGED < prediction.agl_m / search.agl_m < SCALE_CHANGED:
            search = self._search = MapSearch(source, matcher, prediction.agl_m, None)
        if image is None or prediction.agl_m < MIN_AGL_M:
            return self._searching(answer, search)
        view = view_of(prediction, None, self._ground_m)
        found = search.look(image, view)
        if found is None:
            return self._searching(answer, search)
        e_m, n_m = found.track.e_m, found.track.n_m
        ground, relief_m = ground_plane(source, e_m, n_m, view.agl_m)
        answer = msgspec.structs.replace(
            answer, mode_e_m=e_m, mode_n_m=n_m, mode_mass=1.0, ground=ground, relief_m=relief_m, found=True
        )
        answer = judged(answer, found.fix, view)
        if answer.verdict is not Verdict.ACCEPTED:
            return self._searching(msgspec.structs.replace(answer, found=False), search)
        self._search, self._lost_sigma_m, self._watch = None, 0.0, LostWatch()
        answer = msgspec.structs.replace(answer, lost_sigma_m=0.0)
        self._belief = Belief(e_m, n_m, FOUND_SIGMA_M, cell_for(view.agl_m, matcher.look_cell_m(view.agl_m)))
        return answer

    def _widen(self, belief: Belief, score: float, weight: float) -> None:
        """A mode that no longer fits what is seen: look wider."""
        self._poor_looks = self._poor_looks + weight if score < POOR_SCORE else 0.0
        if self._poor_looks >= POOR_LOOKS:
            self._poor_looks = 0.0
            belief.fit_window(belief.half_m * WIDEN)


def _anywhere_m(source: LocalMap) -> float:
    """1-sigma per axis of a position of which nothing is known."""
    e_min, n_min, e_max, n_max = source.bounds_m
    return max(LOST_SIGMA_M, 0.5 * (e_max - e_min), 0.5 * (n_max - n_min))


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
    return AnchorNode(ctx.frames, package, describer, wanted.ce90_m, ModelWatch(describer, not_opened))
