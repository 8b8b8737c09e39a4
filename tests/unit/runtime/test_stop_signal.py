"""Signals that ask for the end: noted, and given back."""

import signal
import threading

from terrafix.runtime.stop_signal import StopSignal


def test_a_signal_is_noted_and_then_the_signals_are_again_whose_they_were() -> None:
    before = [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)]
    with StopSignal(signal.SIGTERM, signal.SIGINT) as asked:
        assert not asked()
        signal.raise_signal(signal.SIGINT)
        assert asked()
    assert [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)] == before


def test_outside_the_main_thread_no_signal_is_taken() -> None:
    heard: list[bool] = []

    def look() -> None:
        with StopSignal(signal.SIGTERM) as asked:
            heard.append(asked())

    before = signal.getsignal(signal.SIGTERM)
    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    assert heard == [False] and signal.getsignal(signal.SIGTERM) is before
