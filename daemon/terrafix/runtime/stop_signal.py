"""Whether a signal has asked this process to end.

An Event would be set under a lock. Signals come in twos: Ctrl-C and what ends a process group reach a program and its
parent, which passes it on at once. The handler of the second runs in the middle of that of the first, in the same
thread, and waits for that lock for ever."""

import signal
import threading
from types import TracebackType


class StopSignal:
    """``asked()``: one of the signals has come. As a context manager it gives the signals back to whose they were."""

    def __init__(self, *numbers: signal.Signals) -> None:
        """Nothing is heard outside the main thread: only that may have signal handlers."""
        self._came = False
        heard = numbers if threading.current_thread() is threading.main_thread() else ()
        self._before = {number: signal.signal(number, self._note) for number in heard}

    def __call__(self) -> bool:
        return self._came

    def __enter__(self) -> "StopSignal":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, *_: object) -> None:
        self._came = True
