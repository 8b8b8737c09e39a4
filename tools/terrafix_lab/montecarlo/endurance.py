"""`terrafix montecarlo --endurance`: one long flight. Tests that time and memory per frame do not grow.

The time for a frame depends more on the load of the machine than on the growth that is tested for. So in the last part
of the flight a second estimator, restarted from a checkpoint there, processes the same messages. The processor times of
the old and the restarted estimator for the same frames are compared. Memory is measured in the part before."""

import math
import time
from typing import Any

import numpy as np
from rich.console import Console

from terrafix.estimator.node import EstimatorNode
from terrafix.estimator.prior import CheckpointGround, EstimatorCheckpoint, ground_of
from terrafix.messages import CalibrationEstimate, MapMatch, Message, NavEstimate, Odometry, Origin
from terrafix_lab.montecarlo.fault import DrawnFault
from terrafix_lab.montecarlo.flight import Run
from terrafix_lab.montecarlo.plan import plan

HOURS = 2.0
# Until then caches, the window and the nodes for the refinement fill up: 128 nodes, at least ten frames apart.
SETTLED_S = 1800.0
YOUNG_FROM_S = 4500.0
BLOCK = 30  # frames: each block gives one ratio of times and one point of the line through the memory
TIME_SHARE_PER_H = 0.01  # largest growth per hour, share of the time for one frame
MEMORY_MB_PER_H = 2.0  # largest growth


class RestartComparison(EstimatorNode):
    """With a second estimator from ``young_from_s`` on. ``frames_ms``: processor time [ms] of the old and of the young
    estimator, (2,) for each frame from then on."""

    def __init__(self, young_from_s: float) -> None:
        super().__init__()
        self.frames_ms: list[np.ndarray] = []
        self._from_ns = round(young_from_s * 1e9)
        self.young: EstimatorNode | None = None
        self._first: Origin | None = None
        self._calibration: CalibrationEstimate | None = None
        self._ground: CheckpointGround | None = None

    def on(self, message: Message) -> list[Message]:
        old_on, young = super().on, self.young
        if young is None:
            published = list(old_on(message))
            self._update_checkpoint([message, *published])
            return published
        if isinstance(message, Odometry):
            self.frames_ms.append(np.zeros(2))
        spent_ms = self.frames_ms[-1] if self.frames_ms else np.zeros(2)
        published = []
        # The first of the two runs with cold caches: the order alternates.
        for i in (0, 1) if len(self.frames_ms) % 2 else (1, 0):
            start_s = time.process_time()
            output = list(young.on(message) if i else old_on(message))
            spent_ms[i] += 1e3 * (time.process_time() - start_s)
            published = published if i else output
        return published

    def _update_checkpoint(self, messages: list[Message]) -> None:
        """Collects the checkpoint of a restarted process; an estimate from ``young_from_s`` on starts the young one."""
        for message in messages:
            match message:
                case Origin():
                    self._first = message
                case CalibrationEstimate():
                    self._calibration = message
                case MapMatch():
                    self._ground = ground_of(message) or self._ground
                case NavEstimate() if message.t_ns >= self._from_ns and self._first is not None:
                    self.young = EstimatorNode(0, EstimatorCheckpoint(message, self._calibration, self._ground))
                    list(self.young.on(self._first))
                    return
                case _:
                    pass


def endurance(seed: int) -> dict[str, Any]:
    """Flies for HOURS without the refinement after landing. -> ``slopes``, which are printed as well."""
    estimators = RestartComparison(YOUNG_FROM_S)
    flight = Run(plan(seed, 0, fault=DrawnFault.NONE, duration_s=3600.0 * HOURS), estimators)
    record = flight.record(refine=False)
    alone = (record.t_s >= SETTLED_S) & (record.t_s < YOUNG_FROM_S)
    compared = np.array(estimators.frames_ms)[-int((record.t_s >= YOUNG_FROM_S + SETTLED_S).sum()) :]
    result = slopes(record.t_s[alone], record.memory_mb[alone], compared, YOUNG_FROM_S / 3600.0)
    Console().print(
        f"{HOURS:g} h: {result['cpu_ms']:.1f} ms of processor time a frame, {100 * result['cpu_share_per_h']:+.2f} "
        f"+- {100 * result['cpu_share_sigma']:.2f} % an hour; memory {result['memory_mb']:.0f} MB, "
        f"{result['memory_mb_per_h']:+.1f} MB an hour: {'flat' if result['flat'] else 'NOT FLAT'}",
        highlight=False,
        soft_wrap=True,
    )
    return result


def slopes(t_s: np.ndarray, memory_mb: np.ndarray, compared_ms: np.ndarray, older_h: float) -> dict[str, Any]:
    """Growth of memory and time. ``memory_mb`` (N,) at ``t_s`` (N,): a straight line is fitted. ``compared_ms`` (M, 2):
    times of an estimator and of one that is ``older_h`` younger for the same frames."""
    whole = len(compared_ms) // BLOCK * BLOCK
    sums = compared_ms[:whole].reshape(-1, BLOCK, 2).sum(axis=1)
    ratios = sums[:, 0] / sums[:, 1]
    share_per_h = float(np.median(ratios) - 1.0) / older_h
    # Variance of a median: pi/2 times that of a mean. Normal distribution: sigma is 1.48 times the MAD.
    spread = 1.4826 * float(np.median(np.abs(ratios - np.median(ratios))))
    points = len(t_s) // BLOCK * BLOCK
    hours, memory = (np.median(v[:points].reshape(-1, BLOCK), axis=1) for v in (t_s / 3600.0, memory_mb))
    memory_per_h = float(np.polyfit(hours, memory, 1)[0])
    return {
        "cpu_ms": float(np.median(compared_ms[:, 0])),
        "cpu_share_per_h": share_per_h,
        "cpu_share_sigma": math.sqrt(math.pi / 2.0 / len(ratios)) * spread / older_h,
        "memory_mb": float(memory[-1]),
        "memory_mb_per_h": memory_per_h,
        "flat": share_per_h < TIME_SHARE_PER_H and memory_per_h < MEMORY_MB_PER_H,
    }
