"""Rate limit of requests over all connections, and pauses that the server requests."""

import threading
import time
from dataclasses import dataclass

USER_AGENT = "Terrafix map builder"


@dataclass(frozen=True)
class Limits:
    """Limits for one source. Servers publish theirs; the defaults are for a server that does not."""

    requests_per_s: float = 5.0
    connections: int = 2
    user_agent: str = USER_AGENT
    timeout_s: float = 30.0
    attempts: int = 6
    first_wait_s: float = 0.5  # before the second attempt; doubled for each further one


class Stopped(Exception):
    """The download was aborted while a thread waited for its turn."""


class Pace:
    """Rate limiter for any number of threads."""

    def __init__(self, requests_per_s: float) -> None:
        self._step_s = 1.0 / requests_per_s
        self._next_s = 0.0
        self._lock = threading.Lock()
        self._stop = threading.Event()

    def turn(self) -> None:
        """Blocks until the next request may be sent. Raises Stopped."""
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
        """Pauses all requests for this time."""
        with self._lock:
            self._next_s = max(self._next_s, time.monotonic() + seconds)

    def rest(self, seconds: float) -> None:
        """Blocks the caller only. Raises Stopped."""
        if self._stop.wait(seconds):
            raise Stopped

    def stop(self) -> None:
        self._stop.set()
