"""Exact search: the scalar product of every query with every vector."""

import numpy as np

# vectors whose scalar products are in memory at a time, 34 MB of float32 at 128 numbers [spec: no effect on results]
CHUNK = 65_536


class ExactSearch:
    """``vectors`` (N, D) float16 unit vectors, may be memory-mapped."""

    name = "exact"

    def __init__(self, vectors: np.ndarray) -> None:
        self._vectors = vectors

    def search(self, queries: np.ndarray, count: int, allowed: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """As ``Backend.search``."""
        rows = len(queries)
        best, ids = np.full((rows, count), -np.inf, np.float32), np.full((rows, count), -1)
        for first in range(0, len(self._vectors), CHUNK):
            part = np.arange(first, min(first + CHUNK, len(self._vectors)))
            if allowed is not None:
                part = part[allowed[part]]
            if not len(part):
                continue
            vectors = self._vectors[first : first + CHUNK] if len(part) == CHUNK else self._vectors[part]
            scores = np.concatenate([best, queries @ vectors.astype(np.float32).T], axis=1)
            among = np.concatenate([ids, np.broadcast_to(part, (rows, len(part)))], axis=1)
            chosen = np.argpartition(scores, -count, axis=1)[:, -count:]
            best, ids = np.take_along_axis(scores, chosen, 1), np.take_along_axis(among, chosen, 1)
        order = np.argsort(-best, axis=1, kind="stable")
        return np.take_along_axis(best, order, 1), np.take_along_axis(ids, order, 1)
