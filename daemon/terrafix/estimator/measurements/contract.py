"""The contract of a measurement: an innovation with its covariance, one gate, one verdict (PX4 EKF2, `aid_sources`)."""

from typing import Protocol

from terrafix.estimator.filter_state import FilterState
from terrafix.estimator.integrity.innovation import FusionVerdict, Innovation
from terrafix.messages import Verdict


class Measurement(Protocol):
    """One sample of a quantity at a node of the graph. A new measurement is one class of this form."""

    @property
    def name(self) -> str:
        """Name of the measurement in its verdicts (``MeasurementVerdict.measurement``)."""

    def innovation(self, state: FilterState, node: int) -> Innovation:
        """Measurement minus prediction by the newest estimate of ``node``, with covariance and gate."""

    def add_to(self, state: FilterState, node: int) -> None:
        """Adds its factors to the graph."""


def fuse(state: FilterState, node: int, measurement: Measurement) -> FusionVerdict:
    """Evaluates ``measurement``, gates it, and adds it to ``node`` of the window."""
    fusion = measurement.innovation(state, node).verdict(measurement.name)
    if fusion.verdict is Verdict.ACCEPTED:
        measurement.add_to(state, node)
    return fusion
