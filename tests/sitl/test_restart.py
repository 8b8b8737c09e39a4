"""Restart of Terrafix in flight with ArduPilot's firmware in the loop: loss and return of the fix, and the external
position that is accepted meanwhile."""

import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from pilot import GUIDED, Pilot, kill_terrafix, start_terrafix, take_off
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from stationary_copter import HOME, SENT, ReceivedMessages, copter, free_port, run_link

from terrafix.core.config import LinkSection

pytestmark = pytest.mark.slow
HOVER_S = 20.0
SILENT_S = 5.5  # the firmware reports the loss after 4.0 s; its failsafe follows after 7.8 s
RESUMES_WITHIN_S = 2.0
NEAR_M = 10.0


def first_fix_times(running: subprocess.Popen[str]) -> tuple[float, float]:
    """-> time of the first 3D fix on the monotonic clock [s], and the processor time of the program until then [s]."""
    assert running.stdout is not None
    line = next(line for line in running.stdout if line.startswith("fix "))  # the logs are in the same stream
    running.stdout.close()
    _, at_s, cpu_s = line.split()
    return float(at_s), float(cpu_s)


def test_fact_a_kill_in_flight_loses_the_fix_until_two_seconds_after_the_restart(
    tmp_path: Path, stall_ms: Callable[[], float]
) -> None:
    """GPS_INPUT is the only GPS; all thresholds of the EKF have their defaults."""
    port, ground_port = free_port(), free_port()
    pilot, running = Pilot(ground_port), start_terrafix(port)
    try:
        with copter(tmp_path, {"GPS1_TYPE": 14, "GPS1_DELAY_MS": 5}, port, free_port(socket.SOCK_STREAM), ground_port):
            take_off(pilot)
            pilot.gps_healthy.clear()
            pilot.receive_for(HOVER_S)
            assert all(pilot.gps_healthy) and len(pilot.gps_healthy) > HOVER_S
            assert pilot.true_distance_from_home_m() < NEAR_M
            killed_s = time.monotonic()
            kill_terrafix(running)
            pilot.receive_for(SILENT_S)
            lost = [t_s - killed_s for t_s, fix in pilot.fixes if t_s > killed_s and fix < 3]
            assert lost and lost[0] > 3.0, "the firmware did not show the loss"
            running, restarted_s = start_terrafix(port), time.monotonic()
            pilot.wait_for("3D fix after the restart", lambda: pilot.fix_type() == 3)
            back_s = pilot.fixes[-1][0]
            sent_s, cpu_s = first_fix_times(running)
            pilot.receive_for(5.0)
            sys.stdout.write(
                f"fix lost {lost[0]:.2f} s after the kill; back {back_s - restarted_s:.2f} s after the restart: "
                f"{cpu_s:.2f} s of a processor to the first GPS_INPUT, shown {back_s - sent_s:.2f} s after it\n"
            )
            # The start-up is counted in processor time, which a busy machine does not lengthen.
            assert cpu_s + back_s - sent_s < RESUMES_WITHIN_S + stall_ms() / 1e3
            assert pilot.true_distance_from_home_m() < NEAR_M
            assert pilot.newest["HEARTBEAT"].custom_mode == GUIDED  # no failsafe
            assert not [text for text in pilot.texts if "EKF variance" in text or "Failsafe" in text], pilot.texts
    finally:
        kill_terrafix(running)
        pilot.close()


def test_fact_an_external_position_is_accepted_after_gps_input_has_stopped(tmp_path: Path) -> None:
    """The EKF resets its position to the sent one at once, without an innovation gate."""
    port = free_port()
    device = f"udpin:127.0.0.1:{port}"

    def is_acknowledged(received: ReceivedMessages) -> bool:
        ack = received.newest.get("COMMAND_ACK")
        return (
            ack is not None
            and ack.command == mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
            and is_at_sent_position(received)
        )

    def is_at_sent_position(received: ReceivedMessages) -> bool:
        position = received.position_e7("GLOBAL_POSITION_INT")
        return position is not None and abs(position[0] - round(SENT[0] * 1e7)) < 200

    with copter(tmp_path, {"GPS1_TYPE": 14, "GPS1_DELAY_MS": 5}, port, free_port(socket.SOCK_STREAM)):
        flag = mavlink.EKF_POS_HORIZ_ABS
        has_position = lambda r: bool(getattr(r.newest.get("EKF_STATUS_REPORT"), "flags", 0) & flag)  # noqa: E731
        run_link(LinkSection(device=device), has_position, HOME)
        time.sleep(1.5)  # an external position is rejected while the EKF fuses GPS
        received = run_link(LinkSection(device=device, outputs=["external_position"]), is_acknowledged)
    assert received.newest["COMMAND_ACK"].result == mavlink.MAV_RESULT_ACCEPTED, received.texts
    assert is_at_sent_position(received)
