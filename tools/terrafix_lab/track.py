"""The track of a flight by any driver, claims beside the truth, and the criteria over it that acceptance, Monte Carlo
and the fault matrix share: each of CRITERIA is measured by all of them."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from terrafix.core.gate import CHI2_95
from terrafix_lab.faults.edits import Span
from terrafix_tools.score import FALSE_FIX_ERROR_M, FALSE_FIX_SIGMAS, is_false_fix, late_from_s

LATE_M = 20.0  # pictures with a delay of 1 s cause errors above this, and below 50 m
AGAIN_M, AGAIN_FRAMES = 20.0, 3  # right: within this, for so many positions in a row
AGAIN_RADIUS_M = 30.0  # ... and claimed: 95 % radius [spec: right and claimed again]


@dataclass(frozen=True)
class Track:
    """``t_s`` (N,), ``error_m`` (N,) horizontal, nan: no position; ``nees`` (N,); ``sigma_m`` (N,) claimed, of the
    worst axis. ``fault``: its span; None: no input is false. ``frames_s``: times of the frames, if not ``t_s``.

    Of a flight with a record: ``texts``: when the pilot got which; ``untrusted``: spans that the verdict of the
    report does not trust, with its reason; ``refused``: those in which it names inputs that were left out;
    ``cause``: regular expression for what both call the fault."""

    t_s: np.ndarray
    error_m: np.ndarray
    nees: np.ndarray
    sigma_m: np.ndarray
    fault: Span | None
    frames_s: Sequence[float] = ()
    texts: Sequence[tuple[float, str]] = ()
    untrusted: Sequence[Span] = ()
    refused: Sequence[Span] = ()
    cause: str = ""

    def is_false(self, beyond_m: float = FALSE_FIX_ERROR_M) -> np.ndarray:
        """(N,) bool"""
        return is_false_fix(self.error_m, self.nees, beyond_m)

    def is_late(self, beyond_m: float = FALSE_FIX_ERROR_M) -> np.ndarray:
        """(N,) bool: false but for the beginning of the fault, while nothing can show it yet; all without a fault."""
        if self.fault is None:
            return self.is_false(beyond_m)
        until_s = late_from_s(self.frames_s or self.t_s.tolist(), self.fault.from_s)
        return self.is_false(beyond_m) & ~((self.t_s >= self.fault.from_s) & (self.t_s <= until_s))

    def notice_s(self) -> float | None:
        """From the beginning of the fault to the last false position after it; None: there is none of either."""
        if self.fault is None:
            return None
        after_s = self.t_s[self.is_false() & (self.t_s >= self.fault.from_s)]
        return float(after_s[-1] - self.fault.from_s) if len(after_s) else None

    def again_s(self) -> float | None:
        """From the end of the fault until AGAIN_FRAMES positions in a row are right and claimed; inf: never; None:
        there is no fault, or too little after it."""
        after = self.t_s > (math.inf if self.fault is None else self.fault.to_s)
        if self.fault is None or after.sum() < AGAIN_FRAMES:
            return None
        claimed = math.sqrt(CHI2_95) * self.sigma_m <= AGAIN_RADIUS_M
        right = ((self.error_m <= AGAIN_M) & claimed & (self.nees <= FALSE_FIX_SIGMAS**2))[after]
        steady = np.convolve(right, np.ones(AGAIN_FRAMES), "valid") == AGAIN_FRAMES
        return float(self.t_s[after][np.argmax(steady)] - self.fault.to_s) if steady.any() else math.inf

    @property
    def is_right_again(self) -> bool:
        again_s = self.again_s()
        return again_s is not None and again_s < math.inf

    def reported_s(self) -> float | None:
        """From the beginning of the fault to the first text with its cause; inf: never; None: it has no cause."""
        return self._named_s([t_s for t_s, text in self.texts if re.search(self.cause, text)])

    def verdict_s(self) -> float | None:
        """From the beginning of the fault to where the verdict names its cause; inf: nowhere; None: it has none."""
        if self.fault is None:
            return None
        begin_s = self.fault.from_s
        spans = [s for s in [*self.untrusted, *self.refused] if re.search(self.cause, s.text) and s.to_s >= begin_s]
        return self._named_s([max(begin_s, span.from_s) for span in spans])

    def trusted_wrong(self) -> float | None:
        """Positions beyond LATE_M and 3 sigma that the verdict of the report trusts; None: there is no report."""
        if not self.texts and not self.untrusted:
            return None
        trusted = [not any(span.has(t_s) for span in self.untrusted) for t_s in self.t_s.tolist()]
        return float((self.is_false(LATE_M) & np.array(trusted, bool)).sum())

    def _named_s(self, times_s: Sequence[float]) -> float | None:
        if self.fault is None or not self.cause:
            return None
        return min((t_s - self.fault.from_s for t_s in times_s if t_s >= self.fault.from_s), default=math.inf)


@dataclass(frozen=True)
class TrackCriterion:
    """``of``: what is shown of several flights. ``live``: of flights with the real processes alone."""

    what: str
    unit: str
    measure: Callable[[Track], float | None]
    of: Callable[[Sequence[float]], float] = max
    live: bool = False


CRITERIA = {
    "late sure over 20 m": TrackCriterion(
        "positions beyond 20 m and 3 sigma, later than 3 s and 5 frames into the fault", "",
        lambda track: float(track.is_late(LATE_M).sum()), sum),
    "right again": TrackCriterion(
        "from the end of the fault until within 20 m and claimed to 30 m (95 %), three in a row", "s", Track.again_s),
    "reported": TrackCriterion(
        "from the beginning of the fault to the text to the pilot that names its cause", "s", Track.reported_s,
        live=True),
    "in the verdict": TrackCriterion(
        "from the beginning of the fault to the span that the verdict names by its cause", "s", Track.verdict_s,
        live=True),
    "trusted and wrong": TrackCriterion(
        "positions beyond 20 m and 3 sigma in a span that the verdict trusts", "", Track.trusted_wrong, sum, live=True),
}  # fmt: skip


def measured(tracks: Sequence[Track]) -> dict[str, str]:
    """Of one flight or of several together: name of CRITERIA -> value with its unit; "-": not measurable."""
    found = {}
    live = any(track.texts or track.untrusted for track in tracks)
    for name, row in CRITERIA.items():
        if row.live and not live:
            continue
        values = [value for track in tracks if (value := row.measure(track)) is not None]
        never = sum(map(math.isinf, values))
        shown = (
            f"{round(row.of([v for v in values if v < math.inf] or [0.0]), 2):g} {row.unit}".strip() if values else "-"
        )
        found[name] = f"never in {never} of {len(values)} flights" if never else shown
    return found
