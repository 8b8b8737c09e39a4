"""Approximate search by FAISS: an inverted file over 8-bit vectors (IVF, SQ8), memory-mapped (Douze et al., The Faiss
library, 2024). FAISS is imported on first use: what flies over a small map starts without it."""

from pathlib import Path
from types import ModuleType

import numpy as np

from terrafix.core.errors import MapError, UsageError

# Number of inverted lists in square roots of the number of vectors. More of them are slower to learn, with the same
# recall for the same share that is read. [measured: docs/search.md]
LISTS_PER_ROOT = 1.0
TRAIN_PER_LIST = 40  # vectors from which the centre of a list is learnt, FAISS's lowest number [spec: FAISS]
ADD_CHUNK = 100_000  # vectors that are added at a time, 51 MB at 128 numbers [spec: no effect on results]
# Share of the lists that a query reads, and the least number of them [measured: docs/search.md]
PROBED_SHARE, MIN_PROBED = 1 / 8, 16
# Share of the range of values by which the 8 bits reach beyond that of the vectors that they are learnt from. Values
# beyond are clipped: without it the similarity of one vector in 200 was off by 0.06, with it none by more than 0.02.
# [measured: tests/unit/anchor/place_index/test_place_search.py]
RANGE_MARGIN = 0.2
SEED = 3  # of the vectors from which lists are learnt [spec: any]


class FaissSearch:
    name = "faiss"

    def __init__(self, path: Path, count: int) -> None:
        """Raises MapError: ``path`` is no index of ``count`` vectors; UsageError: FAISS is not installed."""
        self._faiss = _faiss()
        try:
            index = self._faiss.read_index(str(path), self._faiss.IO_FLAG_MMAP)
        except RuntimeError:
            raise MapError(f"{path}: cannot be read by FAISS; make it again: terrafix map index") from None
        if index.ntotal != count:
            raise MapError(f"{path}: has {index.ntotal} vectors, not {count}; make it again: terrafix map index")
        self._index = index
        self._lists = int(index.nlist)

    def search(self, queries: np.ndarray, count: int, allowed: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """As ``Backend.search``. Of a small part of the vectors more lists are read, in proportion, up to all."""
        share = 1.0 if allowed is None else max(float(allowed.mean()), 1e-9)
        probed = max(round(self._lists * PROBED_SHARE / share), MIN_PROBED)
        options = self._faiss.SearchParametersIVF(nprobe=min(probed, self._lists))
        if allowed is not None:
            bits = np.packbits(allowed, bitorder="little")
            options.sel = self._faiss.IDSelectorBitmap(bits)
        scores, ids = self._index.search(np.ascontiguousarray(queries, np.float32), count, params=options)
        scores[ids < 0] = -np.inf
        return scores, ids


def write_faiss(vectors: np.ndarray, path: Path) -> None:
    """Makes the index of ``vectors`` (N, D) float16. Raises UsageError: FAISS is not installed."""
    faiss = _faiss()
    total, size = vectors.shape
    lists = max(min(round(LISTS_PER_ROOT * total**0.5), total // TRAIN_PER_LIST), 1)
    index = faiss.index_factory(size, f"IVF{lists},SQ8", faiss.METRIC_INNER_PRODUCT)
    index.sq.rangestat_arg = RANGE_MARGIN
    chosen = np.random.default_rng(SEED).choice(total, min(lists * TRAIN_PER_LIST, total), replace=False)
    index.train(vectors[np.sort(chosen)].astype(np.float32))
    for first in range(0, total, ADD_CHUNK):
        index.add(vectors[first : first + ADD_CHUNK].astype(np.float32))
    faiss.write_index(index, str(path))


def _faiss() -> ModuleType:
    try:
        import faiss
    except ModuleNotFoundError:
        raise UsageError(
            "a place index of this size needs faiss; install it: pip install 'terrafix[faiss]', "
            'or set [places] search = "exact"'
        ) from None
    return faiss
