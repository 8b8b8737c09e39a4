"""The autopilot's clock on ours, from TIMESYNC round trips (law 4).

A round trip gives the offset to within half its excess duration. The quick ones of the last minute are fitted with a
line (offset and drift); one that disagrees is left out, and several in a row mean that the autopilot has rebooted.
The scheme is that of Klipper's clocksync.py (described in its documentation), written anew."""

from collections import deque
from dataclasses import dataclass

import numpy as np

MEMORY = 60  # round trips kept: one a second for a minute
QUICK_FACTOR, QUICK_MARGIN_NS = 1.5, 1_000_000  # round trips near the quickest carry little one-sided delay
MAX_DRIFT = 200e-6  # crystals are within 50 ppm; a fit beyond this is noise
MIN_FIT_SPAN_NS = 10_000_000_000  # below this span a drift cannot be told from jitter
MAX_RTT_NS = 500_000_000  # slower answers say nothing
OUTLIER_NS = 20_000_000  # disagreement beyond this plus the round trip itself is not jitter
REBOOT_AFTER = 3  # outliers in a row
PENDING = 20  # requests that may be unanswered at a time


@dataclass(frozen=True)
class RoundTrip:
    at_ns: int  # middle of the round trip, our clock
    rtt_ns: int
    offset_ns: int  # autopilot minus ours


class TimeSync:
    """``request`` before sending, ``answer`` on receiving; ``to_ours`` once ``offset_ns`` is not None."""

    def __init__(self) -> None:
        self._pending: deque[int] = deque(maxlen=PENDING)
        self._trips: deque[RoundTrip] = deque(maxlen=MEMORY)
        self._outliers = 0
        self._base_ns = 0
        self._offset_ns: float | None = None
        self._drift = 0.0
        self.resets = 0

    @property
    def synced(self) -> bool:
        return self._offset_ns is not None

    def request(self, now_ns: int) -> int:
        """-> ts1 to send with tc1 = 0."""
        self._pending.append(now_ns)
        return now_ns

    def answer(self, tc1_ns: int, ts1_ns: int, now_ns: int) -> None:
        """An answer to one of our requests; anybody else's (not in the pending list) is ignored."""
        if ts1_ns not in self._pending:
            return
        self._pending.remove(ts1_ns)
        rtt_ns = now_ns - ts1_ns
        if not 0 <= rtt_ns <= MAX_RTT_NS or tc1_ns <= 0:
            return
        middle_ns = ts1_ns + rtt_ns // 2
        trip = RoundTrip(middle_ns, rtt_ns, tc1_ns - middle_ns)
        expected = self.offset_at(middle_ns)
        if expected is not None and abs(trip.offset_ns - expected) > OUTLIER_NS + rtt_ns:
            self._outliers += 1
            if self._outliers < REBOOT_AFTER:
                return
            self._trips.clear()
            self.resets += 1
        self._outliers = 0
        self._trips.append(trip)
        self._fit()

    def offset_at(self, ours_ns: int) -> int | None:
        """Autopilot minus ours at our time ``ours_ns``; None before the first answer."""
        if self._offset_ns is None:
            return None
        return round(self._offset_ns + self._drift * (ours_ns - self._base_ns))

    def to_ours(self, autopilot_ns: int) -> int | None:
        """Autopilot time since its boot -> our monotonic time."""
        if self._offset_ns is None:
            return None
        first = autopilot_ns - round(self._offset_ns)  # drift times offset error is far below a microsecond
        return autopilot_ns - (self.offset_at(first) or 0)

    def _fit(self) -> None:
        limit = min(t.rtt_ns for t in self._trips) * QUICK_FACTOR + QUICK_MARGIN_NS
        quick = [t for t in self._trips if t.rtt_ns <= limit]
        self._base_ns = quick[-1].at_ns
        at = np.array([t.at_ns - self._base_ns for t in quick], dtype=np.float64)
        offsets = [t.offset_ns for t in quick]
        base_offset = offsets[-1]  # differences stay small enough for floats
        y = np.array([o - base_offset for o in offsets], dtype=np.float64)
        self._drift = 0.0
        if at[-1] - at[0] >= MIN_FIT_SPAN_NS:
            self._drift = float(np.clip(np.polyfit(at, y, 1)[0], -MAX_DRIFT, MAX_DRIFT))
        self._offset_ns = base_offset + float(np.mean(y - self._drift * at))
