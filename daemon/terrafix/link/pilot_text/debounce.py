"""Debounce of a reported state: a change is reported at once, and with growing intervals while it oscillates."""

from typing import Generic, TypeVar

from terrafix.core.clock import NS_PER_S

State = TypeVar("State")
# Shortest and longest interval between two reports of one state, ns; doubled at each report of an oscillation. [tuned]
MIN_TEXT_INTERVAL_NS, MAX_TEXT_INTERVAL_NS = 5 * NS_PER_S, 60 * NS_PER_S
RESET_AFTER_NS = 120 * NS_PER_S  # ns without a report, after which the interval starts at the shortest again [tuned]


class Debounce(Generic[State]):
    """Debounce of one state. A report that is held back is sent later if the state still holds, so that the last report
    is always true. ``reported``: the state that was reported last, or None."""

    def __init__(self) -> None:
        self.reported: State | None = None
        self._reported_ns: int | None = None
        self._interval_ns = MIN_TEXT_INTERVAL_NS

    def due(self, state: State, now_ns: int, *, urgent: bool = False, clears: bool = False) -> bool:
        """Whether to report ``state`` now; if so, it counts as reported. ``urgent``: reports it without waiting, even
        when it was reported last. ``clears``: the state ends a warning; it waits for MIN_TEXT_INTERVAL_NS at most, so
        that a warning which no longer holds does not stand for a minute."""
        if state == self.reported and not urgent:
            return False
        since_ns = None if self._reported_ns is None else now_ns - self._reported_ns
        if since_ns is not None and since_ns < (MIN_TEXT_INTERVAL_NS if clears else self._interval_ns) and not urgent:
            return False
        stable = since_ns is None or since_ns >= RESET_AFTER_NS
        self._interval_ns = MIN_TEXT_INTERVAL_NS if stable else min(MAX_TEXT_INTERVAL_NS, 2 * self._interval_ns)
        self.reported, self._reported_ns = state, now_ns
        return True
