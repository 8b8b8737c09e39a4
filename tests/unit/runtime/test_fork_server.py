"""How long the supervisor waits for its fork server."""

import os
import socket
import threading
import time

import pytest

from terrafix.runtime.fork_server import answer_of, processor_ticks

LIMIT_S = 0.02


def test_an_answer_is_waited_for_while_there_is_progress() -> None:
    ours, server = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.settimeout(LIMIT_S)
    ticks = iter(range(1000))
    late = threading.Timer(5 * LIMIT_S, server.send, [b"4711"])
    late.start()
    assert answer_of(ours, lambda: next(ticks)) == b"4711"
    assert next(ticks) > 2, "it came after more than one time-out"
    late.join()
    ours.close()
    server.close()


def test_a_server_without_progress_is_given_up_after_one_time_out() -> None:
    ours, server = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.settimeout(LIMIT_S)
    ticks = iter([1, 2, 2, 3])
    with pytest.raises(TimeoutError):
        answer_of(ours, lambda: next(ticks))
    assert next(ticks) == 3
    server.close()
    assert answer_of(ours, lambda: 0) == b"", "a dead server is noticed at once"
    ours.close()


def test_processor_ticks_are_the_processor_time_of_the_process() -> None:
    before, began_s = processor_ticks(os.getpid()), time.process_time()
    while time.process_time() - began_s < 0.1:
        pass
    assert processor_ticks(os.getpid()) - before >= 0.05 * os.sysconf("SC_CLK_TCK")
