"""`terrafix accept` as a command: killed and resumed, wrong maps and camera faults."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from terrafix_lab.accept.fly import Job, fly
from terrafix_lab.accept.measuring.results import JudgedRow, Verdict

FRAMES = 60  # of each flight, half of those of --quick
SHORT = f"from terrafix_lab.accept import run; run.QUICK_FRAMES = {FRAMES}; from terrafix_tools.cli import main; main()"
COMMAND = [sys.executable, "-c", SHORT, "accept"]
SCENARIOS = ("baseline", "foreign frame", "350 m outlier fix")


@dataclass(frozen=True)
class Resumed:
    """A run that was killed after its first scenario, and resumed. ``finished``, ``kept``: times of the results that
    were there before the kill, then and at the end [ns]."""

    out: Path
    finished: dict[Path, int]
    kept: dict[Path, int]
    done: subprocess.CompletedProcess[str]


@pytest.fixture(scope="module")
def resumed(tmp_path_factory: pytest.TempPathFactory) -> Resumed:
    """Its ground is that of all tests here."""
    out = tmp_path_factory.mktemp("resumed") / "accept"
    command = [*COMMAND, "--quick", "--out", str(out), *(part for name in SCENARIOS for part in ("--scenario", name))]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True) as running:
        deadline_s = time.monotonic() + 1200.0
        while not list(out.glob("*/result.json")):
            assert time.monotonic() < deadline_s and running.poll() is None, "no scenario has finished"
            time.sleep(0.1)
        os.killpg(running.pid, signal.SIGKILL)
    finished = {path: path.stat().st_mtime_ns for path in out.glob("*/result.json")}
    done = subprocess.run([*command, "--resume"], capture_output=True, text=True, timeout=1200)
    return Resumed(out, finished, {path: path.stat().st_mtime_ns for path in finished}, done)


@pytest.mark.slow
def test_a_killed_acceptance_run_is_resumed_without_repeating_finished_scenarios(resumed: Resumed) -> None:
    assert resumed.finished and resumed.kept == resumed.finished  # finished scenarios are not run again
    table = json.loads((resumed.out / "acceptance.json").read_text(encoding="utf-8"))
    assert [result["scenario"] for result in table["results"]] == list(SCENARIOS)
    assert resumed.done.returncode == (1 if table["broken"] else 0), resumed.done.stderr
    rows = {(row["scenario"], row["what"]): row for row in table["rows"]}
    for name in SCENARIOS:
        assert rows[name, "frames within 50 m"]["verdict"] == "pass"
        assert rows[name, "frames wrong by over 50 m and sure of it"]["measured"] == 0.0
    assert rows["foreign frame", "wrong frames or fixes rejected"]["measured"] == 1.0
    assert rows["350 m outlier fix", "wrong frames or fixes rejected"]["measured"] == 1.0
    page = (resumed.out / "acceptance.html").read_text(encoding="utf-8")
    assert page.count("<figure") == len(SCENARIOS) and not re.search(r'(src|href)="', page)


@pytest.mark.slow
def test_a_shifted_map_is_generated_flown_and_evaluated_with_the_rows_of_false_inputs(
    resumed: Resumed, tmp_path: Path
) -> None:
    out = tmp_path / "accept"
    out.mkdir()
    (out / "ground").symlink_to(resumed.out / "ground")
    command = [*COMMAND, "--quick", "--workers", "1", "--out", str(out), "--scenario", "map shifted by 300 m"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1200)
    table = json.loads((out / "acceptance.json").read_text(encoding="utf-8"))
    (result,) = table["results"]
    assert result["frames"] == FRAMES and result["nees"] == []  # no frame has true inputs
    rows = {row["what"]: row for row in table["rows"]}
    # The map really is shifted: only the frames that the start position determines are near the truth.
    assert rows["frames within 20 m, shown only"]["measured"] < 0.3
    # A shifted map and a wrong start are not distinguishable on board: the estimate follows one of them, and the
    # summary must report the contradiction.
    summary = json.loads((out / "map-shifted-by-300-m" / "summary.json").read_text(encoding="utf-8"))
    late = rows["false fixes later than 3 s and 5 frames into the lie"]["measured"]
    assert late == 0.0 or "start and map contradict each other" in summary["verdict"]["text"]
    assert done.returncode == (1 if table["broken"] else 0), done.stderr


@pytest.mark.nightly
@pytest.mark.slow
def test_a_frozen_camera_during_a_gnss_jam_does_not_move_the_aircraft_off_its_path(
    resumed: Resumed, tmp_path: Path
) -> None:
    ground, out = resumed.out / "ground" / "base", tmp_path / "out"
    job = Job(
        scenario="GNSS jam, frozen picture", flight="", truth="", map=str(ground / "map.tif"), out=str(out), seed=1,
        generated=True)  # fmt: skip
    rows: dict[str, JudgedRow] = {row.what: row for row in fly(job).rows}
    deviation = rows["aside of the way without the lie while a 3D fix is sent, worst"]
    assert deviation.verdict is Verdict.PASS and deviation.measured is not None and deviation.measured > 0.1
    assert rows["false GPS_INPUT later than 3 s and 5 frames into the lie"].measured == 0.0
    assert rows["fail-safes of the autopilot"].measured == 0.0
    # The autopilot used GPS_INPUT: GNSS was jammed.
    peer = json.loads((out / "peer.json").read_text(encoding="utf-8"))
    assert peer["accepted"] > 100
    assert (out / "without-lie" / "track.csv").is_file()
