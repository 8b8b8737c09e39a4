"""Maps the autopilot's clock onto ours, from TIMESYNC round trips (law 4).

A round trip gives the offset to within half its excess duration. A line (offset and drift) is fitted to the fast round
trips of the last minute. An outlier is ignored; several in a row mean that the autopilot has rebooted. The method is
that of Klipper's clocksync.py (described in its documentation), implemented independently."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from terrafix.core.clock import MAX_CLOCK_DRIFT

WINDOW_SAMPLES = 60  # round trips in the fit: one a second for a minute [tuned]
# A round trip is fast below factor * minimum + margin: then it contains little one-sided delay. [tuned]
FAST_RTT_FACTOR, FAST_RTT_MARGIN_NS = 1.5, 1_000_000
MIN_FIT_SPAN_NS = 10_000_000_000  # over a shorter span drift cannot be distinguished from jitter [tuned]
MAX_RTT_NS = 500_000_000  # slower responses are ignored: their offset is too uncertain [tuned]
OUTLIER_NS = 20_000_000  # an offset off by more than this plus the round trip time is not jitter [tuned]
REBOOT_OUTLIERS = 3  # consecutive outliers after which the autopilot counts as rebooted [tuned]
MAX_PENDING = 20  # unanswered requests that are remembered [tuned]


@dataclass(frozen=True)
class RoundTrip:
    at_ns: int  # midpoint of the round trip, local clock
    rtt_ns: int
    offset_ns: int  # autopilot clock minus local clock


class TimeSync:
    """Estimates offset and drift of the autopilot's clock. ``resets``: number of reboots detected."""

    def __init__(self) -> None:
        self._pending: deque[int] = deque(maxlen=MAX_PENDING)
        self._trips: deque[RoundTrip] = deque(maxlen=WINDOW_SAMPLES)
        self._outliers = 0
        self._base_ns = 0
        self._offset_ns: float | None = None
        self._drift = 0.0
        self.resets = 0

    def request(self, now_ns: int) -> int:
        """Registers a request -> ts1 of the TIMESYNC message to send, with tc1 = 0."""
        self._pending.append(now_ns)
        return now_ns

    def on_response(self, tc1_ns: int, ts1_ns: int, now_ns: int) -> None:
        """Processes a TIMESYNC response. One that belongs to none of our pending requests is ignored."""
        if ts1_ns not in self._pending:
            return
        self._pending.remove(ts1_ns)
        rtt_ns = now_ns - ts1_ns
        if not 0 <= rtt_ns <= MAX_RTT_NS or tc1_ns <= 0:
            return
        midpoint_ns = ts1_ns + rtt_ns // 2
        trip = RoundTrip(midpoint_ns, rtt_ns, tc1_ns - midpoint_ns)
        expected = self.offset_at_ns(midpoint_ns)
        if expected is not None and abs(trip.offset_ns - expected) > OUTLIER_NS + rtt_ns:
            self._outliers += 1
            if self._outliers < REBOOT_OUTLIERS:
                return
            self._trips.clear()
            self.resets += 1
        self._outliers = 0
        self._trips.append(trip)
        self._fit()

    def offset_at_ns(self, local_ns: int) -> int | None:
        """-> autopilot clock minus local clock at local time ``local_ns``; None before the first response."""
        if self._offset_ns is None:
            return None
        return round(self._offset_ns + self._drift * (local_ns - self._base_ns))

    def to_local_ns(self, autopilot_ns: int) -> int | None:
        """Autopilot time since its boot -> local monotonic time; None before the first response."""
        if self._offset_ns is None:
            return None
        first_guess_ns = autopilot_ns - round(self._offset_ns)  # drift times offset error is far below a microsecond
        return autopilot_ns - (self.offset_at_ns(first_guess_ns) or 0)

    def _fit(self) -> None:
        max_rtt_ns = min(t.rtt_ns for t in self._trips) * FAST_RTT_FACTOR + FAST_RTT_MARGIN_NS
        fast = [t for t in self._trips if t.rtt_ns <= max_rtt_ns]
        self._base_ns = fast[-1].at_ns
        elapsed_ns = np.array([t.at_ns - self._base_ns for t in fast], dtype=np.float64)
        offsets = [t.offset_ns for t in fast]
        base_offset = offsets[-1]  # differences to it are small enough for float64
        y = np.array([o - base_offset for o in offsets], dtype=np.float64)
        self._drift = 0.0
        if elapsed_ns[-1] - elapsed_ns[0] >= MIN_FIT_SPAN_NS:
            self._drift = float(np.clip(np.polyfit(elapsed_ns, y, 1)[0], -MAX_CLOCK_DRIFT, MAX_CLOCK_DRIFT))
        self._offset_ns = base_offset + float(np.mean(y - self._drift * elapsed_ns))
