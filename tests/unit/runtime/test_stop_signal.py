"""Signals that request the end of the process, and the restoration of the previous handlers."""

import signal
import threading

import pytest

from terrafix.runtime.stop_signal import StopSignal


def test_a_signal_is_recorded_and_the_previous_handlers_are_restored() -> None:
    before = [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)]
    with StopSignal(signal.SIGTERM, signal.SIGINT) as stop_requested:
        assert not stop_requested()
        signal.raise_signal(signal.SIGINT)
        assert stop_requested()
    assert [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)] == before


def test_no_handler_is_installed_outside_the_main_thread() -> None:
    results: list[bool] = []

    def enter_in_thread() -> None:
        with StopSignal(signal.SIGTERM) as stop_requested:
            results.append(stop_requested())

    before = signal.getsignal(signal.SIGTERM)
    thread = threading.Thread(target=enter_in_thread)
    thread.start()
    thread.join()
    assert results == [False] and signal.getsignal(signal.SIGTERM) is before


def test_a_signal_ends_a_start_and_is_only_recorded_from_the_first_question_on() -> None:
    with StopSignal(signal.SIGTERM, ends_start=True) as stop_requested:
        with pytest.raises(SystemExit) as ended:
            signal.raise_signal(signal.SIGTERM)
        assert ended.value.code == 0
        assert stop_requested()
        signal.raise_signal(signal.SIGTERM)
