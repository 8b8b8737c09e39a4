"""Anchor node: matches the newest predicted frame with the map and publishes 2D-3D matches and a camera pose."""

import math
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import msgspec

from terrafix.anchor.initial_position import check_initial_position
from terrafix.anchor.localizer import Localizer
from terrafix.anchor.matching.descriptor_cache import Describer
from terrafix.anchor.matching.map_layers import MapLayers
from terrafix.anchor.model_monitor import ModelMonitor
from terrafix.anchor.place_index.recognizer import PlaceMemory
from terrafix.anchor.thermal_load import ThermalLoad
from terrafix.core.allocator import return_excess_memory
from terrafix.core.config import HealthSection
from terrafix.core.errors import ModelError, TerrafixError
from terrafix.core.geodesy import LocalFrame
from terrafix.core.node import FrameStore, NodeBase, NodeContext
from terrafix.core.signature import trusted_keys
from terrafix.map.package import MapPackage
from terrafix.messages import (
    GnssInitialPosition,
    Health,
    InitialPosition,
    MapMatch,
    Message,
    ModelChange,
    ModelEvent,
    Origin,
    PositionHint,
    Prediction,
    SearchPlaces,
    SearchState,
    SearchStep,
    Vec2,
    Verdict,
)
from terrafix_engines.correlation import GraphCorrelator, open_correlator
from terrafix_engines.features import open_describer
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_engines.manifest import ManifestError
from terrafix_engines.providers import short_name
from terrafix_engines.runtime import ModelFileError, ModelRunError

MAX_PLACES = 5  # of a search that are published [spec: SV-5 of the requirements]


class AnchorNode(NodeBase):
    def __init__(
        self,
        frames: FrameStore,
        package: MapPackage | None,
        describer: Describer,
        ce90_m: float,
        model: ModelMonitor | None = None,
        cache_dir: Path | None = None,
        load: ThermalLoad | None = None,
        places: PlaceMemory | None = None,
        correlator: GraphCorrelator | None = None,
    ) -> None:
        """``ce90_m``: accuracy of map layers that state none; ``cache_dir``: folder in memory for computed
        descriptors of the map; ``load``: by thermal band; None: as the default configuration; ``places``:
        place index for the search of a large map; ``correlator``: on a GPU."""
        self._frames = frames
        self._package = package
        self._describer = describer  # as configured
        self._model = model or ModelMonitor(describer)
        self._load, self._model_suspended = load or ThermalLoad(HealthSection()), False
        layers = partial(MapLayers, ce90_m=ce90_m, store_folder=cache_dir, places=places, correlator=correlator)
        self._localizer = Localizer(describer, None if package is None else partial(layers, package))
        self._correlator = correlator
        self._origin: Origin | None = None
        self._hint: PositionHint | None = None  # not yet applied
        self._initial: InitialPosition | None = None  # result of the newest GnssInitialPosition
        self._prior_t_ns = 0  # of the InitialPosition on which the predictions are based
        self._pending: list[Message] = []  # to be published after the MapMatch
        self._published_step = SearchStep.NORMAL
        self._published_places: tuple[int | None, list[Vec2]] | None = None  # None: no search, or no result yet

    def on(self, message: Message) -> Iterable[Message]:
        match message:
            case Origin() if message != self._origin:  # the source repeats it after a restart
                self._origin = message
                self._localizer.begin_flight(message)
                yield from self._model.opened(message.t_ns)
                if self._correlator is not None:
                    yield _correlator_event(message.t_ns, ModelChange.OPENED, self._correlator)
            case Health():
                self._load.band = message.band
            case PositionHint():
                self._hint = message  # applied with the next prediction, which has height and position
            case GnssInitialPosition():
                if self._initial is None or self._initial.t_ns != message.t_ns:
                    self._initial = check_initial_position(message, self._package)
                yield self._initial
            case Prediction():
                yield from self._on_prediction(message)
            case _:
                pass

    def _on_prediction(self, prediction: Prediction) -> Iterable[Message]:
        if prediction.prior_t_ns > self._prior_t_ns:  # the belief refers to another position
            self._prior_t_ns = prediction.prior_t_ns
            self._localizer.reset()
        if self._model_suspended is self._load.allows_model:
            self._switch_model(prediction)
        match = self._localizer.label_step(self._localized(prediction), prediction)
        return_excess_memory()
        yield match
        yield from self._search_places(prediction)
        yield from self._pending
        self._pending.clear()
        if match.search.step is not self._published_step:
            self._published_step = match.search.step
            joined = prediction.joined or match.search.step is SearchStep.MERGE
            yield SearchState(
                t_ns=prediction.t_ns, step=match.search.step, fragment_id=prediction.fragment_id, joined=joined
            )

    def _search_places(self, prediction: Prediction) -> Iterable[Message]:
        search, origin = self._localizer.search, self._origin
        if search is None or origin is None or search.cell_m == 0.0:
            self._published_places = None
            return
        frame, camera = LocalFrame(origin.lat_deg, origin.lon_deg), origin.camera
        best = [frame.to_wgs84(place.e_m, place.n_m) for place in search.proposed[:MAX_PLACES]]
        if self._published_places != (search.tiles, best):
            self._published_places = search.tiles, best
            yield SearchPlaces(
                t_ns=prediction.t_ns,
                frame_id=prediction.frame_id,
                tiles=search.tiles,
                places=best,
                half_size_m=prediction.agl_m * math.hypot(camera.width / camera.fx, camera.height / camera.fy) / 2,
            )

    def _localized(self, prediction: Prediction) -> MapMatch:
        """The MapMatch of a frame. A failure of the learned model costs this frame; after several in a row the model is
        replaced by the describer without weights."""
        image = self._frames.get(prediction.frame_id)
        try:
            self._localizer.predict(prediction)
            if self._hint is not None and self._localizer.is_ready:
                self._pending.append(self._localizer.apply_prior(self._hint, prediction))
                self._hint = None
            if not self._load.takes_frame():
                return self._localizer.skipped(prediction, Verdict.THROTTLED)
            match = self._localizer.localize(prediction, image)
        except ModelRunError as error:
            self._pending += self._model.failed(prediction.t_ns, str(error))
            if self._model.given_up:
                describer = GradientDescriber()
                self._model = ModelMonitor(describer)
                self._localizer.replace_describer(describer, prediction.agl_m)
            return self._localizer.skipped(prediction, Verdict.MODEL_FAILED)
        if self._model.is_learned and not self._model.has_run:
            match = msgspec.structs.replace(
                match, matcher=match.matcher.replace(self._model.name, GradientDescriber.name)
            )
        self._pending += self._model.succeeded(prediction.t_ns)
        if self._correlator is not None and self._correlator.failure:
            self._pending.append(_correlator_event(prediction.t_ns, ModelChange.GIVEN_UP, self._correlator))
            self._correlator = None
        return match

    def _switch_model(self, prediction: Prediction) -> None:
        """Suspends the learned model, or resumes it."""
        self._model_suspended = not self._model_suspended
        if not self._model.is_learned:
            return
        describer = GradientDescriber() if self._model_suspended else self._describer
        self._localizer.replace_describer(describer, prediction.agl_m)
        change = ModelChange.SUSPENDED if self._model_suspended else ModelChange.RESUMED
        self._pending.append(self._model.event(prediction.t_ns, change, f"thermal band {self._load.band.value}"))


def _correlator_event(t_ns: int, change: ModelChange, correlator: GraphCorrelator) -> ModelEvent:
    provider = ", ".join(dict.fromkeys(short_name(one) for one in correlator.providers))
    detail = correlator.failure or "instead of the transforms of OpenCV"
    return ModelEvent(t_ns=t_ns, model=correlator.name, change=change, provider=provider, detail=detail)


def make_node(ctx: NodeContext) -> AnchorNode:
    """Opens the map and the model before take-off. Raises ConfigError, MapError, ModelError, UsageError. After a
    restart in flight a model that cannot be opened is replaced by the describer without weights, and correlation on a
    GPU by that on the processor."""
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
    model = ModelMonitor(describer, not_opened)
    load, places = ThermalLoad(ctx.config.health), _open_places(ctx)
    correlator = _open_correlator(ctx)
    return AnchorNode(ctx.frames, package, describer, wanted.ce90_m, model, ctx.cache_dir, load, places, correlator)


def _open_correlator(ctx: NodeContext) -> GraphCorrelator | None:
    """Raises ModelError before take-off."""
    models = ctx.config.models
    if models.correlation == "cpu":
        return None
    try:
        return open_correlator(models.folder)
    except (ManifestError, ModelFileError) as error:
        if ctx.epoch_ns is not None:
            return None
        todo = 'terrafix models export, then terrafix models build; or set [models] correlation = "cpu"'
        raise ModelError(f"correlation on the GPU: {error}; {todo}") from None


def _open_places(ctx: NodeContext) -> PlaceMemory | None:
    """The configured place index. A restart in flight compares no checksum, which would read the whole index, and flies
    without an index that cannot be opened. Raises MapError, ModelError, UsageError before take-off."""
    restarted = ctx.epoch_ns is not None
    try:
        return PlaceMemory.open(ctx.config.places, ctx.config.models.folder, verify=not restarted)
    except TerrafixError:
        if not restarted:
            raise
        return None
