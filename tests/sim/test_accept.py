"""`terrafix accept` as a person runs it: killed in the middle, resumed, and judged to the end."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from terrafix_tools.accept.fly import Job, fly
from terrafix_tools.accept.generated import make
from terrafix_tools.accept.judged import JudgedRow, Verdict

COMMAND = [sys.executable, "-m", "terrafix_tools.cli", "accept"]
SCENARIOS = ("baseline", "foreign frame", "350 m outlier fix")


@pytest.mark.slow
def test_killed_and_resumed(tmp_path: Path) -> None:
    out = tmp_path / "accept"
    command = [*COMMAND, "--quick", "--out", str(out), *(word for name in SCENARIOS for word in ("--scenario", name))]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True) as running:
        deadline_s = time.monotonic() + 1200.0
        while not list(out.glob("*/result.json")):
            assert time.monotonic() < deadline_s and running.poll() is None, "no scenario came to its end"
            time.sleep(0.5)
        os.killpg(running.pid, signal.SIGKILL)
    kept = {path: path.stat().st_mtime_ns for path in out.glob("*/result.json")}
    done = subprocess.run([*command, "--resume"], capture_output=True, text=True, timeout=1200)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept  # not flown again
    table = json.loads((out / "acceptance.json").read_text(encoding="utf-8"))
    assert [result["scenario"] for result in table["results"]] == list(SCENARIOS)
    assert done.returncode == (1 if table["broken"] else 0), done.stderr
    rows = {(row["scenario"], row["what"]): row for row in table["rows"]}
    for name in SCENARIOS:
        assert rows[name, "frames within 50 m"]["verdict"] == "pass"
        assert rows[name, "frames wrong by over 50 m and sure of it"]["measured"] == 0.0
    assert rows["foreign frame", "wrong frames or fixes rejected"]["measured"] == 1.0
    assert rows["350 m outlier fix", "wrong frames or fixes rejected"]["measured"] == 1.0
    page = (out / "acceptance.html").read_text(encoding="utf-8")
    assert page.count("<figure") == len(SCENARIOS) and not re.search(r'(src|href)="', page)


def test_a_scenario_that_does_not_exist_is_one_clear_line(tmp_path: Path) -> None:
    done = subprocess.run(
        [*COMMAND, "--scenario", "moon", "--out", str(tmp_path)], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 2 and done.stderr.strip().count("\n") == 0 and "'moon': not a scenario" in done.stderr


@pytest.mark.slow
def test_a_map_that_lies_is_made_flown_and_judged_by_the_rows_of_lies(tmp_path: Path) -> None:
    out = tmp_path / "accept"
    command = [*COMMAND, "--quick", "--workers", "1", "--out", str(out), "--scenario", "map shifted by 300 m"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1200)
    table = json.loads((out / "acceptance.json").read_text(encoding="utf-8"))
    (result,) = table["results"]
    assert result["frames"] == 90 and result["nees"] == []  # no frame has true inputs
    rows = {row["what"]: row for row in table["rows"]}
    # The map is really off: only what the start carries is near.
    assert rows["frames within 20 m, shown only"]["measured"] < 0.3
    # Nothing on board tells a map in the wrong place from a wrong start: the flight follows one, and must say so.
    summary = json.loads((out / "map-shifted-by-300-m" / "summary.json").read_text(encoding="utf-8"))
    late = rows["false fixes later than 3 s and 5 frames into the lie"]["measured"]
    assert late == 0.0 or "start and map contradict each other" in summary["verdict"]["text"]
    assert done.returncode == (1 if table["broken"] else 0), done.stderr


@pytest.mark.slow
def test_a_camera_that_freezes_while_gnss_is_jammed_takes_the_aircraft_not_aside(tmp_path: Path) -> None:
    ground, out = tmp_path / "ground", tmp_path / "out"
    make("base", ground, seed=1, frames=4)  # of its flight nothing is used
    job = Job(
        scenario="GNSS jam, frozen picture", flight="", truth="", map=str(ground / "map.tif"), out=str(out), seed=1,
        generated=True)  # fmt: skip
    rows: dict[str, JudgedRow] = {row.what: row for row in fly(job).rows}
    aside = rows["aside of the way without the lie while a 3D fix is sent, worst"]
    assert aside.verdict is Verdict.PASS and aside.measured is not None and aside.measured > 0.1
    assert rows["false GPS_INPUT later than 3 s and 5 frames into the lie"].measured == 0.0
    assert rows["fail-safes of the autopilot"].measured == 0.0
    # It flew on GPS_INPUT: GNSS was gone, and its dead reckoning alone would not have been served.
    peer = json.loads((out / "peer.json").read_text(encoding="utf-8"))
    assert peer["accepted"] > 100
    assert (out / "without-lie" / "track.csv").is_file()
