"""Factors written in Python, which remember what they answered last.

iSAM2 asks a factor again whenever its part of the tree is eliminated anew, mostly around the very values of the time
before: values change only when a variable has moved far enough (fixed_lag.py). The answer is the same to the last
bit."""

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C

# As many factors remember: four for each node, of two windows. Those that left the window have no need to.
MOST = 160

Error = Callable[[Any, gtsam.Values, list[np.ndarray] | None], np.ndarray]
_answers = OrderedDict[Error, tuple[list[bytes], np.ndarray, gtsam.JacobianVector]]()  # the newest at the end
_POSE = gtsam.symbolChr(C(0))


def custom_factor(noise: gtsam.noiseModel.Base, keys: list[int], error: Error) -> gtsam.CustomFactor:
    """gtsam.CustomFactor; ``error`` is a function of the values of ``keys`` alone (C_k: Pose3; the others: vectors)."""
    variables = [(key, gtsam.symbolChr(key) == _POSE) for key in keys]

    def asked(this: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        if jacobians is None:
            return error(this, values, None)
        around = [
            (values.atPose3(key).matrix() if is_pose else values.atVector(key)).tobytes() for key, is_pose in variables
        ]
        known = _answers.get(error)
        if known is None or known[0] != around:
            by = [np.zeros((0, 0))] * len(keys)
            residual = error(this, values, by)
            known = _answers[error] = (around, residual, gtsam.JacobianVector(by))
            if len(_answers) > MOST:
                _answers.popitem(last=False)
        _answers.move_to_end(error)
        jacobians[:] = known[2]
        return known[1]

    return gtsam.CustomFactor(noise, keys, asked)
