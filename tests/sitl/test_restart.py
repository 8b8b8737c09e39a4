"""Killed and started again in flight: what ArduPilot's own firmware shows, and an external position in between."""

import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from pilot import GUIDED, Pilot, end, fly_up, terrafix
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from standing_copter import HOME, SENT, Heard, copter, free_port, stand

from terrafix.core.config import LinkSection

pytestmark = pytest.mark.slow
HOVER_S = 20.0
SILENT_S = 5.5  # the firmware notices after 4.0 s, and its failsafe comes after 7.8 s
RESUMES_WITHIN_S = 2.0
NEAR_M = 10.0


def began(running: subprocess.Popen[str]) -> tuple[float, float]:
    """(s on the monotonic clock, s of a processor) at its first 3D fix."""
    assert running.stdout is not None
    line = next(line for line in running.stdout if line.startswith("fix "))  # logs come there, too
    running.stdout.close()
    _, at_s, cpu_s = line.split()
    return float(at_s), float(cpu_s)


def test_fact_killed_in_flight_the_fix_goes_and_is_back_two_seconds_after_the_restart(
    tmp_path: Path, stall_ms: Callable[[], float]
) -> None:
    """GPS_INPUT is the only GPS, and every threshold of the filter is as it comes."""
    port, ground_port = free_port(), free_port()
    pilot, running = Pilot(ground_port), terrafix(port)
    try:
        with copter(tmp_path, {"GPS1_TYPE": 14, "GPS1_DELAY_MS": 5}, port, free_port(socket.SOCK_STREAM), ground_port):
            fly_up(pilot)
            pilot.healthy.clear()
            pilot.listen(HOVER_S)
            assert all(pilot.healthy) and len(pilot.healthy) > HOVER_S
            assert pilot.off_home_m() < NEAR_M
            killed_s = time.monotonic()
            end(running)
            pilot.listen(SILENT_S)
            lost = [t_s - killed_s for t_s, fix in pilot.fixes if t_s > killed_s and fix < 3]
            assert lost and lost[0] > 3.0, "the firmware did not show the loss"
            running, restarted_s = terrafix(port), time.monotonic()
            pilot.until("the fix after the restart", lambda: pilot.fix() == 3)
            back_s = pilot.fixes[-1][0]
            sent_s, cpu_s = began(running)
            pilot.listen(5.0)
            sys.stdout.write(
                f"fix lost {lost[0]:.2f} s after the kill; back {back_s - restarted_s:.2f} s after the restart: "
                f"{cpu_s:.2f} s of a processor to the first GPS_INPUT, shown {back_s - sent_s:.2f} s after it\n"
            )
            # On a busy machine a program starts as slowly as the machine lets it: its share of a processor counts.
            assert cpu_s + back_s - sent_s < RESUMES_WITHIN_S + stall_ms() / 1e3
            assert pilot.off_home_m() < NEAR_M
            assert pilot.newest["HEARTBEAT"].custom_mode == GUIDED  # no failsafe
            assert not [text for text in pilot.texts if "EKF variance" in text or "Failsafe" in text], pilot.texts
    finally:
        end(running)
        pilot.close()


def test_fact_an_external_position_is_accepted_when_gps_input_has_ended(tmp_path: Path) -> None:
    """A hard reset without a gate: it stands where we say, at once."""
    port = free_port()
    device = f"udpin:127.0.0.1:{port}"

    def answered(heard: Heard) -> bool:
        ack = heard.newest.get("COMMAND_ACK")
        return ack is not None and ack.command == mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE and moved(heard)

    def moved(heard: Heard) -> bool:
        at = heard.at("GLOBAL_POSITION_INT")
        return at is not None and abs(at[0] - round(SENT[0] * 1e7)) < 200

    with copter(tmp_path, {"GPS1_TYPE": 14, "GPS1_DELAY_MS": 5}, port, free_port(socket.SOCK_STREAM)):
        flag = mavlink.EKF_POS_HORIZ_ABS
        placed = lambda h: bool(getattr(h.newest.get("EKF_STATUS_REPORT"), "flags", 0) & flag)  # noqa: E731
        stand(LinkSection(device=device), placed, HOME)
        time.sleep(1.5)  # it takes none while it fuses GPS
        heard = stand(LinkSection(device=device, outputs=["external_position"]), answered)
    assert heard.newest["COMMAND_ACK"].result == mavlink.MAV_RESULT_ACCEPTED, heard.texts
    assert moved(heard)
