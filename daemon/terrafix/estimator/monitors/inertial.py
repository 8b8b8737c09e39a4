"""Scale and mount faults from velocity changes: images against accelerometers, without a map.

A wrong reported height or focal length scales every visual velocity; a wrong mount yaw rotates it. Neither affects the
accelerometers, and a compass error rotates both alike. So dv_visual = gain * dv_inertial, with gain 1 where the
description is right. Height and focal length are not separable (a ray's tangent times a height); they are one
quantity, the scale."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from terrafix.estimator.monitors.cusum import Cusum, threshold

MIN_WINDOW_S = 4.0  # s between the velocities that are compared: a turn, a braking manoeuvre [tuned]
MAX_WINDOW_S = 15.0  # s [tuned]
# 1-sigma of an inertial velocity change per second of window and axis: a tilt error of 1 degree is 0.17 m/s^2. 1-sigma
# of a visual velocity: attitude noise of 0.3 degrees over half a second at 100 m. [tuned]
TILT_ACCEL_MPS2, VISUAL_VELOCITY_MPS = 0.17, 1.0
GAIN_SIGMA = 0.15  # share of the change: uneven ground, a focal length within its usual sigma [tuned]
FIT_MEMORY = 0.9  # exponential forgetting of the fit of a hypothesis, per window [tuned]
MIN_LOG_LIKELIHOOD = -20.0  # nats: no single window decides between the hypotheses [tuned]
MIN_CHANGE_MPS = 2.0  # m/s: smaller changes do not separate the hypotheses [tuned]


# Degrees clockwise beyond the configured mount; the visual velocity is computed with each.
MOUNT_YAWS_DEG = (0.0, 90.0, -90.0, 180.0)  # [spec: quarter turns of the camera]


@dataclass(frozen=True)
class Hypothesis:
    quantity: str
    factor: float  # reported over true height, or degrees by which the camera is turned clockwise
    gain: float  # visual over inertial velocity change
    mount: int  # index into MOUNT_YAWS_DEG


HYPOTHESES = (
    *(Hypothesis("scale", f, f, 0) for f in (0.5, 0.7, 1.43, 2.0, 1 / 3.28, 3.28)),
    *(Hypothesis("mount yaw", deg, 1.0, i) for i, deg in enumerate(MOUNT_YAWS_DEG) if i),
)


class InertialMonitor:
    """One CUSUM per hypothesis. Visual velocities are (4,) complex, east + i north, for each of MOUNT_YAWS_DEG."""

    def __init__(self) -> None:
        limit = threshold(3600.0 / MIN_WINDOW_S, len(HYPOTHESES))
        self._tests = [(h, Cusum(limit)) for h in HYPOTHESES]
        self._fits = [0.0] * len(HYPOTHESES)  # log-likelihoods of the last windows: select among active hypotheses
        self._velocities: deque[tuple[float, np.ndarray]] = deque()  # time [s], visual velocity

    @property
    def fault(self) -> Hypothesis | None:
        """The hypothesis with the best fit among those whose alarm is active, if any."""
        active = [(self._fits[i], i) for i, (_, test) in enumerate(self._tests) if test.active]
        return self._tests[max(active)[1]][0] if active else None

    def window_start_s(self, t_s: float) -> float | None:
        """Start of the window that ends at ``t_s``, for the inertial velocity change; None: no window ends yet."""
        while self._velocities and t_s - self._velocities[0][0] > MAX_WINDOW_S:
            self._velocities.popleft()
        if self._velocities and t_s - self._velocities[0][0] >= MIN_WINDOW_S:
            return self._velocities[0][0]
        return None

    def add(self, t_s: float, visual_mps: np.ndarray) -> None:
        """A visual velocity at ``t_s``."""
        if not self._velocities or t_s > self._velocities[-1][0]:
            self._velocities.append((t_s, visual_mps))

    def compare(self, t_s: float, visual_mps: np.ndarray, inertial_change_mps: complex) -> None:
        """Visual velocity at ``t_s``, and the inertial velocity change since ``window_start_s``. Windows do not
        overlap."""
        start_s, before_mps = self._velocities[0]
        self._velocities.clear()
        change_mps = visual_mps - before_mps
        if max(abs(inertial_change_mps), abs(change_mps[0])) < MIN_CHANGE_MPS:
            return
        h0 = _log_likelihood(change_mps[0], inertial_change_mps, t_s - start_s)
        for i, (hypothesis, test) in enumerate(self._tests):
            h1 = _log_likelihood(change_mps[hypothesis.mount], hypothesis.gain * inertial_change_mps, t_s - start_s)
            test.add(h1 - h0)
            self._fits[i] = FIT_MEMORY * self._fits[i] + max(h1, MIN_LOG_LIKELIHOOD)


def _log_likelihood(visual: complex, expected: complex, span_s: float) -> float:
    """Log likelihood of a visual velocity change [m/s] over ``span_s``, up to a constant."""
    variance = (TILT_ACCEL_MPS2 * span_s) ** 2 + 2.0 * VISUAL_VELOCITY_MPS**2 + (GAIN_SIGMA * abs(expected)) ** 2
    return -0.5 * abs(visual - expected) ** 2 / variance - float(np.log(variance))
