"""The systemd unit: systemd understands it, and it lets the link take its priority."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from terrafix.link.output.realtime_priority import PRIORITY

UNIT = Path(__file__).resolve().parents[3] / "systemd" / "terrafix.service"


def granted(key: str) -> list[str]:
    return re.findall(rf"^{key}=(.*)$", UNIT.read_text(), re.MULTILINE)


def test_systemd_has_nothing_to_say_about_the_unit() -> None:
    analyze = shutil.which("systemd-analyze")
    if analyze is None:
        pytest.skip("no systemd-analyze on this machine")
    done = subprocess.run([analyze, "verify", str(UNIT)], capture_output=True, text=True, timeout=60, check=False)
    said = [line for line in done.stderr.splitlines() if UNIT.name in line]
    assert [line for line in said if "is not executable" not in line] == []  # it is not installed here


def test_the_limit_is_what_the_link_asks_for_and_nothing_takes_it_away() -> None:
    """sched(7): up to RLIMIT_RTPRIO no capability is needed. RestrictRealtime= would filter the system call."""
    assert granted("LimitRTPRIO") == [str(PRIORITY)]
    assert granted("AmbientCapabilities") == [""]
    assert granted("RestrictRealtime") in ([], ["no"])
    assert granted("SystemCallFilter") == []
