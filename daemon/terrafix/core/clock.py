"""The one monotonic clock (law 4) and deadlines on an absolute grid."""

import time


def now_ns() -> int:
    """CLOCK_MONOTONIC: the same for all processes of one computer since it started; never set, never steps back."""
    return time.monotonic_ns()


class Ticker:
    """Deadlines on an absolute grid: lateness does not add up, and missed ticks are skipped, not made up for."""

    def __init__(self, rate_hz: float, start_ns: int) -> None:
        self.period_ns = round(1e9 / rate_hz)
        self.next_ns = start_ns

    def due(self, now_ns: int) -> bool:
        """True once per deadline; moves on to the first grid point after ``now_ns``."""
        if now_ns < self.next_ns:
            return False
        self.next_ns += ((now_ns - self.next_ns) // self.period_ns + 1) * self.period_ns
        return True
