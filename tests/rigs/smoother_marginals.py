"""Which marginals the smoother computes."""

from collections.abc import Callable

import numpy as np
import pytest

from terrafix.estimator.graph.fixed_lag import FixedLagSmoother

MARGINAL, JOINT = "marginal", "joint_marginal"


def recorded_marginals(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """-> MARGINAL or JOINT for each marginal that any smoother computes from here on."""
    names: list[str] = []

    def recorded(name: str) -> Callable[[FixedLagSmoother, int], np.ndarray]:
        compute = getattr(FixedLagSmoother, name)

        def marginal(smoother: FixedLagSmoother, of: int) -> np.ndarray:
            names.append(name)
            return np.asarray(compute(smoother, of))

        return marginal

    for name in (MARGINAL, JOINT):
        monkeypatch.setattr(FixedLagSmoother, name, recorded(name))
    return names
