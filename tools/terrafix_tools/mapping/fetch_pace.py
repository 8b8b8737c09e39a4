"""How fast a server may be asked: requests a second over all connections, and pauses that it asks for."""

import threading
import time
from dataclasses import dataclass

USER_AGENT = "Terrafix map builder"


@dataclass(frozen=True)
class Limits:
    """Good manners of one source. Servers state theirs; these are for a server that states none."""

    requests_per_s: float = 5.0
    connections: int = 2
    user_agent: str = USER_AGENT
    timeout_s: float = 30.0
    attempts: int = 6
    first_wait_s: float = 0.5  # before the second attempt; doubles from there


class Stopped(Exception):
    """The work was given up while a thread waited for its turn."""


class Pace:
    """Turns for any number of threads."""

    def __init__(self, requests_per_s: float) -> None:
        self._step_s = 1.0 / requests_per_s
        self._next_s = 0.0
        self._lock = threading.Lock()
        self._stop = threading.Event()

    def turn(self) -> None:
        """Returns when the next request may go out. Raises Stopped."""
        while True:
            with self._lock:
                now_s = time.monotonic()
                wait_s = self._next_s - now_s
                if wait_s <= 0.0:
                    self._next_s = max(now_s, self._next_s) + self._step_s
                    if not self._stop.is_set():
                        return
            if self._stop.wait(max(wait_s, 0.0)):
                raise Stopped

    def hold(self, seconds: float) -> None:
        """Nobody asks for this long."""
        with self._lock:
            self._next_s = max(self._next_s, time.monotonic() + seconds)

    def rest(self, seconds: float) -> None:
        """Only the caller waits. Raises Stopped."""
        if self._stop.wait(seconds):
            raise Stopped

    def stop(self) -> None:
        self._stop.set()
