"""Horizontal accuracy of a map layer: stated, estimated from another layer, or default; its use in the covariance."""

from pathlib import Path
from typing import cast

import msgspec
import numpy as np
import pytest
from rasterio.transform import Affine

import map_rasters
from map_packages import centre_of
from terrafix.anchor.matching.map_layers import MapLayers
from terrafix.core.camera import CameraCalibration
from terrafix.map.format import CE90_SIGMAS, Accuracy, Ce90Origin, Layer, accuracy_of
from terrafix.map.package import LocalMap, MapPackage
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_tools.mapping.build import build_package, layer_of
from terrafix_tools.mapping.mosaic import accuracy
from terrafix_tools.mapping.mosaic.accuracy import given_offset, with_estimates
from terrafix_tools.mapping.mosaic.overlap import GRID, Offset, agreed_offset, binomial_tail, register

DEFAULT = Accuracy(10.0, Ce90Origin.DEFAULT)
SHIFT_M = (6.0, -4.0)


def utm_layer(path: Path, seed: int, shift_m: tuple[float, float] = (0.0, 0.0)) -> Path:
    corner = Affine(0.5, 0, 300_000.0 + shift_m[0], 0, -0.5, 2_600_000.0 + shift_m[1])
    return map_rasters.write_tif(path, map_rasters.texture(500, 600, seed), "EPSG:32651", corner)


def package(folder: Path, ce90_m: tuple[float | None, float | None], seeds: tuple[int, int] = (1, 1)) -> MapPackage:
    """The same ground twice, the older layer shifted by SHIFT_M; different ground when the seeds differ."""
    new = layer_of(utm_layer(folder / "new.tif", seeds[0]), date="2023-01-01", ce90_m=ce90_m[0])
    old = layer_of(utm_layer(folder / "old.tif", seeds[1], SHIFT_M), date="2014-01-01", ce90_m=ce90_m[1])
    return MapPackage.open(build_package([new, old], folder / "m.gpkg"), verify=True)


def layer_accuracies(opened: MapPackage) -> list[tuple[float | None, Ce90Origin | None]]:
    opened.close()
    return [(layer.ce90_m, layer.ce90_origin) for layer in opened.manifest.layers]


def test_a_layer_is_estimated_from_its_offset_to_a_layer_with_stated_accuracy(tmp_path: Path) -> None:
    opened = package(tmp_path, (2.0, None))
    new, old = layer_accuracies(opened)
    assert new == (2.0, Ce90Origin.STATED)
    assert old[1] is Ce90Origin.ESTIMATED and old[0] is not None
    sigma_m = 2.0 / CE90_SIGMAS
    assert old[0] == pytest.approx(CE90_SIGMAS * np.hypot(np.hypot(*SHIFT_M) / np.sqrt(2.0), sigma_m), rel=0.05)
    assert opened.manifest.ce90_m == 2.0


def test_two_layers_without_stated_accuracy_are_both_estimated_and_the_manifest_has_the_newest(tmp_path: Path) -> None:
    opened = package(tmp_path, (None, None))
    new, old = layer_accuracies(opened)
    assert new == old and new[1] is Ce90Origin.ESTIMATED and new[0] == pytest.approx(8.9, abs=0.3)
    assert opened.manifest.ce90_m == new[0]


def test_stated_accuracies_are_not_estimated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(accuracy, "register", lambda *_: pytest.fail("registered, and nobody asked"))
    assert layer_accuracies(package(tmp_path, (2.0, 3.0))) == [(2.0, Ce90Origin.STATED), (3.0, Ce90Origin.STATED)]


def test_an_offset_is_second_layer_minus_first_layer(tmp_path: Path) -> None:
    opened = package(tmp_path, (2.0, 3.0))
    frame = centre_of(opened)
    found = register(opened.bind(frame, "imagery"), opened.bind(frame, "imagery_2"))
    opened.close()
    assert found is not None
    assert (found.east_m, found.north_m) == (pytest.approx(SHIFT_M[0], abs=0.2), pytest.approx(SHIFT_M[1], abs=0.2))


class Void:
    """A layer without valid pixels in a box; counts the windows that are read."""

    bounds_m = (-5000.0, -2000.0, 5000.0, 2000.0)

    def __init__(self, gsd_m: float) -> None:
        self.gsd_m = gsd_m
        self.asked_m: list[float] = []

    def window(self, _e: float, _n: float, width: int, height: int, gsd_m: float) -> tuple[np.ndarray, np.ndarray]:
        self.asked_m.append(gsd_m)
        return np.zeros((height, width, 3), np.uint8), np.zeros((height, width), bool)


def test_a_large_overlap_is_sampled_at_the_coarser_pixel_and_voids_are_skipped() -> None:
    first, second = Void(0.5), Void(3.0)
    assert register(cast(LocalMap, first), cast(LocalMap, second)) is None
    assert 0 < len(first.asked_m) <= GRID**2 and set(first.asked_m) == {3.0}
    assert second.asked_m == []


def test_layers_of_different_ground_give_no_estimate(tmp_path: Path) -> None:
    assert layer_accuracies(package(tmp_path, (2.0, None), seeds=(1, 2))) == [
        (2.0, Ce90Origin.STATED),
        (None, Ce90Origin.DEFAULT),
    ]


@pytest.mark.parametrize(("ce90_m", "sigma_m"), [(3.0, 3.0 / CE90_SIGMAS), (None, 7.0 / CE90_SIGMAS)])
def test_the_anchor_uses_the_accuracy_of_the_package(tmp_path: Path, ce90_m: float | None, sigma_m: float) -> None:
    built = build_package([layer_of(utm_layer(tmp_path / "i.tif", 1), ce90_m=ce90_m)], tmp_path / "m.gpkg")
    opened = MapPackage.open(built)
    camera = CameraCalibration(640, 360, 380.0, 380.0, 319.5, 179.5)
    layers = MapLayers(opened, centre_of(opened), camera, GradientDescriber(), 7.0)
    assert layers.best.sigma_m == pytest.approx(sigma_m)
    opened.close()


def one_layer(ce90_m: float | None, origin: Ce90Origin | None) -> Layer:
    return Layer(
        table="imagery",
        date="",
        licence="",
        source="",
        source_sha256="",
        ce90_m=ce90_m,
        ce90_origin=origin,
        gsd_m=0.5,
        crs="EPSG:32651",
        x_min=0.0,
        y_max=0.0,
        bounds=(0.0, 0.0, 1.0, 1.0),
        levels=(),
        tiles=0,
    )


def test_an_accuracy_without_recorded_origin_counts_as_stated() -> None:
    assert accuracy_of(one_layer(4.0, None), 10.0) == Accuracy(4.0, Ce90Origin.STATED)
    assert accuracy_of(one_layer(None, None), 12.0) == Accuracy(12.0, Ce90Origin.DEFAULT)
    kept = msgspec.json.decode(msgspec.json.encode(one_layer(4.0, Ce90Origin.ESTIMATED)), type=Layer)
    assert accuracy_of(kept, 10.0) == Accuracy(4.0, Ce90Origin.ESTIMATED)


def test_a_stated_layer_is_preferred_as_reference_and_then_the_farthest_one() -> None:
    layers = [one_layer(None, None), one_layer(None, None), one_layer(None, None), one_layer(2.0, None)]
    near, far = Offset(1.0, 0.0, 0.0, 50), Offset(14.0, 0.0, 0.0, 50)
    without = with_estimates(layers[:3], {(0, 1): near, (0, 2): far})
    assert without[0].ce90_m == without[2].ce90_m == round(given_offset(far, DEFAULT, DEFAULT), 1)
    assert without[1].ce90_m == round(given_offset(near, DEFAULT, DEFAULT), 1)
    stated = Accuracy(2.0, Ce90Origin.STATED)
    beside = with_estimates(layers, {(0, 1): near, (0, 2): far, (0, 3): near})
    assert beside[0].ce90_m == round(given_offset(near, DEFAULT, stated), 1)
    assert beside[3] == layers[3]
    assert with_estimates(layers, {})[0] == layers[0]


def test_two_coincident_layers_claim_at_least_0_7_of_the_default_error() -> None:
    assert given_offset(Offset(0.0, 0.0, 0.0, 50), DEFAULT, DEFAULT) == pytest.approx(10.0 / np.sqrt(2.0))


def test_an_offset_far_beyond_usual_map_errors_overrides_the_default() -> None:
    far = given_offset(Offset(60.0, 0.0, 0.0, 50), DEFAULT, Accuracy(2.0, Ce90Origin.STATED))
    assert far == pytest.approx(CE90_SIGMAS * 60.0 / np.sqrt(2.0), rel=0.005)


@pytest.mark.parametrize(("other", "other_m2"), [(Accuracy(0.0, Ce90Origin.STATED), 0.0), (DEFAULT, 21.7)])
def test_the_uncertainty_of_an_offset_is_combined_with_the_default(other: Accuracy, other_m2: float) -> None:
    vague = Offset(0.0, 0.0, 10.0, 1)
    known_m2 = other_m2 + vague.sigma_m**2
    left_m2 = 21.7 * known_m2 / (21.7 + known_m2)
    assert given_offset(vague, DEFAULT, other) == pytest.approx(CE90_SIGMAS * np.sqrt(left_m2 + 50.0), rel=1e-3)


def test_the_upper_tail_of_a_binomial_distribution() -> None:
    assert binomial_tail(0, 5, 0.3) == pytest.approx(1.0)
    assert binomial_tail(4, 5, 0.5) == pytest.approx(6.0 / 32.0)


def test_an_estimate_is_not_better_than_a_stated_accuracy_that_it_may_share() -> None:
    alike = Offset(0.0, 0.0, 0.0, 50)
    assert given_offset(alike, DEFAULT, Accuracy(6.0, Ce90Origin.STATED)) == pytest.approx(6.0)
    assert given_offset(alike, DEFAULT, Accuracy(40.0, Ce90Origin.STATED)) == pytest.approx(10.0)


def test_the_patch_to_patch_variance_is_split_between_both_layers() -> None:
    smooth, rough = (given_offset(Offset(0.0, 0.0, s, 10**9), DEFAULT, DEFAULT) for s in (0.0, 2.0))
    assert (rough**2 - smooth**2) / CE90_SIGMAS**2 == pytest.approx(2.0, rel=1e-3)


@pytest.mark.parametrize(
    ("times", "stated", "least"), [(1.0, None, 0.89), (1.0, 3.0, 0.89), (3.0, 3.0, 0.89), (3.0, None, 0.75)]
)
def test_the_estimated_ce90_contains_the_errors_of_independent_layers(
    times: float, stated: float | None, least: float
) -> None:
    """Also when map errors are ``times`` the default, whose circle contains only 23 % of them."""
    rng = np.random.default_rng(3)
    other = DEFAULT if stated is None else Accuracy(stated, Ce90Origin.STATED)
    own_m = rng.normal(0.0, times * DEFAULT.sigma_m, (4000, 2))
    other_m = rng.normal(0.0, other.sigma_m if stated else times * other.sigma_m, (4000, 2))
    inside = [
        np.hypot(*e) <= given_offset(Offset(*(e - f), 0.0, 50), DEFAULT, other)
        for e, f in zip(own_m, other_m, strict=True)
    ]
    assert np.mean(inside) >= least


def test_patches_with_random_offsets_give_no_layer_offset() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        assert agreed_offset(rng.uniform(-30.0, 30.0, (140, 2)), 2.25, 30.0) is None
    assert agreed_offset(np.zeros((0, 2)), 2.25, 30.0) is None


def test_twelve_agreeing_patches_are_significant_over_a_wide_search_only() -> None:
    rng = np.random.default_rng(6)
    right = rng.normal([6.0, -4.0], 0.4, (12, 2))
    wrong = rng.uniform(-30.0, 30.0, (100, 2))
    found = agreed_offset(np.vstack([right, wrong]), 2.25, 30.0)
    assert found is not None and 11 <= found.patches <= 14
    assert (found.east_m, found.north_m) == (pytest.approx(6.0, abs=0.4), pytest.approx(-4.0, abs=0.4))
    assert 0.15 < found.scatter_m < 0.8 and found.sigma_m == pytest.approx(
        1.2533 * found.scatter_m / found.patches**0.5
    )
    assert agreed_offset(np.vstack([right, wrong * 0.25]), 2.25, 7.5) is None
    assert agreed_offset(right[:7], 2.25, 30.0) is None
