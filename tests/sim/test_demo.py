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

from terrafix.messages import GpsInput
from terrafix.recorder.reader import read_flight
from terrafix_tools.compare.alignment import read_record
from terrafix_tools.compare.difference import compare_records
from terrafix_tools.compare.text import summary

pytestmark = pytest.mark.real_time

TERRAFIX = [sys.executable, "-m", "terrafix_tools.cli"]
COMMAND = [*TERRAFIX, "demo"]
DURATION_S = 45.0
RESUMES_WITHIN_S = 2.0


def children_of(pid: int) -> dict[str, int]:
    """-> pid of each child process by its name (as in `ps`): the daemon's processes and other children."""
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            name = (entry / "comm").read_text().strip()
        except OSError:
            continue  # the process has ended
        if parent == pid:
            found[name] = int(entry.name)
    return found


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
def test_the_demo_sends_gps_input_without_gaps_and_writes_its_report(
    tmp_path: Path, stall_ms: Callable[[], float]
) -> None:
    out = tmp_path / "demo"
    began_s = time.monotonic()
    done = subprocess.run(
        [*COMMAND, "--out", str(out), "--duration", str(DURATION_S)], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0 and " died: " not in done.stdout, done.stdout + done.stderr
    assert time.monotonic() - began_s < 90.0 + DURATION_S
    peer = json.loads((out / "peer.json").read_text())
    assert peer["accepted"] > 5 * DURATION_S
    assert peer["healthy_share"] > 0.95 and peer["longest_gap_ms"] < 245.0 + stall_ms()
    assert peer["gps_error_median_m"] < 20.0
    evaluation = json.loads((out / "evaluation.json").read_text())
    assert evaluation["false_fixes"] == 0 and evaluation["within_50m"] > 0.95
    assert (out / "flight" / "telemetry.tlog").stat().st_size > 0  # the folder can be replayed
    assert_its_record_replays_to_the_same_messages(out, tmp_path / "replay")
    page = (out / "report.html").read_text()
    assert "<svg" in page and not re.search(r'(src|href)="https?://', page)  # one file, works offline


@pytest.mark.slow
def test_killed_processes_are_restarted_and_gps_input_continues(tmp_path: Path, stall_ms: Callable[[], float]) -> None:
    """One after the other, the link first: the largest gap of GPS_INPUT is that of its restart, and the death of the
    others, on which the link does not depend, makes none."""
    out, victims = tmp_path / "demo", ("link", "estimator", "anchor", "vision")
    with subprocess.Popen(
        [*COMMAND, "--out", str(out), "--duration", str(DURATION_S)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as running:
        deadline_s = time.monotonic() + 120.0
        while not set(victims) <= set(children_of(running.pid)):
            assert time.monotonic() < deadline_s and running.poll() is None, "the flight has not started"
            time.sleep(0.2)
        time.sleep(12.0)
        for victim in victims:
            os.kill(children_of(running.pid)[victim], signal.SIGKILL)
            time.sleep(6.0)
        output = running.communicate(timeout=240)[0].decode()
    for victim in victims:
        assert f"{victim} died: killed by SIGKILL" in output and f"{victim} restarted" in output, output
        assert victim in (out / "report.html").read_text()
    assert_its_record_replays_to_the_same_messages(out, tmp_path / "replay")
    sent_ns = [message.t_ns for _, _, message in read_flight(out) if isinstance(message, GpsInput)]
    gaps_ms = np.sort(np.diff(sent_ns)) / 1e6
    assert len(gaps_ms) > 5 * DURATION_S and gaps_ms[-2] < 245.0 + stall_ms()
    peer = json.loads((out / "peer.json").read_text())
    assert peer["longest_gap_ms"] < 1e3 * RESUMES_WITHIN_S


def test_demo_does_not_write_into_a_foreign_folder(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("precious")
    done = subprocess.run([*COMMAND, "--out", str(tmp_path)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 6
    assert done.stderr.strip().count("\n") == 0 and "not made by demo" in done.stderr
    assert (tmp_path / "thesis.txt").read_text() == "precious"


def test_a_too_short_duration_is_a_usage_error_of_one_line(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    done = subprocess.run([*COMMAND, "--out", str(out), "--duration", "1"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and "--duration 1" in done.stderr
    assert not out.exists()
