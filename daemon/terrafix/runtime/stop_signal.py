"""Whether a signal has requested this process to end.

A threading.Event is not used because ``set`` takes a lock. Signals often arrive twice: Ctrl-C, or a signal to the
process group, reaches both a program and its parent, which forwards it at once. The handler of the second signal then
interrupts that of the first in the same thread and deadlocks on the lock."""

import signal
import threading
from types import TracebackType


class StopSignal:
    """Calling the object returns whether one of the signals has arrived. A context manager: restores the previous
    handlers at exit."""

    def __init__(self, *numbers: signal.Signals, ends_start: bool = False) -> None:
        """``ends_start``: until the object is called for the first time, a signal ends the program at once
        (SystemExit): a process that starts, and waits for a camera that does not answer, does not ask.

        No handler is installed outside the main thread, because Python allows handlers only there."""
        self._received = False
        self._starting = ends_start
        handled = numbers if threading.current_thread() is threading.main_thread() else ()
        self._previous = {number: signal.signal(number, self._on_signal) for number in handled}

    def __call__(self) -> bool:
        self._starting = False
        return self._received

    def __enter__(self) -> "StopSignal":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _on_signal(self, *_: object) -> None:
        self._received = True
        if self._starting:
            raise SystemExit(0)
