"""The systemd unit: systemd-analyze verifies it, and it allows the real-time priority of the link."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from terrafix.link.output.realtime_priority import REALTIME_PRIORITY

UNIT = Path(__file__).resolve().parents[3] / "systemd" / "terrafix.service"


def values_of(key: str) -> list[str]:
    return re.findall(rf"^{key}=(.*)$", UNIT.read_text(), re.MULTILINE)


def test_systemd_analyze_verifies_the_unit() -> None:
    analyze = shutil.which("systemd-analyze")
    if analyze is None:
        pytest.skip("no systemd-analyze on this machine")
    result = subprocess.run([analyze, "verify", str(UNIT)], capture_output=True, text=True, timeout=60, check=False)
    messages = [line for line in result.stderr.splitlines() if UNIT.name in line]
    assert [line for line in messages if "is not executable" not in line] == []  # it is not installed here


def test_the_unit_allows_the_real_time_priority_of_the_link() -> None:
    """sched(7): up to RLIMIT_RTPRIO no capability is needed. RestrictRealtime= would filter the system call."""
    assert values_of("LimitRTPRIO") == [str(REALTIME_PRIORITY)]
    assert values_of("AmbientCapabilities") == [""]
    assert values_of("RestrictRealtime") in ([], ["no"])
    assert values_of("SystemCallFilter")[0] == "@system-service", "sched_setscheduler is in @resources, a part of it"
    assert not any("resources" in value for value in values_of("SystemCallFilter"))


def test_the_exposure_of_the_unit_by_systemd_analyze_is_at_most_2_5_of_10() -> None:
    analyze = shutil.which("systemd-analyze")
    if analyze is None:
        pytest.skip("no systemd-analyze on this machine")
    command = [analyze, "security", "--offline=yes", "--threshold=25", "--no-pager", str(UNIT)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    if "unrecognized option" in result.stderr:
        pytest.skip("this systemd-analyze cannot judge a file")
    assert result.returncode == 0, result.stdout
