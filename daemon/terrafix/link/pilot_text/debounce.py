"""When a change is worth a word to the pilot: at once, unless it has been going back and forth."""

from typing import Generic, TypeVar

State = TypeVar("State")
NS_PER_S = 1_000_000_000
FIRST_NS, LONGEST_NS = 5 * NS_PER_S, 60 * NS_PER_S  # between two words about one thing; doubled while it flutters
CALM_NS = 120 * NS_PER_S  # after this long without a word the next one is a first one again


class Debounce(Generic[State]):
    """One thing that has a state. What is put off is said later, if it is still so: the last word is always true."""

    def __init__(self) -> None:
        self.told: State | None = None
        self._told_ns: int | None = None
        self._wait_ns = FIRST_NS

    def due(self, state: State, now_ns: int, *, urgent: bool = False, clears: bool = False) -> bool:
        """Whether to say ``state`` now; then it counts as said. ``urgent``: it is new, whatever was said last.
        ``clears``: it takes a bad word back, which nobody should go on believing for a minute."""
        if state == self.told and not urgent:
            return False
        since_ns = None if self._told_ns is None else now_ns - self._told_ns
        if since_ns is not None and since_ns < (FIRST_NS if clears else self._wait_ns) and not urgent:
            return False
        calm = since_ns is None or since_ns >= CALM_NS
        self._wait_ns = FIRST_NS if calm else min(LONGEST_NS, 2 * self._wait_ns)
        self.told, self._told_ns = state, now_ns
        return True
