"""Logs: one JSON object per line, levels, and a blocked reader."""

import io
import json
import threading

import structlog

from terrafix.core import logs


def test_log_lines_are_json_with_level_process_and_both_times() -> None:
    stream = io.StringIO()
    writer = logs.configure("INFO", "anchor", stream)
    logs.get().debug("not shown")
    logs.get().warning("belief spread", sigma_m=12.5)
    writer.close()
    (line,) = [json.loads(text) for text in stream.getvalue().splitlines()]
    assert line.pop("t_ns") > 0 and line.pop("time").endswith("Z")
    assert line == {"process": "anchor", "event": "belief spread", "level": "warning", "sigma_m": 12.5}


class BlockedStream(io.StringIO):
    def __init__(self) -> None:
        super().__init__()
        self.unblock = threading.Event()

    def write(self, text: str) -> int:
        self.unblock.wait()
        return super().write(text)


def test_a_blocked_log_reader_loses_lines_without_blocking_the_process() -> None:
    stream = BlockedStream()
    writer = logs.configure("INFO", "link", stream)
    for i in range(logs.LOG_QUEUE_LENGTH + 500):
        logs.get().info(f"line {i}")
    stream.unblock.set()
    writer.close()
    lines = [json.loads(text) for text in stream.getvalue().splitlines()]
    lost = [line["count"] for line in lines if line["event"] == "log lines lost"]
    written = [line for line in lines if line["event"].startswith("line ")]
    assert sum(lost) + len(written) == logs.LOG_QUEUE_LENGTH + 500
    assert 498 <= sum(lost) <= 500


def test_an_event_that_repeats_is_limited_and_the_next_line_counts_what_was_left_out() -> None:
    now = [0]
    limit = logs.RateLimit(lambda: now[0])

    def passed(event: str) -> dict[str, object] | None:
        try:
            return limit(None, "warning", {"event": event})
        except structlog.DropEvent:
            return None

    lines = [passed("no image") for _ in range(logs.EVENT_BURST + 7)]
    assert (
        lines[: logs.EVENT_BURST] == [{"event": "no image"}] * logs.EVENT_BURST
        and lines[logs.EVENT_BURST :] == [None] * 7
    )
    assert passed("camera lost") == {"event": "camera lost"}, "events are limited one by one"
    now[0] = logs.BURST_NS
    assert passed("no image") == {"event": "no image", "suppressed": 7}
    assert passed("no image") == {"event": "no image"}


def test_the_record_has_warnings_and_errors_below_the_level_of_the_log() -> None:
    writer = logs.configure("ERROR", "vision", stream := io.StringIO())
    list(logs.take_lines(last=True))
    for level in ("debug", "info", "warning", "error"):
        getattr(logs.get(), level)(level)
    writer.close()
    assert [line["event"] for line in logs.take_lines()] == ["warning", "error"]
    assert [json.loads(text)["event"] for text in stream.getvalue().splitlines()] == ["error"]


def test_the_record_counts_every_line_that_the_limit_leaves_out_also_when_no_further_one_comes() -> None:
    writer = logs.configure("INFO", "vision", io.StringIO())
    list(logs.take_lines(last=True))
    for _ in range(25):
        logs.get().error("camera lost", todo="nothing")
    written = list(logs.take_lines())
    assert [line["event"] for line in written] == ["camera lost"] * logs.EVENT_BURST
    (count,) = logs.take_lines(last=True)
    writer.close()
    assert (count["event"], count["level"], count["fields"]) == (
        "camera lost",
        "error",
        {"suppressed": 25 - logs.EVENT_BURST},
    )
    assert list(logs.take_lines(last=True)) == []
