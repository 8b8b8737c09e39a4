"""The monotonic clock that all processes share (law 4), and deadlines on an absolute time grid."""

import time

NS_PER_S, NS_PER_MS = 1_000_000_000, 1_000_000
MAX_CLOCK_DRIFT = 200e-6  # s/s between two computers; crystals are within 50 ppm, a larger fitted drift is noise


def now_ns() -> int:
    """CLOCK_MONOTONIC in ns: identical in all processes of one computer since boot, cannot be set, never decreases."""
    return time.monotonic_ns()


class Ticker:
    """Deadlines on an absolute time grid: delays do not accumulate, and missed deadlines are skipped."""

    def __init__(self, rate_hz: float, start_ns: int) -> None:
        self.period_ns = round(1e9 / rate_hz)
        self.next_ns = start_ns

    def due(self, now_ns: int) -> bool:
        """True once per deadline; the next deadline is then the first grid point after ``now_ns``."""
        if now_ns < self.next_ns:
            return False
        self.next_ns += ((now_ns - self.next_ns) // self.period_ns + 1) * self.period_ns
        return True
