"""ArduPilot's firmware in the loop flies on GPS_INPUT alone. Needs a SITL binary (docs/sitl.md); up to 20 minutes per
vehicle."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from terrafix.messages import VehicleState
from terrafix.recorder.reader import read_flight

COMMAND = [sys.executable, "-m", "terrafix_tools.cli", "sim", "ardupilot"]


def binary(vehicle: str) -> Path:
    """-> the binary that TERRAFIX_ARDUPILOT_SITL names, or the one for ``vehicle`` in the same folder; skips the test
    without one."""
    pytest.importorskip("mavsdk", reason="SITL MISSING: mavsdk is not installed (pip install 'terrafix[sim]')")
    named = os.environ.get("TERRAFIX_ARDUPILOT_SITL", "")
    if not named:
        pytest.skip("SITL MISSING: set TERRAFIX_ARDUPILOT_SITL to an arduplane or arducopter binary (docs/sitl.md)")
    path = Path(named)
    found = path if vehicle in path.name else path.with_name(f"ardu{vehicle}")
    if not found.is_file():
        pytest.skip(f"SITL MISSING: {found} is not there")
    return found


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", ["plane", "copter"])
def test_five_kilometres_on_gps_input_alone(vehicle: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [*COMMAND, "--binary", str(binary(vehicle)), "--out", str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=2400,
    )
    texts = (tmp_path / "statustext.log").read_text()
    assert done.returncode == 0, done.stdout + done.stderr + texts
    report = json.loads((tmp_path / "ardupilot.json").read_text())
    flown = report["figures"]
    assert flown["took_off_on_gnss"] and flown["landed"]
    assert flown["flown_m"] >= 5000.0 and flown["gnss_fix_reports"] == 0
    assert flown["landing_error_m"] <= 30.0
    assert flown["not_healthy"] == 0
    assert flown["ekf_failsafes"] == 0
    assert flown["gps_input_fix_share"] > 0.9 and flown["belief_p95_m"] < 30.0
    # Only the plane has an airspeed sensor; it flies at 22 m/s.
    states = [message for _, _, message in read_flight(tmp_path / "record") if isinstance(message, VehicleState)]
    airspeeds = [state.airspeed_mps for state in states if state.airspeed_mps is not None]
    assert (len(airspeeds) > 0.9 * len(states) and max(airspeeds) > 15.0) if vehicle == "plane" else not airspeeds
