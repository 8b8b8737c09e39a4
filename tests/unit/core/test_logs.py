"""Logs: one JSON object a line, levels, and a reader that hangs."""

import io
import json
import threading

from terrafix.core import logs


def test_lines_are_json_with_level_process_and_both_times() -> None:
    stream = io.StringIO()
    writer = logs.configure("INFO", "anchor", stream)
    logs.get().debug("not shown")
    logs.get().warning("belief spread", sigma_m=12.5)
    writer.close()
    (line,) = [json.loads(text) for text in stream.getvalue().splitlines()]
    assert line.pop("t_ns") > 0 and line.pop("time").endswith("Z")
    assert line == {"process": "anchor", "event": "belief spread", "level": "warning", "sigma_m": 12.5}


class Hanging(io.StringIO):
    def __init__(self) -> None:
        super().__init__()
        self.go_on = threading.Event()

    def write(self, text: str) -> int:
        self.go_on.wait()
        return super().write(text)


def test_a_reader_that_hangs_costs_lines_and_not_time() -> None:
    stream = Hanging()
    writer = logs.configure("INFO", "link", stream)
    for i in range(logs.QUEUE_LENGTH + 500):
        logs.get().info("line", number=i)
    stream.go_on.set()
    writer.close()
    lines = [json.loads(text) for text in stream.getvalue().splitlines()]
    lost = [line["count"] for line in lines if line["event"] == "log lines lost"]
    written = [line for line in lines if line["event"] == "line"]
    assert sum(lost) + len(written) == logs.QUEUE_LENGTH + 500
    assert 498 <= sum(lost) <= 500
