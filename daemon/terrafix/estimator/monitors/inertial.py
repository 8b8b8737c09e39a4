"""Velocity changes that pictures show against those that accelerometers felt: scale and mount, without any map.

A told height or focal length that is off stretches every velocity that pictures show; a camera that is mounted
otherwise than described turns it. Both leave the accelerometers alone, and a wrong compass turns both alike. So
dv_seen = gain * dv_felt, with a gain that is 1 where the description is right. Height and focal length have the same
trace (a ray's tangent times a height); they are one quantity here."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from terrafix.estimator.monitors.cusum import Cusum, threshold

WINDOW_S = 4.0  # between the velocities that are compared: a turn, a braking
LONGEST_S = 15.0
# 1-sigma of a velocity change over a window, per axis: a tilt that is off by 1 degree is 0.17 m/s^2 for 4 s; and of a
# velocity that pictures show, attitude noise of 0.3 degrees over half a second at 100 m.
TILT_MPS2, SEEN_MPS = 0.17, 1.0
SHARE = 0.15  # of the change: heights over uneven ground, a focal length within its usual sigma
REMEMBERED = 0.9  # of the fit of a hypothesis, from window to window
LEAST_LIKELY = -20.0  # nats: no single window decides which fault it is
LEAST_CHANGE_MPS = 2.0  # smaller changes cannot tell the hypotheses apart


MOUNT_YAWS_DEG = (0.0, 90.0, -90.0, 180.0)  # clockwise beyond the description; pictures are levelled with each


@dataclass(frozen=True)
class Hypothesis:
    quantity: str
    factor: float  # of the told height over the true one, or degrees by which the camera is turned clockwise
    gain: float  # velocity seen over velocity felt
    mount: int  # of MOUNT_YAWS_DEG


HYPOTHESES = (
    *(Hypothesis("scale", f, f, 0) for f in (0.5, 0.7, 1.43, 2.0, 1 / 3.28, 3.28)),
    *(Hypothesis("mount yaw", deg, 1.0, i) for i, deg in enumerate(MOUNT_YAWS_DEG) if i),
)


class InertialMonitor:
    """Velocities are (4,) complex, east + i north: as pictures show them if the camera is mounted by MOUNT_YAWS_DEG."""

    def __init__(self) -> None:
        limit = threshold(3600.0 / WINDOW_S, len(HYPOTHESES))
        self._tests = [(h, Cusum(limit)) for h in HYPOTHESES]
        self._fits = [0.0] * len(HYPOTHESES)  # log-likelihoods of the last windows: which fault it is
        self._seen: deque[tuple[float, np.ndarray]] = deque()

    @property
    def fault(self) -> Hypothesis | None:
        """The hypothesis that fits best of those that have been accepted, if any."""
        active = [(self._fits[i], i) for i, (_, test) in enumerate(self._tests) if test.active]
        return self._tests[max(active)[1]][0] if active else None

    def window(self, t_s: float) -> float | None:
        """Time from which a change until ``t_s`` is asked for; None: no window ends yet."""
        while self._seen and t_s - self._seen[0][0] > LONGEST_S:
            self._seen.popleft()
        if self._seen and t_s - self._seen[0][0] >= WINDOW_S:
            return self._seen[0][0]
        return None

    def add(self, t_s: float, seen_mps: np.ndarray) -> None:
        """A velocity that pictures show at ``t_s``."""
        if not self._seen or t_s > self._seen[-1][0]:
            self._seen.append((t_s, seen_mps))

    def compare(self, t_s: float, seen_mps: np.ndarray, felt_mps: complex) -> None:
        """The velocity that pictures show at ``t_s``, and the change since ``window`` that was felt. Windows do not
        overlap."""
        began_s, before_mps = self._seen[0]
        self._seen.clear()
        change_mps = seen_mps - before_mps
        if max(abs(felt_mps), abs(change_mps[0])) < LEAST_CHANGE_MPS:
            return
        false = _log_likelihood(change_mps[0], felt_mps, t_s - began_s)
        for i, (hypothesis, test) in enumerate(self._tests):
            true = _log_likelihood(change_mps[hypothesis.mount], hypothesis.gain * felt_mps, t_s - began_s)
            test.add(true - false)
            self._fits[i] = REMEMBERED * self._fits[i] + max(true, LEAST_LIKELY)


def _log_likelihood(seen: complex, expected: complex, span_s: float) -> float:
    variance = (TILT_MPS2 * span_s) ** 2 + 2.0 * SEEN_MPS**2 + (SHARE * abs(expected)) ** 2
    return -0.5 * abs(seen - expected) ** 2 / variance - float(np.log(variance))
