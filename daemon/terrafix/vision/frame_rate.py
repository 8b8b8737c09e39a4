"""Which frames are taken from a source in real time: fewer in a hot computer, and on one that cannot finish all of them
only as many as it finishes, evenly."""

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

from terrafix.core.clock import NS_PER_S
from terrafix.core.config import HealthSection
from terrafix.messages import OVERTAKEN, TOO_SLOW, CalibrationFault, Frame, FrameRate, Message, NavEstimate, ThermalBand

FRAMES = 10  # newest frames that are counted [spec: 5 s at the default frame rate of 2 Hz]
# Late ones of these on a computer that is too slow: one that keeps the promise (5 %) has four once in a thousand.
TOO_SLOW_FRAMES = 4  # [spec: AC-7 and the binomial distribution]
MAX_COMPUTING_NS = 400_000_000  # from image to position [spec: AC-7, the floor]
MIN_TAKEN_HZ = 1.0  # with its delay an image is predicted to the present [spec: MAX_PREDICTION_AGE_NS of the link]
SLOWER = 1.5  # ratio of one interval of the frames that are taken to the next longer one [tuned]
# Hysteresis: frames come at the next higher rate when none was lost for WAIT_NS; where that rate has failed before, for
# twice the time, up to MAX_WAIT_NS. [tuned]
WAIT_NS, MAX_WAIT_NS = 5 * NS_PER_S, 80 * NS_PER_S
STAGES = 2  # vision and estimator: each has one interval for a frame [spec: the process table]


@dataclass
class _Taken:
    t_ns: int
    late: bool  # its position came late, or not at all: a newer frame was there first, or has its position
    lost: bool  # not at all, when there were positions of frames before
    took_ns: int | None = None  # from its message to its position; None: none yet


class FrameRateLimit:
    """Selects the frames that are taken from a source (``takes_frame``), by what became of those before: ``published``
    with each of them, and ``on_estimate`` with each estimate. ``band``: of the newest Health."""

    def __init__(self, health: HealthSection) -> None:
        self._period_ns = {
            ThermalBand.NORMAL: 0,
            ThermalBand.HOT: round(NS_PER_S / health.hot_rate_hz),
            ThermalBand.CRITICAL: round(NS_PER_S / health.critical_rate_hz),
        }
        self._due_ns = 0
        self.band = ThermalBand.NORMAL
        self._offered_ns: deque[int] = deque(maxlen=FRAMES)  # times of the newest frames of the source
        self._begun = False  # there was a position
        self._every, self._skipped = 1, 0  # of so many frames one is taken; frames since the last one
        self._newest: dict[int, _Taken] = {}  # by frame id, of FRAMES
        self._transport_ns = MAX_COMPUTING_NS  # least time from the stamp of a frame to its message: the camera's
        self._slow_since_ns: int | None = None  # first late frame; None: the computer keeps up
        self._stepped_ns, self._raised_ns = 0, -MAX_WAIT_NS  # of the newest change, and of the newest higher rate
        self._wait_ns = WAIT_NS
        self._state, self._state_ns = (False, 0), 0  # of the newest FrameRate

    def takes_frame(self, t_ns: int) -> bool:
        """Whether the frame at ``t_ns`` is taken. Call it once for every frame, in order of time."""
        self._offered_ns.append(t_ns)
        period_ns = self._period_ns[self.band]
        if t_ns < self._due_ns and period_ns:
            return False
        # On a grid, so that the mean rate holds for a camera whose rate is no multiple of it; a gap begins a new grid.
        on_grid = t_ns - self._due_ns < period_ns
        self._due_ns = (self._due_ns if on_grid else t_ns) + period_ns
        self._skipped = (self._skipped + 1) % self._every
        return self._skipped == 0

    def published(self, frames: Iterable[Frame], now_ns: int) -> list[Message]:
        """``frames``: that were taken, with pixels or left out. -> the FrameRate that is due: at each change, and once
        a second; with a change the fault by its cause, from the first frame that came late."""
        for frame in frames:
            self._transport_ns = min(self._transport_ns, now_ns - frame.t_ns)
            if frame.t_ns + self._transport_ns < self._stepped_ns:  # taken at the rate before
                continue
            left_out = frame.error == OVERTAKEN
            self._newest[frame.frame_id] = _Taken(frame.t_ns, left_out, left_out and self._begun)
            if len(self._newest) > FRAMES:
                del self._newest[next(iter(self._newest))]
            self._adapt(now_ns)
        slow, offered_hz = self._slow_since_ns is not None, self._offered_hz
        before, known = self._state, (slow, self._every)
        if not offered_hz or (before == known and now_ns - self._state_ns < NS_PER_S):
            return []
        self._state, self._state_ns = known, now_ns
        taken_hz = min(offered_hz, NS_PER_S / (self._period_ns[self.band] or 1)) / self._every
        taken_hz *= 1.0 - sum(taken.lost for taken in self._newest.values()) / max(len(self._newest), 1)
        offered, taken = round(offered_hz, 2), round(taken_hz, 2)
        rate = FrameRate(t_ns=now_ns, offered_hz=offered, taken_hz=taken, every=self._every, computer_too_slow=slow)
        if slow == before[0] and not (slow and self._every > before[1]):
            return [rate]
        t_ns = now_ns if before[0] or self._slow_since_ns is None else self._slow_since_ns
        late = sum(taken.late for taken in self._newest.values())
        rates = f"running at {taken_hz:.2g} of {offered_hz:.2g} Hz"
        detail = f"{late} of {FRAMES} frames late" if round(taken_hz, 1) >= round(offered_hz, 1) else rates
        return [rate, CalibrationFault(t_ns=t_ns, quantity=TOO_SLOW, factor=None, detail=detail, active=slow)]

    def on_estimate(self, estimate: NavEstimate) -> None:
        """Late is a position that comes after the next frame, and later than what is promised."""
        placed, begun, self._begun = self._newest.get(estimate.frame_id), self._begun, True
        if placed is None or placed.took_ns is not None:
            return
        placed.took_ns = estimate.emitted_at_ns - placed.t_ns - self._transport_ns
        placed.late = placed.late or placed.took_ns > max(MAX_COMPUTING_NS, self._interval_ns)
        for taken in self._newest.values():
            if taken.took_ns is None and taken.t_ns < placed.t_ns:
                taken.late, taken.lost = True, taken.lost or begun
        self._adapt(estimate.emitted_at_ns)

    @property
    def _offered_hz(self) -> float:
        """Rate of the source; 0: not known yet."""
        span_ns = self._offered_ns[-1] - self._offered_ns[0] if self._offered_ns else 0
        return (len(self._offered_ns) - 1) * NS_PER_S / span_ns if span_ns > 0 else 0.0

    @property
    def _interval_ns(self) -> int:
        """Mean time between the frames that were taken."""
        times_ns = [taken.t_ns for taken in self._newest.values()]
        return (times_ns[-1] - times_ns[0]) // max(len(times_ns) - 1, 1)

    def _adapt(self, now_ns: int) -> None:
        lost = sum(taken.lost for taken in self._newest.values())
        late_ns = [taken.t_ns for taken in self._newest.values() if taken.late]
        if len(late_ns) >= TOO_SLOW_FRAMES:
            self._slow_since_ns = self._slow_since_ns or late_ns[0]
        elif self._every == 1 and len(self._newest) == FRAMES:  # not with the first frames of a rate that is tried
            self._slow_since_ns = None
        slower = min(math.ceil(SLOWER * self._every), max(1, math.floor(self._offered_hz / MIN_TAKEN_HZ)))
        faster = int(self._every / SLOWER)
        if slower > self._every and lost >= FRAMES * (1.0 - self._every / slower):  # no more are finished than at it
            failed = now_ns - self._raised_ns < 2 * self._wait_ns
            self._wait_ns = min(2 * self._wait_ns, MAX_WAIT_NS) if failed else WAIT_NS
            every = slower
        elif self._every > 1 and not lost and now_ns - self._stepped_ns > self._wait_ns and self._has_room(faster):
            self._raised_ns, every = now_ns, faster
        else:
            return
        self._every, self._skipped, self._stepped_ns = every, 0, now_ns
        self._newest.clear()  # what was late at the other rate says nothing of this one

    def _has_room(self, every: int) -> bool:
        """Whether each of two stages could finish a frame in its interval at a higher rate."""
        took_ns = sorted(taken.took_ns for taken in self._newest.values() if taken.took_ns is not None)
        limit_ns = max(MAX_COMPUTING_NS, STAGES * self._interval_ns * every // self._every)
        return len(took_ns) >= FRAMES - 1 and took_ns[-2] < limit_ns
