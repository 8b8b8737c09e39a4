"""Time offset between camera and autopilot, from turns that both observe (the calibration state td of OpenVINS; Qin and
Shen 2018, "Online temporal calibration for monocular visual-inertial systems").

A frame with a time stamp that is late by ``offset_s`` shows a turn that much after the autopilot reports it. The offset
has a density over a grid. Its prior is a mixture: cameras that stamp their frames, and a small share that does not.
The noise of the turns is marginalised, so that a wandering compass widens the density. So is the error of the camera's
mount pitch: with a wrong one, a roll of the vehicle looks like a turn, as it does with a time offset."""

from dataclasses import dataclass

import numpy as np

from terrafix.core.gate import MIN_COMPONENT_WEIGHT
from terrafix.estimator.measurements.telemetry_buffer import Telemetry

GRID_S = np.arange(-2.0, 2.0001, 0.05)  # s: offsets of the density [tuned]
RESOLUTION_S2 = (GRID_S[1] - GRID_S[0]) ** 2 / 12.0  # s^2 [spec: variance of a uniform density over a grid cell]
# 1-sigma of the offset of frames that are stamped on arrival: exposure, readout and transfer of USB cameras [s].
PRIOR_SIGMA_S = 0.03  # [tuned]
UNSTAMPED_SHARE = 0.01  # of cameras whose buffers or pipeline may delay by anything on the grid [tuned]
MIN_TURN_SIGMA_RAD = np.radians(0.3)  # lower limit of the 1-sigma of a turn between two frames [tuned]
MOUNT_PITCH_SIGMA_RAD = np.radians(1.5)  # 1-sigma of the mount pitch that remains after its calibration [tuned]
INDEPENDENT_SHARE = 0.5  # of the turns: two consecutive ones share a reported heading and a keyframe [tuned]
MEMORY_TURNS = 300.0  # turns: time constant of the exponential forgetting of the sums [tuned]
REPORT_WAIT_NS = 250_000_000  # ns beyond the grid until all attitudes have arrived: two periods at 8 Hz [tuned]
APPLY_MIN_SIGMAS = 4.0  # 1-sigmas by which an offset differs from 0 before it is applied [tuned]
APPLY_MAX_SIGMA_S = 0.1  # s: largest 1-sigma of an offset that is applied [tuned]
MAX_SLEW = 0.2  # s/s: rate of change of the applied offset [tuned]


@dataclass(frozen=True)
class Turn:
    """Change of heading from ``t0_ns`` to ``t1_ns`` as images show it, clockwise."""

    t0_ns: int
    t1_ns: int
    yaw_rad: float


class TurnComparison:
    """``applied_s``: the offset to subtract from the time stamps of frames; 0 until it is significant."""

    def __init__(self) -> None:
        self.applied_s = 0.0
        self._pending: list[Turn] = []  # until attitudes have arrived that are as late as the grid reaches
        # Sums over turns, for each offset of the grid: squares of the residual "visual less reported turn", products of
        # residual and change of roll, squares of the change of roll, squares of the visual and of the reported turn.
        self._residual2, self._residual_roll, self._roll2, self._turned2 = np.zeros((4, len(GRID_S)))
        self._count = 0.0

    def add(self, turn: Turn, telemetry: Telemetry) -> None:
        """A turn between two frames, at their uncorrected time stamps."""
        self._pending.append(turn)
        self.compare(telemetry, turn.t1_ns)

    def compare(self, telemetry: Telemetry, frame_ns: int) -> None:
        """Compares the turns for which all attitudes have arrived. ``frame_ns``: time stamp of the newest frame."""
        newest_ns = telemetry.newest_turn_ns
        reach_ns = round(GRID_S[-1] * 1e9) + REPORT_WAIT_NS
        while self._pending and self._pending[0].t1_ns + reach_ns <= newest_ns:
            self._accumulate(self._pending.pop(0), telemetry)
        while self._pending and self._pending[0].t1_ns + 2 * reach_ns < frame_ns:  # no heading is reported
            del self._pending[0]

    @property
    def density(self) -> tuple[np.ndarray, float]:
        """-> probabilities over ``GRID_S``, and the probability of a camera that does not stamp its frames."""
        stamped, unstamped = (
            (1.0 - UNSTAMPED_SHARE) * _normal(GRID_S, PRIOR_SIGMA_S),
            np.full(len(GRID_S), UNSTAMPED_SHARE / (GRID_S[-1] - GRID_S[0])),
        )
        if self._count > 0.0:
            log = self._log_likelihood(self._noise)
            likelihood = np.exp(log - log.max())
            stamped, unstamped = stamped * likelihood, unstamped * likelihood
        total = float(stamped.sum() + unstamped.sum())
        return (stamped + unstamped) / total, float(unstamped.sum()) / total

    @property
    def evidence(self) -> tuple[float, float]:
        """-> log of the likelihood ratio "the attitude turns as the images do, at an unknown offset" over "it turns
        independently of them", near 0 without turns; and the same for a single turn."""
        if self._count == 0.0:
            return 0.0, 0.0
        prior = (1.0 - UNSTAMPED_SHARE) * _normal(GRID_S, PRIOR_SIGMA_S)
        prior += UNSTAMPED_SHARE / (GRID_S[-1] - GRID_S[0])
        independent = self._turned2 / self._count + MIN_TURN_SIGMA_RAD**2
        log = self._log_likelihood(self._noise) - self._log_likelihood(independent)
        total = float(log.max() + np.log(prior / prior.sum() @ np.exp(log - log.max())))
        return total, total / (0.5 * INDEPENDENT_SHARE * self._count)

    @property
    def _noise(self) -> np.ndarray:
        """Variance of the residual turns at each offset, without what an error of the mount pitch explains [rad^2]."""
        noise = self._residual2 / self._count + MIN_TURN_SIGMA_RAD**2
        by_mount = self._residual_roll**2 / (self._roll2 + noise / MOUNT_PITCH_SIGMA_RAD**2)
        return np.asarray(noise - by_mount / self._count)

    def _log_likelihood(self, variance: np.ndarray) -> np.ndarray:
        """Of the turns so far, whose ``variance`` is that of their own mean square."""
        return np.asarray(-0.5 * INDEPENDENT_SHARE * self._count * np.log(variance))

    @property
    def estimate(self) -> tuple[float, float]:
        """Mean and 1-sigma of the density [s]."""
        density, _ = self.density
        mean = float(density @ GRID_S)
        return mean, float(np.sqrt(density @ (GRID_S - mean) ** 2 + RESOLUTION_S2))

    @property
    def sigma_s(self) -> float:
        """1-sigma of the offset that remains after correction.

        The prior's sigma limits it until the probability of a camera that does not stamp its frames reaches
        MIN_COMPONENT_WEIGHT, where that component affects a 95 % ellipse."""
        density, unstamped = self.density
        remaining_s = float(np.sqrt(density @ (GRID_S - self.applied_s) ** 2 + RESOLUTION_S2))
        return remaining_s if unstamped >= MIN_COMPONENT_WEIGHT else min(remaining_s, PRIOR_SIGMA_S)

    def step(self, dt_s: float) -> None:
        """Moves ``applied_s`` towards the estimate if that is significant, else towards 0. ``dt_s``: since the last
        frame."""
        mean_s, sigma_s = self.estimate
        significant = sigma_s < APPLY_MAX_SIGMA_S and abs(mean_s) > APPLY_MIN_SIGMAS * max(sigma_s, PRIOR_SIGMA_S)
        target_s = mean_s if significant else 0.0
        max_step_s = MAX_SLEW * max(dt_s, 0.0)
        self.applied_s += float(np.clip(target_s - self.applied_s, -max_step_s, max_step_s))

    def _accumulate(self, turn: Turn, telemetry: Telemetry) -> None:
        shift_ns = np.round(GRID_S * 1e9).astype(np.int64)
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
