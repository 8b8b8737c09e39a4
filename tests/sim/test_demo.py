"""`terrafix demo` as a command, with the real processes and a simulated autopilot."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from runtime_nodes import children_of
from terrafix.messages import GpsInput
from terrafix.recorder.reader import read_flight
from terrafix_tools.compare.alignment import read_record
from terrafix_tools.compare.difference import compare_records
from terrafix_tools.compare.text import summary

pytestmark = pytest.mark.real_time

TERRAFIX = [sys.executable, "-m", "terrafix_tools.cli"]
COMMAND = [*TERRAFIX, "demo"]
DURATION_S, UNDISTURBED_S, BETWEEN_KILLS_S = 42.0, 16.0, 4.0
RESUMES_WITHIN_S = 2.0


def assert_its_record_replays_to_the_same_messages(out: Path, folder: Path) -> None:
    """Replays the record of a live run, and compares all messages.

    In a new process, as a user does: the order of a sum depends on the number of threads of BLAS, which `terrafix` sets
    to 1 only where numpy has not been imported before it."""
    replay = [*TERRAFIX, "replay", str(out), "--out", str(folder)]
    done = subprocess.run(replay, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    comparison = compare_records(read_record(out), read_record(folder))
    assert comparison["equal"], list(summary(comparison))


@pytest.mark.slow
def test_the_demo_sends_gps_input_without_gaps_over_restarts_and_writes_its_report(
    tmp_path: Path, stall_ms: Callable[[], float]
) -> None:
    """Undisturbed at first. Then processes are killed one after the other, the link first: the largest gap of GPS_INPUT
    is that of its restart, and the death of the others, on which the link does not depend, makes none."""
    out, victims = tmp_path / "demo", ("link", "estimator", "anchor", "vision")
    began_s = time.monotonic()
    with subprocess.Popen(
        [*COMMAND, "--out", str(out), "--duration", str(DURATION_S)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as running:

        def eventually(look: Callable[[], bool]) -> None:
            while not look():
                assert time.monotonic() < began_s + 120.0 and running.poll() is None, "the flight has ended"
                time.sleep(0.1)

        eventually(lambda: set(victims) <= set(children_of(running.pid)))
        time.sleep(UNDISTURBED_S)
        killed_ns = time.monotonic_ns()
        for victim in victims:
            pid = children_of(running.pid)[victim]
            os.kill(pid, signal.SIGKILL)
            eventually(lambda name=victim, old=pid: children_of(running.pid).get(name, old) != old)  # type: ignore[misc]
            time.sleep(BETWEEN_KILLS_S)
        output = running.communicate(timeout=240)[0].decode()
    assert running.returncode == 0 and time.monotonic() - began_s < 90.0 + DURATION_S, output
    page = (out / "report.html").read_text()
    for victim in victims:
        assert f"{victim} died: killed by SIGKILL" in output and f"{victim} restarted" in output, output
        assert victim in page
    assert "<svg" in page and not re.search(r'(src|href)="https?://', page)  # one file, works offline
    assert (out / "flight" / "telemetry.tlog").stat().st_size > 0  # the folder can be replayed
    assert_its_record_replays_to_the_same_messages(out, tmp_path / "replay")
    sent = [message for _, _, message in read_flight(out) if isinstance(message, GpsInput)]
    fixed = [message.fix_type == 3 for message in sent if message.t_ns < killed_ns]
    assert len(fixed) > 10 * UNDISTURBED_S - 50 and np.mean(fixed[fixed.index(True) :]) > 0.95
    gaps_ms, limit_ms = np.sort(np.diff([message.t_ns for message in sent])) / 1e6, 245.0 + stall_ms()
    assert np.diff([message.t_ns for message in sent if message.t_ns < killed_ns]).max() / 1e6 < limit_ms
    assert len(gaps_ms) > 5 * DURATION_S and gaps_ms[-2] < limit_ms
    peer = json.loads((out / "peer.json").read_text())
    assert peer["accepted"] > 5 * DURATION_S and peer["longest_gap_ms"] < 1e3 * RESUMES_WITHIN_S
    assert peer["gps_error_median_m"] < 20.0
    evaluation = json.loads((out / "evaluation.json").read_text())
    assert evaluation["false_fixes"] == 0 and evaluation["within_50m"] > 0.85  # vision missed some of the frames


def test_a_foreign_folder_and_a_too_short_duration_are_errors_of_one_line(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("precious")
    short = ["--out", str(tmp_path / "demo"), "--duration", "1"]
    for options, code, reason in ((["--out", str(tmp_path)], 6, "not made by demo"), (short, 2, "--duration 1")):
        done = subprocess.run([*COMMAND, *options], capture_output=True, text=True, timeout=60)
        assert (done.returncode, done.stderr.strip().count("\n")) == (code, 0) and reason in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
