"""`terrafix montecarlo --endurance`: one long flight, whether time and memory of the estimator stay as they are.

How long a frame takes depends on what else the machine does, more than on anything that is looked for here. So in the
last part of the flight a second estimator hears the same messages, which knows no more of it than one that was started
again there: what is compared is the time that the old and the young one take for the same frames. Memory is that of
the part before."""

import math
import time
from typing import Any

import msgspec
import numpy as np
from rich.console import Console

from terrafix.estimator.node import EstimatorNode
from terrafix.estimator.prior import EstimatorCheckpoint
from terrafix.messages import MapMatch, Message, NavEstimate, Odometry, Origin, SlowErrors
from terrafix_tools.montecarlo.fault import Fault
from terrafix_tools.montecarlo.flight import Run
from terrafix_tools.montecarlo.plan import FlightPlan, plan

HOURS = 2.0
# At first caches and windows fill, and what is kept for the refinement: 128 nodes, ten frames apart at least.
SETTLED_S = 1800.0
YOUNG_FROM_S = 4500.0
BLOCK = 30  # frames: the ratio of their sums is one of the ratios, memory a point of its line
TIME_SHARE_PER_H = 0.01  # of the time for one frame
MEMORY_MB_PER_H = 2.0


class OldAndYoung(Run):
    """``young_from_s``: when the second estimator begins. ``frames_ms``: of each frame from then on what the old and
    the young one took, processor time."""

    def __init__(self, flight: FlightPlan, young_from_s: float) -> None:
        super().__init__(flight)
        self.frames_ms: list[np.ndarray] = []
        self._from_ns = round(young_from_s * 1e9)
        self._young: EstimatorNode | None = None
        self._origin: Origin | None = None
        self._slow: SlowErrors | None = None
        self._ground: MapMatch | None = None

    def hear(self, message: Message) -> list[Message]:
        if self._young is None:
            said = super().hear(message)
            self._remember([message, *said])
            return said
        if isinstance(message, Odometry):
            self.frames_ms.append(np.zeros(2))
        spent_ms = self.frames_ms[-1] if self.frames_ms else np.zeros(2)
        said = []
        # Who is first finds the message in no cache: they take turns.
        for i in (0, 1) if len(self.frames_ms) % 2 else (1, 0):
            began_s = time.process_time()
            heard = list(self._young.on(message)) if i else super().hear(message)
            spent_ms[i] += 1e3 * (time.process_time() - began_s)
            said = said if i else heard
        return said

    def _remember(self, messages: list[Message]) -> None:
        """What a process that is started again would know; the last estimate starts the young one."""
        for message in messages:
            match message:
                case Origin():
                    self._origin = message
                case SlowErrors():
                    self._slow = message
                case MapMatch() if message.ground is not None:
                    self._ground = msgspec.structs.replace(message, matches=[])
                case NavEstimate() if message.t_ns >= self._from_ns and self._origin is not None:
                    self._young = EstimatorNode(0, EstimatorCheckpoint(message, self._slow, self._ground))
                    list(self._young.on(self._origin))
                    return
                case _:
                    pass


def endurance(seed: int) -> dict[str, Any]:
    """Flies for HOURS without the refinement after landing. -> slopes, and whether they are flat."""
    flight = OldAndYoung(plan(seed, 0, fault=Fault.NONE, duration_s=3600.0 * HOURS), YOUNG_FROM_S)
    record = flight.record(refine=False)
    alone = (record.t_s >= SETTLED_S) & (record.t_s < YOUNG_FROM_S)
    compared = np.array(flight.frames_ms)[-int((record.t_s >= YOUNG_FROM_S + SETTLED_S).sum()) :]
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
    """A straight line through the memory (N,) of each frame; and ``compared_ms`` (M, 2), what an estimator and one that
    is ``older_h`` younger took for the same frames."""
    whole = len(compared_ms) // BLOCK * BLOCK
    sums = compared_ms[:whole].reshape(-1, BLOCK, 2).sum(axis=1)
    ratios = sums[:, 0] / sums[:, 1]
    share_per_h = float(np.median(ratios) - 1.0) / older_h
    # Of a median: pi/2 times the variance of a mean (for a normal distribution, whose sigma is 1.48 times the MAD).
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
