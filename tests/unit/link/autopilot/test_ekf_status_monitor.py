"""Monitor of the autopilot's EKF status, the log of the connection state, and real-time priority."""

import math
import subprocess
import sys
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from structlog.testing import capture_logs

from link_rig import S, estimate, every, fly, texts
from link_wire import WiredEdge, heartbeat
from terrafix import messages as m
from terrafix.link.node import LinkNode
from terrafix.link.status import StatusLog

USING_FLAGS = 831  # ArduPilot with a position: attitude, velocities, positions relative, absolute and predicted
NOT_USING_FLAGS = 167  # attitude, vertical, constant position mode


def autopilot_texts(flags: Any, seconds: int = 60, sigma_m: float = 4.0) -> list[tuple[int, str]]:
    """-> (second, text about the EKF) of a flight in which the EKF status is ``flags(second)``; None: not sent."""
    node, found = LinkNode(10.0), []
    feed = every(S // 2, lambda t_ns: estimate(t_ns, sigma_m=sigma_m))
    for second in range(seconds):
        value = flags(second)
        if value is not None:
            list(node.on(m.EkfStatus(t_ns=second * S, flags=value, position_ratio=0.1, velocity_ratio=0.1)))
        texts_now = texts(fly(node, second * S, (second + 1) * S, feed))
        found += [(second, text) for text in texts_now if "autopilot" in text]
    return found


def test_no_text_while_the_autopilot_uses_the_position() -> None:
    assert autopilot_texts(lambda _: USING_FLAGS) == []


@pytest.mark.parametrize(
    "flags", [NOT_USING_FLAGS, mavlink.EKF_UNINITIALIZED, USING_FLAGS & ~mavlink.EKF_POS_HORIZ_ABS]
)
def test_an_autopilot_that_does_not_use_the_position_is_reported_after_30_s(flags: int) -> None:
    ((second, text),) = autopilot_texts(lambda _: flags)
    assert text == "Terrafix: autopilot does not use the position"
    assert second == pytest.approx(30, abs=2)  # the first 3D fix comes within a second


def test_a_text_reports_that_the_position_is_used_again() -> None:
    found = autopilot_texts(lambda second: NOT_USING_FLAGS if second < 40 else USING_FLAGS)
    assert [text for _, text in found][1:] == ["Terrafix: autopilot uses a position again"]


def test_no_text_without_a_fix_or_without_a_recent_ekf_status() -> None:
    assert autopilot_texts(lambda _: NOT_USING_FLAGS, sigma_m=80.0) == []
    assert autopilot_texts(lambda second: NOT_USING_FLAGS if second < 3 else None) == []


def received_status(*messages: Any) -> tuple[m.EkfStatus, set[int]]:
    """-> the one EkfStatus of these messages, and the ids of the streams that the link requests."""
    link = WiredEdge()
    (status,) = [x for x in link.receives(S, *messages) if isinstance(x, m.EkfStatus)]
    commands = link.wire.take("COMMAND_LONG")
    return status, {int(x.param1) for x in commands if x.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL}


def test_ekf_status_report_is_requested_and_recorded() -> None:
    report = mavlink.MAVLink_ekf_status_report_message(USING_FLAGS, 0.2, 0.3, 0.1, 0.1, 0.0)
    broken = mavlink.MAVLink_ekf_status_report_message(USING_FLAGS, float("nan"), 0.3, 0.1, 0.1, 0.0)
    status, requested = received_status(heartbeat(), report, broken)
    assert (status.flags, status.t_ns) == (USING_FLAGS, S)
    assert (status.velocity_ratio, status.position_ratio) == pytest.approx((0.2, 0.3))
    assert mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT in requested


def test_px4_estimator_status_is_converted_to_filter_status() -> None:
    flags = USING_FLAGS | mavlink.ESTIMATOR_GPS_GLITCH  # the same bit as ArduPilot's EKF_UNINITIALIZED
    report = mavlink.MAVLink_estimator_status_message(0, flags, math.nan, 0.3, 0.1, 0.1, 0.0, 0.0, 1.0, 1.0)
    status, requested = received_status(heartbeat(mavlink.MAV_AUTOPILOT_PX4), report)
    assert (status.flags, status.velocity_ratio) == (USING_FLAGS, 0.0)
    assert status.position_ratio == pytest.approx(0.3)
    assert {mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS, mavlink.MAVLINK_MSG_ID_HIGHRES_IMU} <= requested
    assert not {mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT, mavlink.MAVLINK_MSG_ID_RAW_IMU} & requested


# --- the log ---


def status(second: float, detail: str = "", *, connected: bool = True) -> m.LinkStatus:
    firmware = "ardupilot" if connected else "none"
    return m.LinkStatus(
        t_ns=round(second * S), connected=connected, autopilot=firmware, sysid=1, sent=0, received=0, bad=0,
        time_offset_ms=None, detail=detail)  # fmt: skip


def test_the_log_contains_changes_of_kind_only() -> None:
    log = StatusLog()
    with capture_logs() as lines:
        for second in range(40):
            log.log(status(second, "nothing heard on /dev/ttyTHS1", connected=False))
        for second in range(40, 60):
            log.log(status(second, f"{second} not sent"))
        for second in range(60, 80):
            log.log(status(second))
    assert [(line["log_level"], line["event"]) for line in lines] == [
        ("warning", "no autopilot"),
        ("warning", "autopilot"),
        ("info", "autopilot"),
    ]
    assert lines[0]["why"] == "nothing heard on /dev/ttyTHS1"
    assert lines[1]["detail"] == "40 not sent"


def test_an_autopilot_that_connects_immediately_is_one_log_line() -> None:
    log = StatusLog()
    with capture_logs() as lines:
        log.log(status(0, "nothing heard", connected=False))
        log.log(status(1))
    assert [line["event"] for line in lines] == ["autopilot"]


def test_an_unknown_firmware_is_reported() -> None:
    link = WiredEdge()
    link.receives(S, heartbeat(mavlink.MAV_AUTOPILOT_GENERIC))
    assert "neither ArduPilot nor PX4" in link.status().detail


# --- the priority of the process ---


def test_the_link_gets_real_time_priority_or_logs_that_it_is_not_permitted() -> None:
    """Runs in another process, which leaves the priority of this one unchanged. A limit of 0 forbids the change."""
    program = (
        "import os, resource, sys, threading\n"
        "from terrafix.link.output.realtime_priority import set_realtime_priority\n"
        "threading.Thread(target=threading.Event().wait, daemon=True).start()\n"  # like the log writer
        "if sys.argv[1] == 'no':\n"
        "    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))\n"
        "    os.getuid() == 0 and os.setuid(65534)\n"
        "threads = os.listdir('/proc/self/task')\n"
        "assert len(threads) == 2\n"
        "print(set_realtime_priority(), all(os.sched_getscheduler(int(t)) == os.SCHED_RR for t in threads))\n"
    )
    for may in ("yes", "no"):
        done = subprocess.run([sys.executable, "-c", program, may], capture_output=True, text=True, check=True)
        lines = done.stdout.strip().splitlines()
        got, first = lines[-1].split()
        assert got == first
        assert (got == "False") == any("no real-time priority" in line for line in lines[:-1])
        assert may == "yes" or got == "False"
