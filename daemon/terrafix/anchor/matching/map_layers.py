"""The layers of a map as the anchor sees them: a map and a matcher for every date of the place, and which is in use."""

from dataclasses import dataclass, replace
from pathlib import Path

from terrafix.anchor.matching.descriptor_cache import CACHE_BYTES, Describer
from terrafix.anchor.matching.descriptor_store import MOST, DescriptorStore
from terrafix.anchor.matching.frame_matcher import CorrelationResult, FrameMatcher, View
from terrafix.anchor.matching.layer_selector import LayerChoice
from terrafix.anchor.matching.point_mass_filter import Belief, Mode
from terrafix.anchor.verification.consensus_pose import ConsensusPose
from terrafix.core.camera import CameraCalibration
from terrafix.core.geodesy import LocalFrame
from terrafix.core.node import Image
from terrafix.map.format import accuracy_of
from terrafix.map.null_model import NullModel, NullRow, null_at
from terrafix.map.package import LocalMap, MapPackage
from terrafix.messages import Verdict


@dataclass(frozen=True)
class MapLayer:
    """One layer. ``sigma_m``: error of its position, 1-sigma per horizontal axis. ``null``: what the best wrong places
    of it score, if somebody has measured that."""

    map: LocalMap
    matcher: FrameMatcher
    agreed: ConsensusPose
    sigma_m: float
    null: NullModel | None

    def null_at(self, agl_m: float) -> NullRow:
        return null_at(self.null, self.matcher.gradients.name, agl_m)


class Layers:
    """``ce90_m`` counts for the layers that have none. ``shelf``: folder in memory for what was computed of them."""

    def __init__(
        self,
        package: MapPackage,
        frame: LocalFrame,
        camera: CameraCalibration,
        describer: Describer,
        ce90_m: float,
        shelf: Path | None = None,
    ) -> None:
        layers = package.manifest.layers
        self._all: dict[str, MapLayer] = {}
        for layer in layers:
            bound = package.bind(frame, layer.table)
            kept = None
            if shelf is not None:
                kept = DescriptorStore(shelf, f"{_file(package)} {frame} {layer.table}", MOST // len(layers))
            matcher = FrameMatcher(camera, bound, describer, CACHE_BYTES // len(layers), kept)
            sigma_m = accuracy_of(layer, ce90_m).sigma_m
            self._all[layer.table] = MapLayer(bound, matcher, ConsensusPose(bound, matcher), sigma_m, layer.null_model)
        self._choice = LayerChoice([layer.table for layer in layers])

    def see_through(self, bend: float) -> None:
        """A lens that bends more than its description says, by as much."""
        for dated in self._all.values():
            dated.matcher.camera = replace(dated.matcher.camera, bend=bend)

    @property
    def best(self) -> MapLayer:
        return self._all[self._choice.best]

    def looks(self, image: Image, view: View, belief: Belief) -> dict[str, CorrelationResult]:
        """The best layer's look, first, and now and then another one's."""
        return {table: self._all[table].matcher.look(image, view, belief) for table in self._choice.wanted()}

    def chosen(
        self, looks: dict[str, CorrelationResult], mode: Mode, weight: float
    ) -> tuple[MapLayer, CorrelationResult]:
        """The layer to use for this frame. ``mode``: what was believed before the looks, so that none of them is asked
        about itself; ``weight`` of the looks (new ground)."""
        scores = {
            table: look.best_at(mode.e_m, mode.n_m)[1] if look.verdict is Verdict.ACCEPTED else None
            for table, look in looks.items()
        }
        used = self._choice.looked(scores, weight) or next(iter(looks))
        return self._all[used], looks[used]


def _file(package: MapPackage) -> str:
    """Which file it is: one that was built anew under the same name is another one."""
    about = package.path.stat()
    return f"{package.path} {about.st_size} {about.st_mtime_ns}"
