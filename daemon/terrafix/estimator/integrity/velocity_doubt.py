"""Whether the velocity of the estimate is what is wrong, because motions of images contradict it for long, keep to one
side of the prediction, or were those of one image that was repeated."""

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from terrafix.estimator.integrity.motion_gate import MotionInnovation
from terrafix.estimator.integrity.signed_innovations import RUN_SIZE, SignedInnovations
from terrafix.estimator.state import HORIZONTAL
from terrafix.messages import Verdict

MOTION_TIMEOUT_S = 5.0  # of a vehicle with inertial aiding alone [spec: EKF2_NOAID_TOUT of PX4]


@dataclass(frozen=True)
class RefusedMotion:
    """Impossible motions in a row: time of the first; ``inertial``: inertial readings contradict all of them."""

    since_s: float
    inertial: bool


@dataclass(frozen=True)
class KnownMotion:
    """V (8,) at ``t_s``, with covariance (8, 8)."""

    t_s: float
    motion: np.ndarray
    cov: np.ndarray


class VelocityDoubt:
    """``refused``: motions that go on; None: none do. ``before_static``: of the frame before the first of a run that
    shows one view; None: there is none, or it has been used."""

    def __init__(self) -> None:
        self.refused: RefusedMotion | None = None
        self.before_static: KnownMotion | None = None
        self._signed = SignedInnovations()  # of odometry that is fused
        self._before = deque[KnownMotion](maxlen=RUN_SIZE)  # what each of these was predicted from, the newest first
        self._shown_since_s: float | None = None  # by fused odometry; None: velocity is unknown

    def on_unknown(self) -> None:
        """Velocity is unknown from here on."""
        self.refused, self._shown_since_s = None, None

    def on_fused(self, since_s: float) -> None:
        """Odometry since ``since_s`` is fused."""
        if self._shown_since_s is None:
            self._shown_since_s = since_s

    def note(self, verdict: Verdict, innovation: MotionInnovation | None, t_s: float) -> None:
        """``verdict``: on the odometry of the frame at ``t_s``."""
        if verdict is Verdict.UNCONFIRMED:  # two frames close together allow what a longer time does not
            return
        inertial = innovation is not None and innovation.inertial
        if verdict is not Verdict.IMPLAUSIBLE:
            self.refused = None
        elif self.refused is None:
            self.refused = RefusedMotion(t_s, inertial)
        elif innovation is not None and not inertial:
            self.refused = replace(self.refused, inertial=False)

    def is_timed_out(self, t_s: float, fix_s: float | None) -> bool:
        """Whether impossible motions have gone on for so long, since the last map match at ``fix_s``, that velocity may
        be what is wrong: for as long as motions that agreed had shown it before."""
        if self.refused is None:
            return False
        since_s, shown_s = self.refused.since_s, self._shown_since_s
        limit_s = min(MOTION_TIMEOUT_S, math.inf if shown_s is None else since_s - shown_s)
        return t_s - max(since_s, -math.inf if fix_s is None else fix_s) >= limit_s

    def is_to_one_side(self, innovation: MotionInnovation, before: KnownMotion) -> bool:
        """Whether innovations of fused odometry have kept one sign for so long that velocity is what is wrong.
        ``before``: what this one was predicted from."""
        cov_m2 = innovation.cov_m2[HORIZONTAL, HORIZONTAL]
        self._signed.add(innovation.residual_m[HORIZONTAL], cov_m2, inertial=innovation.inertial)
        self._before.appendleft(before)
        return self._signed.alarm

    def take_run(self) -> tuple[np.ndarray, KnownMotion]:
        """Ends the run that ``is_to_one_side`` has found. -> sum of its innovations (2,) and the motion before it."""
        sum_m, before = self._signed.sum_m, self._before[self._signed.run - 1]
        self._signed.forget()
        self._before.clear()
        return sum_m, before
