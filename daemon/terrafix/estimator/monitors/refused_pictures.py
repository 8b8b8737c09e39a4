"""Why pictures are not used for seconds: frozen ones, those of another flight, and those that show nothing.

Each frame has its verdict at once, and refused pictures move nothing; this names the cause of a run of them, as a fault
that begins with its first frame."""

from collections import Counter

from terrafix.messages import CalibrationFault, Verdict

FROZEN, OTHER, EMPTY = "picture frozen", "picture contradicts motion", "picture without texture"
INPUT_KINDS = {
    Verdict.STALLED: FROZEN,
    Verdict.IMPLAUSIBLE: OTHER,  # it agrees with itself, and not with this flight
    Verdict.UNCONFIRMED: OTHER,
    Verdict.FEW_INLIERS: EMPTY,
    Verdict.NO_FEATURES: EMPTY,
    Verdict.DEGENERATE: EMPTY,
}
DETAILS = {
    FROZEN: "the camera repeats a picture while the vehicle moves: check camera and stream",
    OTHER: "the pictures agree with each other, and not with the motion of this flight: check which stream it is",
    EMPTY: "too few matches from picture to picture, as over water, in cloud or in the dark",
}
# ns and frames without a used picture; used pictures in a row that end it. [spec: allowed to a wrong fix, score.py]
AFTER_NS = 3_000_000_000
REFUSED_FRAMES = 3  # [spec: positions in a row of the score]


class RefusedPictures:
    def __init__(self) -> None:
        self._refused: list[tuple[int, str]] = []  # time and kind of each since the last used one
        self._used = 0  # in a row
        self._active = ""

    def add(self, t_ns: int, verdict: Verdict) -> list[CalibrationFault]:
        """``verdict``: on the odometry of a frame. -> the fault that begins or ends with it; else nothing."""
        if verdict is Verdict.ACCEPTED:
            self._refused, self._used = [], self._used + 1
            if not self._active or self._used < REFUSED_FRAMES:
                return []
            ended, self._active = self._active, ""
            return [CalibrationFault(t_ns=t_ns, quantity=ended, factor=None, detail="pictures are used", active=False)]
        if verdict not in INPUT_KINDS:  # nothing is known of the picture
            return []
        self._used = 0
        self._refused.append((t_ns, INPUT_KINDS[verdict]))
        first_ns = self._refused[0][0]
        if self._active or len(self._refused) < REFUSED_FRAMES or t_ns - first_ns < AFTER_NS:
            return []
        self._active = Counter(kind for _, kind in self._refused).most_common(1)[0][0]
        detail = DETAILS[self._active]
        return [CalibrationFault(t_ns=first_ns, quantity=self._active, factor=None, detail=detail, active=True)]
