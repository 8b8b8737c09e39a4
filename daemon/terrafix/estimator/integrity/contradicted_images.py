"""Images that have contradicted inertial readings, and what ends that."""

import math
from dataclasses import dataclass, replace

import numpy as np

from terrafix.core.gate import CHI2_95
from terrafix.estimator.integrity.fragments import CONFIRM_AFTER_S, CONFIRM_FRAMES, CONFIRM_LLR, STEP_SHARE, Fragment
from terrafix.estimator.models.motion_model import MotionIncrement, predict_covariance
from terrafix.estimator.state import ACCELERATIONS, DELTA_MOTION, DELTA_V, HORIZONTAL

# Share of a way by which images that are squeezed, or of another focal length, tell it wrong.
WRONG_SHARE = 0.25  # [spec: 16:9 in 4:3]
# Cosine between two velocities, in axes of the camera, that a squeezed image changes alike. [spec: 30 degrees]
SAME_DIRECTION = math.cos(math.radians(30.0))
# Share of the speed from which images tell as well how wrong they are. [tuned]
SAME_SPEED = 0.7


@dataclass(frozen=True)
class MatchedFrame:
    """A frame of ``fragment`` at ``t_s``, ``displacement_m`` (2,) by odometry from the first frame of the fragment.
    ``position_m`` (2,), with covariance ``cov_m2`` (2, 2): of its map match, east and north."""

    t_s: float
    fragment: Fragment
    displacement_m: np.ndarray
    position_m: np.ndarray
    cov_m2: np.ndarray


@dataclass(frozen=True)
class WrongVelocity:
    """Velocity that images show less that of inertial readings, ``off_mps`` (2,) with covariance ``cov_m2ps2`` (2, 2),
    at ``inertial_mps`` (2,). All in axes of the heading of the camera: what is wrong with lens, scale or orientation
    turns with it."""

    off_mps: np.ndarray
    cov_m2ps2: np.ndarray
    inertial_mps: np.ndarray

    def at(self, inertial_mps: np.ndarray) -> "WrongVelocity | None":
        """Expected at another velocity (2,); None: in another direction a squeezed image may be right."""
        was, now = float(np.hypot(*self.inertial_mps)), float(np.hypot(*inertial_mps))
        if was == 0.0 or self.inertial_mps @ inertial_mps < SAME_DIRECTION * was * now:
            return None
        scale = now / was
        return WrongVelocity(scale * self.off_mps, scale**2 * self.cov_m2ps2, inertial_mps)


@dataclass
class ContradictedImages:
    """Images have contradicted inertial readings (``active``): one of the two is wrong. A map match of such an image
    gives a position, and says nothing of the motion that images show: a squeezed image is matched, and its odometry is
    wrong by a quarter. So two map matches decide, by the way between them; or the images themselves, where these change
    and then show the velocity that inertial readings have had since before: if those were wrong, that is chance.

    ``inertial_cov`` (8, 8): of V by inertial readings since before the contradiction; None: V is not theirs alone."""

    active: bool = False
    inertial_cov: np.ndarray | None = None
    _wrong: WrongVelocity | None = None
    _first: MatchedFrame | None = None

    def begin(self, inertial_cov: np.ndarray | None = None) -> None:
        self.active, self._first, self._wrong = True, None, None
        self.inertial_cov = inertial_cov

    def end(self) -> None:
        self.active, self._first, self.inertial_cov = False, None, None

    def propagate(self, increment: MotionIncrement | None) -> None:
        """The motion to the next node, without odometry."""
        if self.inertial_cov is None or increment is None or not increment.inertial:
            self.inertial_cov = None
            return
        if self._wrong is not None:  # meanwhile inertial readings drift
            by_accel = increment.phi_va @ self.inertial_cov[ACCELERATIONS, ACCELERATIONS] @ increment.phi_va.T
            drift_m2ps2 = 0.5 * float(np.trace((by_accel + increment.cov[DELTA_V, DELTA_V])[HORIZONTAL, HORIZONTAL]))
            self._wrong = replace(self._wrong, cov_m2ps2=self._wrong.cov_m2ps2 + drift_m2ps2 * np.eye(2))
        self.inertial_cov = predict_covariance(increment, self.inertial_cov)[DELTA_MOTION, DELTA_MOTION]

    def right_llr(self, seen: WrongVelocity, inertial_m2ps2: np.ndarray) -> float:
        """Log likelihood ratio [nats] of images that are right now against images that are as wrong as before, by what
        they show. ``inertial_m2ps2`` (2, 2): covariance of the velocity of inertial readings, in the axes of ``seen``,
        whose covariance is without it. Minus infinity: nothing says how wrong images would be."""
        if self._wrong is None:
            self._wrong = seen
            return -math.inf
        expected = self._wrong.at(seen.inertial_mps)
        if expected is None:
            return -math.inf
        changed_mps, changed_cov = seen.off_mps - expected.off_mps, expected.cov_m2ps2 + seen.cov_m2ps2
        llr = _log_density(seen.off_mps, inertial_m2ps2 + seen.cov_m2ps2) - _log_density(changed_mps, changed_cov)
        if llr < 0.0 and np.hypot(*seen.inertial_mps) >= SAME_SPEED * np.hypot(*self._wrong.inertial_mps):
            gain = np.linalg.solve(changed_cov, expected.cov_m2ps2).T
            off_mps, cov_m2ps2 = expected.off_mps + gain @ changed_mps, expected.cov_m2ps2 - gain @ expected.cov_m2ps2
            self._wrong = WrongVelocity(off_mps, cov_m2ps2, seen.inertial_mps)
        return llr

    def on_map_match(self, frame: MatchedFrame) -> None:
        """The images are right, and their fragment is joined, where odometry agrees with a way that is long enough to
        tell, or for CONFIRM_AFTER_S: over one place nothing can tell."""
        first, self.inertial_cov = self._first, None
        if first is None or first.fragment is not frame.fragment:
            self._first = frame
            return
        way_m = frame.position_m - first.position_m
        length_m = float(np.hypot(*way_m))
        off_m = frame.displacement_m - first.displacement_m - way_m
        cov_m2 = first.cov_m2 + frame.cov_m2 + (STEP_SHARE * length_m) ** 2 * np.eye(2)
        wrong_m, away_m = WRONG_SHARE * length_m, float(np.hypot(*off_m))
        # Of right images against those that are wrong by so much, in the direction in which they are off.
        llr = 0.5 * wrong_m * (wrong_m - 2.0 * away_m) / float(np.linalg.eigvalsh(cov_m2)[-1])
        if off_m @ np.linalg.solve(cov_m2, off_m) > CHI2_95:
            self._first = frame
        elif llr >= CONFIRM_FRAMES * CONFIRM_LLR or frame.t_s - first.t_s >= CONFIRM_AFTER_S:
            frame.fragment.join()
            self.end()


def _log_density(x: np.ndarray, cov: np.ndarray) -> float:
    """Of a normal distribution without mean, but for a constant."""
    return -0.5 * float(x @ np.linalg.solve(cov, x) + np.linalg.slogdet(cov)[1])
