"""Exact and FAISS search of place descriptors: the same answers, filters, and files that do not belong together."""

import sys
from pathlib import Path

import numpy as np
import pytest

from terrafix.anchor.place_index import exact
from terrafix.anchor.place_index.exact import ExactSearch
from terrafix.anchor.place_index.faiss_ivf import FaissSearch, write_faiss
from terrafix.core.errors import MapError, UsageError

COUNT, SIZE, NEAREST = 4000, 24, 5


def unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True), np.float32)


@pytest.fixture(scope="module")
def vectors() -> np.ndarray:
    """In 60 clusters, as places are."""
    rng = np.random.default_rng(1)
    centres = rng.normal(size=(60, SIZE))
    return unit(centres[rng.integers(0, 60, COUNT)] + 0.5 * rng.normal(size=(COUNT, SIZE))).astype(np.float16)


@pytest.fixture(scope="module")
def queries(vectors: np.ndarray) -> np.ndarray:
    """Noisy copies of the vectors 7, 107, 207, ..."""
    rng = np.random.default_rng(2)
    return unit(vectors[7::100].astype(np.float32) + 0.08 * rng.normal(size=(40, SIZE)))


@pytest.fixture(scope="module")
def faiss_file(vectors: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("index") / "ivf.faiss"
    write_faiss(vectors, path)
    return path


def ranked(vectors: np.ndarray, queries: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Ids of the nearest vectors by a plain sort."""
    scores = queries @ vectors.astype(np.float32).T
    scores[:, ~among] = -np.inf
    return np.argsort(-scores, axis=1)[:, :NEAREST]


@pytest.mark.parametrize("chunk", [500, 4000, 10_000])
def test_the_exact_search_returns_the_largest_scalar_products_in_order(
    vectors: np.ndarray, queries: np.ndarray, monkeypatch: pytest.MonkeyPatch, chunk: int
) -> None:
    monkeypatch.setattr(exact, "CHUNK", chunk)
    scores, ids = ExactSearch(vectors).search(queries, NEAREST, None)
    assert (ids == ranked(vectors, queries, np.ones(COUNT, bool))).all()
    assert scores[3] == pytest.approx(vectors[ids[3]].astype(np.float32) @ queries[3], abs=1e-6)
    assert (np.diff(scores, axis=1) <= 0.0).all()


@pytest.mark.parametrize("chunk", [500, 10_000])
def test_the_exact_search_returns_allowed_vectors_only(
    vectors: np.ndarray, queries: np.ndarray, monkeypatch: pytest.MonkeyPatch, chunk: int
) -> None:
    monkeypatch.setattr(exact, "CHUNK", chunk)
    allowed = np.arange(COUNT) % 3 == 1
    _, ids = ExactSearch(vectors).search(queries, NEAREST, allowed)
    assert (ids == ranked(vectors, queries, allowed)).all()


def test_faiss_agrees_with_the_exact_search(vectors: np.ndarray, queries: np.ndarray, faiss_file: Path) -> None:
    scores, ids = FaissSearch(faiss_file, COUNT).search(queries, NEAREST, None)
    exact_scores, exact_ids = ExactSearch(vectors).search(queries, NEAREST, None)
    assert np.mean(ids[:, 0] == 7 + 100 * np.arange(40)) > 0.9
    assert np.mean([len(set(a) & set(b)) / NEAREST for a, b in zip(ids, exact_ids, strict=True)]) > 0.95
    same = ids == exact_ids
    assert scores[same] == pytest.approx(exact_scores[same], abs=0.02)  # 8 bits a number


def test_faiss_finds_all_allowed_vectors_however_few_they_are(
    vectors: np.ndarray, queries: np.ndarray, faiss_file: Path
) -> None:
    """A position prior leaves a small part of the map, whose vectors lie in any of the lists."""
    allowed = np.zeros(COUNT, bool)
    allowed[[3, 1001, 2002, 3999]] = True
    scores, ids = FaissSearch(faiss_file, COUNT).search(queries, NEAREST, allowed)
    assert all(set(row) == {3, 1001, 2002, 3999, -1} for row in ids)
    assert np.isneginf(scores[ids < 0]).all() and np.isfinite(scores[ids >= 0]).all()
    exact_scores, exact_ids = ExactSearch(vectors).search(queries, NEAREST, allowed)
    assert (exact_ids[:, -1] == -1).all() and np.isneginf(exact_scores[:, -1]).all()


def test_a_file_of_another_index_is_refused(faiss_file: Path, tmp_path: Path) -> None:
    with pytest.raises(MapError, match="has 4000 vectors, not 3999"):
        FaissSearch(faiss_file, COUNT - 1)
    broken = tmp_path / "ivf.faiss"
    broken.write_bytes(faiss_file.read_bytes()[:1000])
    with pytest.raises(MapError, match=r"cannot be read by FAISS.*terrafix map index"):
        FaissSearch(broken, COUNT)


def test_without_faiss_one_line_states_what_to_install(faiss_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "faiss", None)
    with pytest.raises(UsageError, match=r"pip install 'terrafix\[faiss\]'"):
        FaissSearch(faiss_file, COUNT)
