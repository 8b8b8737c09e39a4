"""Why images, or reports of a gimbal, are not used for seconds.

Each frame has its verdict at once, and what is refused moves nothing; this names the cause of a run of them, as a fault
that begins with its first frame. Images of another flight with the speed and course of this one are used: only the map
contradicts them, as it does not show other ground either."""

import math
from collections import Counter

import numpy as np

from terrafix.estimator.integrity.fragments import HIT_RATE_MEMORY, MAX_HIT_RATE
from terrafix.estimator.measurements.telemetry_buffer import NOT_REPORTED, OF_SERVOS, REPEATED
from terrafix.estimator.monitors.registration import REGISTRATION_SPACING_HEIGHTS
from terrafix.messages import GIMBAL_FAULTS, CalibrationFault, Verdict

FROZEN, OTHER, EMPTY = "picture frozen", "picture contradicts motion", "picture without texture"
AWAY, UNSEEN = "picture without ground", "picture not on the map"
# Of a frame, by its odometry; "": used. Of others nothing is known.
INPUT_KINDS = {
    Verdict.ACCEPTED: "",
    Verdict.STALLED: FROZEN,
    Verdict.IMPLAUSIBLE: OTHER,  # it agrees with itself, and not with this flight
    Verdict.UNCONFIRMED: OTHER,
    Verdict.FEW_INLIERS: EMPTY,
    Verdict.NO_FEATURES: EMPTY,
    Verdict.NO_GROUND: AWAY,
}
DETAILS = {
    FROZEN: "the camera repeats a picture while the vehicle moves: check camera and stream",
    OTHER: "the pictures agree with each other, and not with the motion of this flight: check which stream it is",
    EMPTY: "too few matches from picture to picture, as over water, in cloud or in the dark",
    AWAY: "the gimbal looks at the horizon or above it: turn it down",
    NOT_REPORTED: "no attitude of the gimbal for a second: check its connection and its messages",
    REPEATED: "one attitude to the last bit while the vehicle leans: it is an old one, or what the gimbal was sent",
    OF_SERVOS: "the attitude changes as the opposite of the vehicle's: angles of servos, not those of the camera",
    UNSEEN: "since odometry was interrupted the map shows none of the ground, before it did: check which stream it is",
}
# ns and frames without a used one; used ones in a row that end it. [spec: allowed to a wrong fix, score.py]
AFTER_NS = 3_000_000_000
REFUSED_FRAMES = 3  # [spec: positions in a row of the score]
UNSEEN_NATS = 6.9  # [spec: one interruption in a thousand whose ground the map shows as often as that before it]


class RefusedInput:
    """Images, or reports of the gimbal."""

    def __init__(self) -> None:
        self._refused: list[tuple[int, str]] = []  # time and kind of each since the last used one
        self._used = 0  # in a row
        self._active = ""

    def add(self, t_ns: int, kind: str | None, known: tuple[str, int] | None = None) -> list[CalibrationFault]:
        """``kind``: of DETAILS, of each frame; "": used; None: nothing is known. ``known``: kind and begin of what a
        test over frames has found. -> the fault that begins or ends with it; else nothing."""
        if known is not None and not self._active:
            return self._begin(*known)
        if kind == "" and known is None:
            self._refused, self._used = [], self._used + 1
            if not self._active or self._used < REFUSED_FRAMES:
                return []
            ended, self._active = self._active, ""
            detail = "reports are used" if ended in GIMBAL_FAULTS else "pictures are used"
            return [CalibrationFault(t_ns=t_ns, quantity=ended, factor=None, detail=detail, active=False)]
        if not kind:
            return []
        self._used = 0
        self._refused.append((t_ns, kind))
        first_ns = self._refused[0][0]
        if self._active or len(self._refused) < REFUSED_FRAMES or t_ns - first_ns < AFTER_NS:
            return []
        return self._begin(Counter(kind for _, kind in self._refused).most_common(1)[0][0], first_ns)

    def _begin(self, kind: str, t_ns: int) -> list[CalibrationFault]:
        self._active, self._used = kind, 0
        return [CalibrationFault(t_ns=t_ns, quantity=kind, factor=None, detail=DETAILS[kind], active=True)]


class UnseenGround:
    """``since_ns``: time since which the map shows none of the frames, of an odometry that was interrupted before, and
    has shown most of those before that; None: it does, or nothing was interrupted."""

    def __init__(self) -> None:
        self.since_ns: int | None = None
        self._shown_share, self._shown_in = 0.0, -1  # of the correlations; newest fragment of vision with one
        self._nats, self._first_ns, self._at = 0.0, 0, np.full(2, np.inf)

    def add(self, t_ns: int, fragment_id: int, at: np.ndarray, *, shown: bool) -> None:
        """A correlation of a frame at ``at`` (2,) [heights]."""
        if shown or fragment_id == self._shown_in or self._shown_in < 0:
            self._shown_share += (float(shown) - self._shown_share) / HIT_RATE_MEMORY
            self._shown_in = fragment_id if shown else self._shown_in
            self.since_ns, self._nats, self._at = None, 0.0, np.full(2, np.inf)
        elif float(np.hypot(*(at - self._at))) >= REGISTRATION_SPACING_HEIGHTS:
            self._first_ns = t_ns if self._nats == 0.0 else self._first_ns
            self._nats, self._at = self._nats - math.log(1.0 - min(self._shown_share, MAX_HIT_RATE)), at
            self.since_ns = self._first_ns if self._nats >= UNSEEN_NATS else None
