"""The measurement contract: innovation, gate, verdict, and what reaches the record."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from simulated_flight import ORIGIN
from terrafix.estimator.filter_state import FilterState
from terrafix.estimator.integrity.innovation import FusionVerdict, Innovation
from terrafix.estimator.measurements.contract import fuse
from terrafix.estimator.output import verdict_of
from terrafix.messages import Verdict


@dataclass
class Rangefinder:
    """A scalar measurement whose factors are counted."""

    residual_m: float
    sigma_m: float
    name: str = "rangefinder"
    added_to: list[int] = field(default_factory=list)

    def innovation(self, state: FilterState, node: int) -> Innovation:
        return Innovation.scalar(self.residual_m, self.sigma_m, 3.0)

    def add_to(self, state: FilterState, node: int) -> None:
        self.added_to.append(node)


def test_mahalanobis_distance_uses_the_whole_covariance() -> None:
    covariance = np.array([[4.0, 1.0], [1.0, 9.0]])
    residual = np.array([2.0, -3.0])
    innovation = Innovation(residual, covariance, 10.0)
    expected = residual @ np.linalg.inv(covariance) @ residual
    assert innovation.mahalanobis2 == pytest.approx(expected)
    assert innovation.test_ratio == pytest.approx(expected / 10.0)


@pytest.mark.parametrize(
    ("residual_m", "accepted"), [(0.0, True), (-5.9, True), (5.9, True), (6.1, False), (-6.1, False)]
)
def test_a_scalar_is_accepted_within_its_gate(residual_m: float, accepted: bool) -> None:
    measurement = Rangefinder(residual_m, 2.0)
    verdict = fuse(FilterState(ORIGIN), 7, measurement)
    assert verdict.verdict is (Verdict.ACCEPTED if accepted else Verdict.INNOVATION)
    assert measurement.added_to == ([7] if accepted else [])
    assert verdict.innovation is not None and (verdict.innovation.test_ratio <= 1.0) is accepted


def test_a_published_verdict_has_innovation_variance_and_ratio() -> None:
    message = verdict_of(5, 3, fuse(FilterState(ORIGIN), 0, Rangefinder(8.0, 2.0)))
    assert (message.t_ns, message.frame_id, message.measurement) == (5, 3, "rangefinder")
    assert (message.innovation, message.innovation_variance) == ((8.0,), (4.0,))
    assert message.mahalanobis2 == pytest.approx(16.0) and message.test_ratio == pytest.approx(16.0 / 9.0)


def test_a_verdict_without_an_innovation_has_none_of_its_fields() -> None:
    message = verdict_of(0, 0, FusionVerdict("odometry", Verdict.STALE, None, "why"))
    assert (message.mahalanobis2, message.innovation, message.innovation_variance) == (None, (), ())
    assert message.test_ratio is None and message.detail == "why"
