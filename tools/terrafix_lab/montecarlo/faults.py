"""Faults of a flight: frames without features, and overconfident map matches at a wrong place."""

import math

import msgspec
import numpy as np

from terrafix.core.geodesy import quat_from_rot
from terrafix.core.pnp import solved
from terrafix.messages import MapMatch, Verdict
from terrafix_lab.montecarlo.fault import DrawnFault
from terrafix_lab.montecarlo.flown import Shot
from terrafix_lab.sim.true_messages import placed

WRONG_SHARE, WRONG_M = 0.10, (30.0, 400.0)  # share of the matches, offset from the true position
JUMP_M, JUMPS = 350.0, 6
BLACKOUT_S, BLACKOUTS_AT = 60.0, (0.25, 0.65)  # duration; starts as shares of the flight
ROWS_S, ROWS_AT, ROWS_M = (
    30.0,
    0.35,
    (20.0, 90.0),
)  # duration, start (share of the flight), offset: similar houses, rows of fields
QUIET_S = 20.0  # without faults at the start: a wrong first map match is tested elsewhere
MAX_LATE_FRAMES = 2
MAPPED_S = 90.0  # with map matches, before they end
WRONG_SIGMA_M, WRONG_SIGMA_RAD = 2.5, math.radians(1.0)  # stated 1-sigma of a wrong match


class Faults:
    """Of one flight. Call ``alter`` once for every frame, in order."""

    def __init__(self, fault: str, duration_s: float, seed: int) -> None:
        self._fault, self._duration_s = fault, duration_s
        self._rng = np.random.default_rng([seed, 57])
        self._late = np.random.default_rng([seed, 58])
        self._jumps_s = np.sort(self._rng.uniform(QUIET_S, duration_s, JUMPS)).tolist()
        towards = float(self._rng.uniform(0.0, 2.0 * math.pi))
        offset_m = float(self._rng.uniform(*ROWS_M))
        self._row_m = offset_m * np.array([math.sin(towards), math.cos(towards)])

    def is_blacked_out(self, t_s: float) -> bool:
        """No features: fog, a lens cap, a camera that is off."""
        since = [t_s - at * self._duration_s for at in BLACKOUTS_AT]
        return self._fault is DrawnFault.BLACKOUT and any(0.0 <= s < BLACKOUT_S for s in since)

    def is_unmapped(self, t_s: float) -> bool:
        return self._fault is DrawnFault.DRIFT and t_s >= MAPPED_S

    def late_frames(self) -> int:
        """Delay of the match of this frame, in frames."""
        return int(self._late.integers(MAX_LATE_FRAMES + 1)) if self._fault is DrawnFault.LATE else 0

    def alter(self, match: MapMatch, shot: Shot) -> MapMatch:
        """The match that is published instead of ``match``."""
        offset_m = self._offset_m(shot.t_s)
        return match if offset_m is None else wrong_match(match, shot, offset_m, self._rng)

    def _offset_m(self, t_s: float) -> np.ndarray | None:
        """(2,) offset of the match of this frame; None: no fault. Draws the same random numbers for all faults."""
        wrong, distance_m = self._rng.uniform() < WRONG_SHARE, float(self._rng.uniform(*WRONG_M))
        towards = float(self._rng.uniform(0.0, 2.0 * math.pi))
        direction = np.array([math.sin(towards), math.cos(towards)])
        if self._fault is DrawnFault.WRONG and wrong and t_s >= QUIET_S:
            return distance_m * direction
        if self._fault is DrawnFault.JUMPS and self._jumps_s and t_s >= self._jumps_s[0]:
            self._jumps_s.pop(0)
            return JUMP_M * direction
        if self._fault is DrawnFault.ROWS and 0.0 <= t_s - ROWS_AT * self._duration_s < ROWS_S:
            return self._row_m
        return None


def no_match(match: MapMatch) -> MapMatch:
    """``match`` without a pose and without a belief: the frame was not compared with the map."""
    return msgspec.structs.replace(
        match, verdict=Verdict.FEW_INLIERS, matches=[], pnp=None, pose=None, place=None, belief=None, inliers=0
    )


def wrong_match(match: MapMatch, shot: Shot, offset_m: np.ndarray, rng: np.random.Generator) -> MapMatch:
    """An accepted match with a small covariance, ``offset_m`` (2,) from the true position. The frame fits there as it
    fits elsewhere."""
    p = shot.p_m + np.array([*(offset_m + WRONG_SIGMA_M * rng.normal(size=2)), WRONG_SIGMA_M * rng.normal()])
    sigmas = np.array([WRONG_SIGMA_M] * 3 + [WRONG_SIGMA_RAD] * 3)
    nats = None if match.alternative_nats is None else 0.0
    found = solved(msgspec.structs.replace(match, verdict=Verdict.ACCEPTED, belief=None, alternative_nats=nats))
    return placed(found, p, quat_from_rot(shot.r_w_c), sigmas, inliers=30)
