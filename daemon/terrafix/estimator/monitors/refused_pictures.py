"""Why images, or reports of a gimbal, are not used for seconds.

Each frame has its verdict at once, and what is refused moves nothing; this names the cause of a run of them, as a fault
that begins with its first frame."""

from collections import Counter

from terrafix.estimator.measurements.telemetry_buffer import NOT_REPORTED, OF_SERVOS, REPEATED
from terrafix.messages import GIMBAL_FAULTS, CalibrationFault, Verdict

FROZEN, OTHER, EMPTY = "picture frozen", "picture contradicts motion", "picture without texture"
AWAY = "picture without ground"
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
}
# ns and frames without a used one; used ones in a row that end it. [spec: allowed to a wrong fix, score.py]
AFTER_NS = 3_000_000_000
REFUSED_FRAMES = 3  # [spec: positions in a row of the score]


class RefusedInput:
    """Images, or reports of the gimbal."""

    def __init__(self) -> None:
        self._refused: list[tuple[int, str]] = []  # time and kind of each since the last used one
        self._used = 0  # in a row
        self._active = ""

    def add(self, t_ns: int, kind: str | None) -> list[CalibrationFault]:
        """``kind``: of DETAILS, of each frame; "": used; None: nothing is known. -> the fault that begins or ends with
        it; else nothing."""
        if kind == "":
            self._refused, self._used = [], self._used + 1
            if not self._active or self._used < REFUSED_FRAMES:
                return []
            ended, self._active = self._active, ""
            detail = "reports are used" if ended in GIMBAL_FAULTS else "pictures are used"
            return [CalibrationFault(t_ns=t_ns, quantity=ended, factor=None, detail=detail, active=False)]
        if kind is None:
            return []
        self._used = 0
        self._refused.append((t_ns, kind))
        first_ns = self._refused[0][0]
        if self._active or len(self._refused) < REFUSED_FRAMES or t_ns - first_ns < AFTER_NS:
            return []
        self._active = most = Counter(kind for _, kind in self._refused).most_common(1)[0][0]
        return [CalibrationFault(t_ns=first_ns, quantity=most, factor=None, detail=DETAILS[most], active=True)]
