"""Time offset between camera and autopilot, from turns that both see (as the calibration state td of OpenVINS, Qin and
Shen 2018, "Online temporal calibration for monocular visual-inertial systems").

A picture that is stamped ``offset_s`` late shows a turn so much after the autopilot reports it. The offset is held as a
density over a grid: the prior is that of a camera which stamps its frames, with a small share of one that does not.
The noise of the turns is not assumed but marginalised, so that a compass that wanders widens the density. So is the
pitch of the camera in its mount: if it is not as described, a vehicle that rolls seems to turn, as it does in pictures
that are late."""

from dataclasses import dataclass

import numpy as np

from terrafix.core.gate import LEAST_WEIGHT
from terrafix.estimator.measurements.telemetry_buffer import Telemetry

GRID_S = np.arange(-2.0, 2.0001, 0.05)
RESOLUTION_S2 = (GRID_S[1] - GRID_S[0]) ** 2 / 12.0
PRIOR_S = 0.03  # 1-sigma of a frame that is stamped when it arrives: exposure, readout and transfer of USB cameras
STRAY = 0.01  # share of cameras whose buffers or pipeline may delay by anything on the grid
TURN_FLOOR_RAD = np.radians(0.3)  # 1-sigma of a turn between two frames, at least
MOUNT_RAD = np.radians(1.5)  # 1-sigma of what is not learnt of the camera's pitch in its mount
# Of the turns: two in a row share a reported heading and a keyframe.
INDEPENDENT = 0.5
REMEMBERED = 300.0  # turns, after which the share of one is a third
REPORTS_NS = 250_000_000  # of attitudes that are waited for beyond the grid: two at 8 Hz
SURE_SIGMAS = 4.0
SURE_S = 0.1  # 1-sigma of an offset that is applied, at most
SLEW = 0.2  # of the time between two frames: by so much the applied offset changes


@dataclass(frozen=True)
class Turn:
    """Change of heading from ``t0_ns`` to ``t1_ns`` as pictures show it, clockwise."""

    t0_ns: int
    t1_ns: int
    yaw_rad: float


class TimeOffset:
    """``applied_s``: what is taken from the times of pictures. 0 while it may be nothing."""

    def __init__(self) -> None:
        self.applied_s = 0.0
        self._waiting: list[Turn] = []  # for attitudes as late as the grid reaches
        # Sums over turns, for each offset: squares of "seen less reported", its products with changes of roll, and the
        # squares of those.
        self._squares, self._products, self._rolls = np.zeros((3, len(GRID_S)))
        self._count = 0.0

    def add(self, turn: Turn, telemetry: Telemetry) -> None:
        """A turn between frames, at their own stamps."""
        self._waiting.append(turn)
        newest_ns = telemetry.newest_turn_ns
        reach_ns = round(GRID_S[-1] * 1e9) + REPORTS_NS
        while self._waiting and self._waiting[0].t1_ns + reach_ns <= newest_ns:
            self._weigh(self._waiting.pop(0), telemetry)
        while self._waiting and self._waiting[0].t1_ns + 2 * reach_ns < turn.t1_ns:  # nobody reports a heading
            del self._waiting[0]

    @property
    def density(self) -> tuple[np.ndarray, float]:
        """Over ``GRID_S``, and how much of it is a camera's that does not stamp its frames."""
        stamped, stray = (
            (1.0 - STRAY) * _normal(GRID_S, PRIOR_S),
            np.full(len(GRID_S), STRAY / (GRID_S[-1] - GRID_S[0])),
        )
        if self._count > 0.0:
            noise = self._squares / self._count + TURN_FLOOR_RAD**2
            by_mount = self._products**2 / (self._rolls + noise / MOUNT_RAD**2)
            log = -0.5 * INDEPENDENT * self._count * np.log(noise - by_mount / self._count)
            likelihood = np.exp(log - log.max())
            stamped, stray = stamped * likelihood, stray * likelihood
        total = float(stamped.sum() + stray.sum())
        return (stamped + stray) / total, float(stray.sum()) / total

    @property
    def estimate(self) -> tuple[float, float]:
        """Mean and 1-sigma of the density [s]."""
        density, _ = self.density
        mean = float(density @ GRID_S)
        return mean, float(np.sqrt(density @ (GRID_S - mean) ** 2 + RESOLUTION_S2))

    @property
    def sigma_s(self) -> float:
        """1-sigma of what is left. A camera that does not stamp its frames counts from the weight on at which it
        reaches into a 95 % ellipse: until turns show it, it is rare."""
        density, stray = self.density
        left_s = float(np.sqrt(density @ (GRID_S - self.applied_s) ** 2 + RESOLUTION_S2))
        return left_s if stray >= LEAST_WEIGHT else min(left_s, PRIOR_S)

    def step(self, dt_s: float) -> None:
        """``applied_s`` of the next frame, ``dt_s`` after the last: it follows the estimate where that is sure."""
        mean_s, sigma_s = self.estimate
        wanted_s = mean_s if sigma_s < SURE_S and abs(mean_s) > SURE_SIGMAS * max(sigma_s, PRIOR_S) else 0.0
        most_s = SLEW * max(dt_s, 0.0)
        self.applied_s += float(np.clip(wanted_s - self.applied_s, -most_s, most_s))

    def _weigh(self, turn: Turn, telemetry: Telemetry) -> None:
        shift_ns = np.round(GRID_S * 1e9).astype(np.int64)
        before, after = (telemetry.turned_about(t_ns - shift_ns) for t_ns in (turn.t0_ns, turn.t1_ns))
        if before is None or after is None:
            return
        off_rad = (turn.yaw_rad - (after[0] - before[0]) + np.pi) % (2.0 * np.pi) - np.pi
        rolled = np.sin(after[2]) - np.sin(before[2])
        keep = 1.0 - 1.0 / REMEMBERED
        self._squares = keep * self._squares + off_rad**2
        self._products = keep * self._products + off_rad * rolled
        self._rolls = keep * self._rolls + rolled**2
        self._count = keep * self._count + 1.0


def _normal(x: np.ndarray, sigma: float) -> np.ndarray:
    return np.asarray(np.exp(-0.5 * (x / sigma) ** 2) / (sigma * np.sqrt(2.0 * np.pi)))
