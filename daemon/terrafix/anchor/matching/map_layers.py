"""The layers of a map: one bound map and one matcher per date, and the selection of the layer in use."""

import copy
from dataclasses import dataclass, replace
from pathlib import Path

from terrafix.anchor.matching.descriptor_cache import DESCRIPTOR_CACHE_BYTES, Describer
from terrafix.anchor.matching.descriptor_store import MAX_TILES, DescriptorStore
from terrafix.anchor.matching.frame_matcher import CorrelationResult, FrameMatcher, View
from terrafix.anchor.matching.layer_selector import LayerSelector
from terrafix.anchor.matching.point_mass_filter import Belief
from terrafix.anchor.place_index.recognizer import PlaceMemory, PlaceRecognizer
from terrafix.anchor.verification.consensus_pose import ConsensusPose
from terrafix.core.camera import CameraCalibration, Readout
from terrafix.core.geodesy import LocalFrame
from terrafix.core.node import Image
from terrafix.map.format import DRAWN_TABLE, accuracy_of
from terrafix.map.null_model import NullModel, NullRow, null_row_for
from terrafix.map.package import LocalMap, MapPackage
from terrafix.messages import Verdict
from terrafix_engines.correlation import GraphCorrelator


@dataclass(frozen=True)
class MapLayer:
    """One map layer. ``sigma_m``: position error, 1-sigma per horizontal axis. ``null``: null model of this layer
    (scores of the best wrong places), None if it was not measured. ``recognizer``: place recognition by an index of
    this layer, None if there is none. ``drawn``: from roads, water and buildings."""

    map: LocalMap
    matcher: FrameMatcher
    consensus: ConsensusPose
    sigma_m: float
    null: NullModel | None
    recognizer: PlaceRecognizer | None = None
    drawn: bool = False

    def null_at(self, agl_m: float) -> NullRow:
        return null_row_for(self.null, self.matcher.gradients.name, agl_m)


class MapLayers:
    """All layers of one package. ``ce90_m``: accuracy of layers that state none. ``store_folder``: folder in memory for
    computed descriptors. ``places``: a place index, of this package or of others too. ``correlator``: on a
    GPU."""

    def __init__(
        self,
        package: MapPackage,
        frame: LocalFrame,
        camera: CameraCalibration,
        describer: Describer,
        ce90_m: float,
        store_folder: Path | None = None,
        places: PlaceMemory | None = None,
        correlator: GraphCorrelator | None = None,
    ) -> None:
        layers = package.manifest.layers
        self._all: dict[str, MapLayer] = {}
        for layer in layers:
            bound = package.bind(frame, layer.table)
            store = None
            if store_folder is not None:
                store = DescriptorStore(
                    store_folder, f"{_file_identity(package)} {frame} {layer.table}", MAX_TILES // len(layers)
                )
            cache_bytes = DESCRIPTOR_CACHE_BYTES // len(layers)
            matcher = FrameMatcher(camera, bound, describer, cache_bytes, store, layer.is_drawn, correlator)
            sigma_m = accuracy_of(layer, ce90_m).sigma_m
            recognizer = None
            if places is not None and (indexed := places.index.layer(package.manifest.checksum, layer.table)):
                recognizer = PlaceRecognizer(places, indexed, frame)
            self._all[layer.table] = MapLayer(
                bound, matcher, ConsensusPose(matcher), sigma_m, layer.null_model, recognizer, layer.is_drawn
            )
        tables = [layer.table for layer in layers]
        self._drawn = DRAWN_TABLE if tables[0] != DRAWN_TABLE and DRAWN_TABLE in tables else None  # beside imagery
        self._selector = LayerSelector([table for table in tables if table != self._drawn])

    def set_lens(self, radial_k1: float, readout: Readout | None) -> None:
        """Sets the distortion of the division model in all matchers, from the estimator's self-calibration, and the
        rolling shutter of the frame."""
        for layer in self._all.values():
            layer.matcher.camera = replace(layer.matcher.camera, radial_k1=radial_k1, readout=readout)

    @property
    def best(self) -> MapLayer:
        return self._all[self._selector.best]

    def correlate(self, image: Image, view: View, belief: Belief) -> dict[str, CorrelationResult]:
        """Correlation with the layer in use, first, and from time to time with a second one. With the drawn layer where
        the first one is evidence against the belief."""
        tables = self._selector.layers_to_correlate()
        results = {table: self._correlate(table, image, view, belief) for table in tables}
        if self._drawn and results[self._selector.best].evidence_nats < 0.0:
            results[self._drawn] = self._correlate(self._drawn, image, view, belief)
        return results

    def _correlate(self, table: str, image: Image, view: View, belief: Belief) -> CorrelationResult:
        result = self._all[table].matcher.correlate(image, view, belief)
        if not self._drawn or result.verdict is not Verdict.ACCEPTED:
            return result
        return replace(result, evidence_nats=copy.copy(belief).update(result.surfaces, 1.0))

    def select(
        self, results: dict[str, CorrelationResult], belief: Belief, weight: float
    ) -> tuple[MapLayer, CorrelationResult]:
        """The layer to use for this frame, with its result. ``belief``: before the correlation, so that no layer is
        scored at its own maximum; ``weight``: share of new ground."""
        if len(self._all) == 1:
            return self.best, results[self._selector.best]
        mode = belief.mode()
        scores = {
            table: result.best_at(mode.e_m, mode.n_m)[1] if result.verdict is Verdict.ACCEPTED else None
            for table, result in results.items()
            if table != self._drawn
        }
        used = self._selector.update(scores, weight) or next(iter(results))
        if self._drawn in results and results[self._drawn].evidence_nats > results[used].evidence_nats:
            used = self._drawn
        return self._all[used], results[used]


def _file_identity(package: MapPackage) -> str:
    """Identity of the package file. Size and time of change distinguish a rebuilt file of the same name."""
    status = package.path.stat()
    return f"{package.path} {status.st_size} {status.st_mtime_ns}"
