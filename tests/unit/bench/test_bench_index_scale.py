"""Benchmark of large place indices: statistics of the generated descriptors, and the comparison of both searches."""

from pathlib import Path

import numpy as np
import pytest

import map_rasters
from terrafix_tools.bench.search import index_scale
from terrafix_tools.bench.search.index_scale import Mixture, compare, peak_mb, resembling, text_of, write_generated
from terrafix_tools.bench.search.index_views import similarities
from terrafix_tools.bench.search.views import TwoDates

SIZE = 16


def unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True), np.float32)


@pytest.fixture(scope="module")
def real() -> np.ndarray:
    """Unit vectors of three clusters of different weight and spread."""
    rng = np.random.default_rng(4)
    centres, spread = rng.normal(size=(3, SIZE)), rng.uniform(0.1, 0.6, (3, SIZE))
    labels = rng.choice(3, 6000, p=[0.6, 0.3, 0.1])
    return unit(centres[labels] + spread[labels] * rng.normal(size=(6000, SIZE)))


def test_generated_descriptors_have_mean_covariance_and_neighbours_of_the_real_ones(real: np.ndarray) -> None:
    drawn = Mixture.fit(real).draw(6000, np.random.default_rng(5))
    assert np.linalg.norm(drawn, axis=1) == pytest.approx(1.0, abs=1e-5)
    assert drawn.mean(axis=0) == pytest.approx(real.mean(axis=0), abs=0.03)
    assert np.cov(drawn.T) == pytest.approx(np.cov(real.T), abs=0.03)
    products = [np.quantile(a[:3000] @ a[3000:].T, (0.5, 0.9, 0.999)) for a in (drawn, real)]
    assert products[0] == pytest.approx(products[1], abs=0.05)


def test_the_order_of_generated_descriptors_tells_nothing_about_their_cluster(real: np.ndarray) -> None:
    drawn = Mixture.fit(real).draw(4000, np.random.default_rng(6))
    assert drawn[:2000].mean(axis=0) == pytest.approx(drawn[2000:].mean(axis=0), abs=0.05)


def test_a_query_has_the_requested_similarity_to_its_disc(real: np.ndarray) -> None:
    similarity = np.linspace(-0.2, 0.95, 50)
    queries = resembling(real[:50], real[50:100], similarity)
    assert np.linalg.norm(queries, axis=1) == pytest.approx(1.0, abs=1e-5)
    assert np.sum(queries * real[:50], axis=1) == pytest.approx(similarity, abs=1e-5)


def test_both_searches_are_measured_on_the_same_queries(
    real: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(index_scale, "CHUNK", 700)
    build_s = write_generated(tmp_path, Mixture.fit(real), np.array([1.0]), 1.0, 10)
    exact, faiss = compare(tmp_path, 1.0, build_s)
    assert (exact.strategy, faiss.strategy) == ("exact", "faiss")
    assert exact.discs == faiss.discs == round(1e6 / (0.75 * 120.0 / 4) ** 2)
    assert exact.agreement == 1.0 and faiss.agreement > 0.6
    assert exact.recall == [1.0, 1.0, 1.0] and faiss.recall[0] > 0.6
    for row in (exact, faiss):
        assert 0.0 < row.median_s <= row.p95_s and row.cpu_s > 0.0 and row.peak_mb > 30.0
        assert len(text_of(row).split()) == 19
    assert (exact.build_s, faiss.build_s) == (0.0, build_s)
    assert exact.file_mb == pytest.approx(exact.discs * SIZE * 2 / 1e6, rel=0.1)


def test_the_peak_memory_is_that_of_this_process() -> None:
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak, to which earlier tests of this process add
    before_mb = peak_mb()
    block = np.ones(30_000_000)  # 240 MB
    assert block.sum() > 0.0 and peak_mb() > before_mb + 100.0


def test_the_similarity_is_that_of_a_frame_with_the_ground_below_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same image on both sides: only heading and place differ, by what a search leaves open."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first = map_rasters.utm(tmp_path / "a.tif", map_rasters.texture(720, 720, seed=7))
    other = map_rasters.utm(tmp_path / "b.tif", map_rasters.texture(720, 720, seed=8))
    same, different = similarities(TwoDates(first, first), 60.0, 8), similarities(TwoDates(first, other), 60.0, 8)
    assert len(same) == len(different) == 8
    assert np.median(same) > 0.7 and np.abs(np.median(different)) < 0.25
