"""Custom factors with a cache of their last linearization.

iSAM2 linearises a factor again whenever its part of the tree is eliminated again, mostly at the same values: these
change only when a variable exceeds its relinearization threshold (fixed_lag.py). The cached result is identical to the
last bit."""

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C

MAX_ENTRIES = 160  # factors in the cache: four per node, of two windows [spec: size of the window]

Error = Callable[[Any, gtsam.Values, list[np.ndarray] | None], np.ndarray]
# Error function -> values of its keys, residual, Jacobians; the most recently used at the end.
_cache = OrderedDict[Error, tuple[list[bytes], np.ndarray, gtsam.JacobianVector]]()
_POSE_SYMBOL = gtsam.symbolChr(C(0))  # [spec: symbol of C_k]


def custom_factor(noise: gtsam.noiseModel.Base, keys: list[int], error: Error) -> gtsam.CustomFactor:
    """gtsam.CustomFactor whose ``error`` depends on the values of ``keys`` alone (C_k: Pose3; the others: vectors)."""
    variables = [(key, gtsam.symbolChr(key) == _POSE_SYMBOL) for key in keys]

    def cached_error(this: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        if jacobians is None:
            return error(this, values, None)
        pose, vector = values.atPose3, values.atVector
        at = [(pose(key).matrix() if is_pose else vector(key)).tobytes() for key, is_pose in variables]
        entry = _cache.get(error)
        if entry is None or entry[0] != at:
            computed = [np.zeros((0, 0))] * len(keys)
            residual = error(this, values, computed)
            entry = _cache[error] = (at, residual, gtsam.JacobianVector(computed))
            if len(_cache) > MAX_ENTRIES:
                _cache.popitem(last=False)
        _cache.move_to_end(error)
        jacobians[:] = entry[2]
        return entry[1]

    return gtsam.CustomFactor(noise, keys, cached_error)
