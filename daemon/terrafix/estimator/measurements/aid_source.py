"""Base of measurements beside odometry and map matches (PX4 EKF2: `aid_sources`). The table is in aiding.py."""

from dataclasses import dataclass

from terrafix.estimator.filter_state import FilterState, FrameState, ImuQuery
from terrafix.estimator.measurements.contract import Measurement
from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.state import NodeState
from terrafix.messages import Verdict


@dataclass(frozen=True)
class AidSample:
    """The newest ``node`` and the telemetry at its frame, ``dt_s`` after the node before. ``observed``: odometry was
    fused, or the vehicle stands."""

    node: int
    t_s: float
    attitude: Attitude
    imu: ImuQuery
    dt_s: float
    observed: bool


class AidSource:
    """One source of measurements. ``leads_step``: where it is fused without odometry, the step for the anchor's belief
    is that of the corrected node."""

    leads_step = False

    def __init__(self, state: FilterState) -> None:
        self._state = state

    def measurement(self, sample: AidSample) -> Measurement | None:
        """What is measured at ``sample``; None: nothing, or it cannot be used."""
        raise NotImplementedError

    def on_fused(self, sample: AidSample, verdict: Verdict) -> None:
        """The gate accepted or rejected that measurement."""

    def after_frame(self, frame: FrameState, attitude: Attitude) -> None:
        """The estimate of a frame with odometry, from which a source may learn its own errors."""

    def observes_velocity(self, t_s: float, node: NodeState, attitude: Attitude) -> bool:
        """Whether this source will bound the velocity of a frame without odometry at ``t_s``, after ``node``."""
        return False
