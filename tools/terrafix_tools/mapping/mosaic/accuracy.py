"""Estimates the accuracy of layers without a stated one, from another layer that shows the same ground.

Per axis, the errors e and f of two layers are assumed independent and normal, with 1-sigma s and t. The measurement is
d = e - f, with the registration error r (1-sigma). Given d, e is normal (conditioning of a Gaussian):

    mean w d, variance s^2 (1 - w), with w = s^2 / (s^2 + t^2 + r^2)

For a layer without stated accuracy, s is the default (CE90 10 m: 4.7 m), or the value that d implies where that is
larger: the maximum likelihood s; for two such layers s^2 = |d|^2 / 4 per axis. The stored value is the CE90 of the
circular normal error with the same second moment about the layer as it lies, plus half of the variance from patch to
patch.

Two layers that were georeferenced with the same reference share an error that d does not show. The estimate is bounded
for that reason: for two layers without stated accuracy it is at least 1/sqrt(2) of the default, which is 7.1 m; beside
a layer with stated accuracy it is at least that accuracy."""

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from terrafix.core.config import Map
from terrafix.core.geodesy import LocalFrame
from terrafix.map.format import CE90_SIGMAS, Accuracy, Ce90Origin, Layer, accuracy_of
from terrafix.map.package import MapPackage
from terrafix_tools.mapping.mosaic.overlap import Offset, register
from terrafix_tools.mapping.package.rewrite import rewrite_manifest

Offsets = Mapping[tuple[int, int], Offset]  # by the indices of two layers, the smaller one first


def add_accuracy_estimates(package: Path) -> None:
    """Writes ``ce90_m`` of the layers without one that overlap another layer into a package; it must be unsigned."""
    opened = MapPackage.open(package)
    try:
        layers = with_estimates(opened.manifest.layers, _register_pairs(opened))
        manifest = msgspec.structs.replace(opened.manifest, layers=layers, ce90_m=layers[0].ce90_m)
        changed = manifest != opened.manifest
    finally:
        opened.close()
    if changed:
        rewrite_manifest(package, manifest)


def with_estimates(layers: Sequence[Layer], offsets: Offsets) -> tuple[Layer, ...]:
    """The reference of a layer is one with stated accuracy if there is one; among those the farthest one."""
    accuracies = [accuracy_of(layer, Map().ce90_m) for layer in layers]
    result = []
    for i, layer in enumerate(layers):
        by_stated, by_default = list[float](), list[float]()
        for pair, offset in offsets.items():
            if i in pair and accuracies[i].origin is Ce90Origin.DEFAULT:
                other = accuracies[pair[1 - pair.index(i)]]
                given = by_default if other.origin is Ce90Origin.DEFAULT else by_stated
                given.append(given_offset(offset, accuracies[i], other))
        if by_stated or by_default:
            ce90_m = min(by_stated) if by_stated else max(by_default)
            layer = msgspec.structs.replace(layer, ce90_m=round(ce90_m, 1), ce90_origin=Ce90Origin.ESTIMATED)
        result.append(layer)
    return tuple(result)


def given_offset(offset: Offset, own: Accuracy, other: Accuracy) -> float:
    """CE90 in metres of a layer without stated accuracy, from its offset to another one."""
    apart_m2 = (offset.east_m**2 + offset.north_m**2) / 2.0  # per axis
    if other.origin is not Ce90Origin.DEFAULT:
        known_m2 = other.sigma_m**2 + offset.sigma_m**2
        least_m2 = min(own.sigma_m**2, other.sigma_m**2)
        own_m2 = max(own.sigma_m**2, apart_m2 - known_m2)
    else:
        least_m2 = 0.0
        own_m2 = max(own.sigma_m**2, apart_m2 / 2.0)
        known_m2 = own_m2 + offset.sigma_m**2
    weight = own_m2 / (own_m2 + known_m2)
    moment_m2 = weight**2 * apart_m2 + own_m2 * (1.0 - weight) + offset.scatter_m**2 / 2.0
    return CE90_SIGMAS * math.sqrt(max(moment_m2, least_m2))


def _register_pairs(package: MapPackage) -> dict[tuple[int, int], Offset]:
    """Offsets of the pairs of imagery layers of which at least one has no stated accuracy."""
    layers = package.manifest.layers
    west, south, east, north = package.manifest.bounds_wgs84
    frame = LocalFrame((south + north) / 2, (west + east) / 2)
    offsets = {}
    for a, b in itertools.combinations(range(len(layers)), 2):
        if None in (layers[a].ce90_m, layers[b].ce90_m) and not layers[b].is_drawn:
            found = register(package.bind(frame, layers[a].table), package.bind(frame, layers[b].table))
            if found is not None:
                offsets[a, b] = found
    return offsets
