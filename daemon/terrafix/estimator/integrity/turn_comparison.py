"""How well the turns of a vehicle explain those of the images, at an unknown time offset between both.

A frame with a time stamp that is late by ``offset_s`` shows a turn that much after the autopilot reports it. The prior
of the offset is a mixture: cameras that stamp their frames, and a small share that does not. The noise of the turns is
marginalised, and so is the error of the camera's mount pitch: with a wrong one, a roll of the vehicle looks like a
turn."""

from dataclasses import dataclass

import numpy as np

from terrafix.estimator.integrity.offset_drift import STEP_S
from terrafix.estimator.integrity.time_offset import REPORT_WAIT_NS, UNSTAMPED_SHARE
from terrafix.estimator.measurements.telemetry_buffer import Telemetry
from terrafix.messages import STAMP_SIGMA_S

TURN_GRID_S = np.arange(-2.0, 2.0001, STEP_S)  # s: offsets of the density [spec: offset_drift.py, to 2 s both ways]
MIN_COMPARED_TURN_SIGMA_RAD = np.radians(0.3)  # lower limit of the 1-sigma of a turn between two frames [tuned]
MOUNT_PITCH_SIGMA_RAD = np.radians(1.5)  # 1-sigma of the mount pitch that remains after its calibration [tuned]
INDEPENDENT_TURN_SHARE = 0.5  # of the turns: two consecutive ones share a frame [tuned]
MEMORY_TURNS = 300.0  # turns: time constant of the exponential forgetting of the sums [tuned]


@dataclass(frozen=True)
class Turn:
    """Change of heading from ``t0_ns`` to ``t1_ns`` as images show it, clockwise."""

    t0_ns: int
    t1_ns: int
    yaw_rad: float


class TurnComparison:
    """``evidence`` of the turns that were added."""

    def __init__(self) -> None:
        self._pending: list[Turn] = []  # until attitudes have arrived that are as late as the grid reaches
        # Sums over turns, for each offset of the grid: squares of the residual "visual less reported turn", products of
        # residual and change of roll, squares of the change of roll, squares of the visual and of the reported turn.
        self._residual2, self._residual_roll, self._roll2, self._turned2 = np.zeros((4, len(TURN_GRID_S)))
        self._count = 0.0

    def add(self, turn: Turn, telemetry: Telemetry) -> None:
        """A turn between two frames, at their uncorrected time stamps."""
        self._pending.append(turn)
        self.compare(telemetry, turn.t1_ns)

    def compare(self, telemetry: Telemetry, frame_ns: int) -> None:
        """Compares the turns for which all attitudes have arrived. ``frame_ns``: time stamp of the newest frame."""
        newest_ns = telemetry.newest_turn_ns
        reach_ns = round(TURN_GRID_S[-1] * 1e9) + REPORT_WAIT_NS
        while self._pending and self._pending[0].t1_ns + reach_ns <= newest_ns:
            self._accumulate(self._pending.pop(0), telemetry)
        while self._pending and self._pending[0].t1_ns + 2 * reach_ns < frame_ns:  # no heading is reported
            del self._pending[0]

    @property
    def evidence(self) -> tuple[float, float]:
        """-> log of the likelihood ratio "the attitude turns as the images do, at an unknown offset" over "it turns
        independently of them", near 0 without turns; and the same for a single turn."""
        if self._count == 0.0:
            return 0.0, 0.0
        prior = (1.0 - UNSTAMPED_SHARE) * _normal(TURN_GRID_S, STAMP_SIGMA_S)
        prior += UNSTAMPED_SHARE / (TURN_GRID_S[-1] - TURN_GRID_S[0])
        independent = self._turned2 / self._count + MIN_COMPARED_TURN_SIGMA_RAD**2
        log = self._log_likelihood(self._noise) - self._log_likelihood(independent)
        total = float(log.max() + np.log(prior / prior.sum() @ np.exp(log - log.max())))
        return total, total / (0.5 * INDEPENDENT_TURN_SHARE * self._count)

    @property
    def _noise(self) -> np.ndarray:
        """Variance of the residual turns at each offset, without what an error of the mount pitch explains [rad^2]."""
        noise = self._residual2 / self._count + MIN_COMPARED_TURN_SIGMA_RAD**2
        by_mount = self._residual_roll**2 / (self._roll2 + noise / MOUNT_PITCH_SIGMA_RAD**2)
        return np.asarray(noise - by_mount / self._count)

    def _log_likelihood(self, variance: np.ndarray) -> np.ndarray:
        """Of the turns so far, whose ``variance`` is that of their own mean square."""
        return np.asarray(-0.5 * INDEPENDENT_TURN_SHARE * self._count * np.log(variance))

    def _accumulate(self, turn: Turn, telemetry: Telemetry) -> None:
        shift_ns = np.round(TURN_GRID_S * 1e9).astype(np.int64)
        before, after = (telemetry.turned_about(t_ns - shift_ns) for t_ns in (turn.t0_ns, turn.t1_ns))
        if before is None or after is None:
            return
        reported_rad = after[0] - before[0]
        residual_rad = (turn.yaw_rad - reported_rad + np.pi) % (2.0 * np.pi) - np.pi
        rolled = np.sin(after[2]) - np.sin(before[2])
        decay = 1.0 - 1.0 / MEMORY_TURNS
        self._residual2 = decay * self._residual2 + residual_rad**2
        self._residual_roll = decay * self._residual_roll + residual_rad * rolled
        self._roll2 = decay * self._roll2 + rolled**2
        reported_rad = (reported_rad + np.pi) % (2.0 * np.pi) - np.pi  # each end is unwrapped by itself
        self._turned2 = decay * self._turned2 + turn.yaw_rad**2 + reported_rad**2
        self._count = decay * self._count + 1.0


def _normal(x: np.ndarray, sigma: float) -> np.ndarray:
    """Density of N(0, sigma^2) at ``x``."""
    return np.asarray(np.exp(-0.5 * (x / sigma) ** 2) / (sigma * np.sqrt(2.0 * np.pi)))
