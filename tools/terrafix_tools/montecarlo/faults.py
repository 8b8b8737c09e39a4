"""Faults of a flight: when nothing is seen, and map matches that are sure of a wrong place."""

import math

import msgspec
import numpy as np

from terrafix.core.geodesy import quat_from_rot
from terrafix.messages import MapMatch, Verdict
from terrafix_tools.montecarlo.fault import Fault
from terrafix_tools.montecarlo.flown import Shot

WRONG_SHARE, WRONG_M = 0.10, (30.0, 400.0)
JUMP_M, JUMPS = 350.0, 6
BLACKOUT_S, BLACKOUTS_AT = 60.0, (0.25, 0.65)  # of the flight
ROWS_S, ROWS_AT, ROWS_M = 30.0, 0.35, (20.0, 90.0)  # houses alike, rows of fields
QUIET_S = 20.0  # at the start: a map match that is wrong from the first on is another question
LATEST_FRAMES = 2
LEARNT_S = 90.0  # how long there is a map in a flight that then has none
SURE_M, SURE_RAD = 2.5, math.radians(1.0)  # what a wrong match claims, 1-sigma


class Faults:
    """Of one flight. ``alter`` once for every frame, in order."""

    def __init__(self, fault: Fault, duration_s: float, seed: int) -> None:
        self._fault, self._duration_s = fault, duration_s
        self._rng = np.random.default_rng([seed, 57])
        self._late = np.random.default_rng([seed, 58])
        self._jumps_s = np.sort(self._rng.uniform(QUIET_S, duration_s, JUMPS)).tolist()
        towards = float(self._rng.uniform(0.0, 2.0 * math.pi))
        away_m = float(self._rng.uniform(*ROWS_M))
        self._row_m = away_m * np.array([math.sin(towards), math.cos(towards)])

    def blind(self, t_s: float) -> bool:
        """Nothing is seen: fog, a lens cap, a camera that is off."""
        since = [t_s - at * self._duration_s for at in BLACKOUTS_AT]
        return self._fault is Fault.BLACKOUT and any(0.0 <= s < BLACKOUT_S for s in since)

    def unmapped(self, t_s: float) -> bool:
        return self._fault is Fault.DRIFT and t_s >= LEARNT_S

    def late_frames(self) -> int:
        """How many frames later the match of this one is heard."""
        return int(self._late.integers(LATEST_FRAMES + 1)) if self._fault is Fault.LATE else 0

    def alter(self, match: MapMatch, shot: Shot) -> MapMatch:
        """What the estimator hears instead of ``match``."""
        if self.blind(shot.t_s) or self.unmapped(shot.t_s):
            return nothing_found(match)
        moved_m = self._moved(shot.t_s)
        return match if moved_m is None else sure_of(match, shot, moved_m, self._rng)

    def _moved(self, t_s: float) -> np.ndarray | None:
        """(2,) how far the match of this frame is off; None: it is as it is."""
        wrong, away = self._rng.uniform() < WRONG_SHARE, float(self._rng.uniform(*WRONG_M))
        towards = float(self._rng.uniform(0.0, 2.0 * math.pi))
        way = np.array([math.sin(towards), math.cos(towards)])
        if self._fault is Fault.WRONG and wrong and t_s >= QUIET_S:
            return away * way
        if self._fault is Fault.JUMPS and self._jumps_s and t_s >= self._jumps_s[0]:
            self._jumps_s.pop(0)
            return JUMP_M * way
        if self._fault is Fault.ROWS and 0.0 <= t_s - ROWS_AT * self._duration_s < ROWS_S:
            return self._row_m
        return None


def nothing_found(match: MapMatch) -> MapMatch:
    """Of a frame that the map does not know."""
    return msgspec.structs.replace(
        match, verdict=Verdict.FEW_INLIERS, coarse=False, p_c_in_w_m=None, q_w_c=None, cov=None, inliers=0
    )


def sure_of(match: MapMatch, shot: Shot, moved_m: np.ndarray, rng: np.random.Generator) -> MapMatch:
    """A match that is sure of a place ``moved_m`` (2,) from the true one."""
    p = shot.p_m + np.array([*(moved_m + SURE_M * rng.normal(size=2)), SURE_M * rng.normal()])
    cov = np.diag([SURE_M**2] * 3 + [SURE_RAD**2] * 3)
    return msgspec.structs.replace(
        match,
        verdict=Verdict.ACCEPTED,
        coarse=False,
        p_c_in_w_m=(float(p[0]), float(p[1]), float(p[2])),
        q_w_c=quat_from_rot(shot.r_w_c),
        cov=tuple(float(v) for v in cov.ravel()),
        inliers=30,
        margin=7.0,
        mode_mass=0.99,
        mode_e_m=float(p[0]),
        mode_n_m=float(p[1]),
    )
