"""Outputs of the link with ArduPilot's firmware in the loop: each is used by the firmware, also signed; preflight reads
and sets parameters; a spoofed receiver is deselected."""

import json
import socket
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from stationary_copter import HOME, WAIT_S, ReceivedMessages, copter, free_port, run_link

from terrafix.core.config import LinkSection
from terrafix.link.mavlink.signing import timestamp

pytestmark = pytest.mark.slow
EXTERNAL_NAV = {"GPS1_TYPE": 0, "VISO_TYPE": 1, "EK3_SRC1_POSXY": 6, "EK3_SRC1_POSZ": 1, "EK3_SRC1_YAW": 1}
ODOMETRY = EXTERNAL_NAV | {"EK3_SRC1_VELXY": 6, "EK3_SRC1_VELZ": 6}
VISION = EXTERNAL_NAV | {"EK3_SRC1_VELXY": 0, "EK3_SRC1_VELZ": 0}
RECEIVERS = {"SERIAL3_PROTOCOL": 5, "SERIAL4_PROTOCOL": 32, "GPS1_TYPE": 5, "GPS2_TYPE": 19, "GPS_AUTO_SWITCH": 0}
PLACE = (480_010_000, 110_020_000)


def near(position_e7: tuple[int, int] | None) -> bool:
    """True within 0.1 m of PLACE."""
    return position_e7 is not None and max(abs(a - b) for a, b in zip(position_e7, PLACE, strict=True)) < 10


@pytest.mark.parametrize(("output", "parameters"), [("odometry", ODOMETRY), ("vision_position", VISION)])
def test_fact_the_ekf_fuses_a_local_pose_and_reports_the_sent_position(
    output: str, parameters: dict[str, float], tmp_path: Path
) -> None:
    port = free_port()
    config = msgspec.convert({"device": f"udpin:127.0.0.1:{port}", "outputs": [output]}, LinkSection)
    with copter(tmp_path, parameters, port, free_port(socket.SOCK_STREAM)):
        received = run_link(config, lambda h: near(h.position_e7("GLOBAL_POSITION_INT")))
    assert near(received.position_e7("GLOBAL_POSITION_INT")), received.texts
    assert any("is using external nav data" in text for text in received.texts)


def test_fact_nmea_and_msp_outputs_appear_as_receivers_with_a_3d_fix(tmp_path: Path) -> None:
    port, base = free_port(), free_port(socket.SOCK_STREAM)
    tcp = [f"tcp:127.0.0.1:{base + serial}" for serial in (3, 4)]
    config = LinkSection(device=f"udpin:127.0.0.1:{port}", nmea_device=tcp[0], msp_device=tcp[1])
    with copter(tmp_path, RECEIVERS, port, base):
        time.sleep(5.0)  # until its serial ports listen
        received = run_link(config, lambda h: near(h.position_e7("GPS_RAW_INT")) and near(h.position_e7("GPS2_RAW")))
    for kind in ("GPS_RAW_INT", "GPS2_RAW"):
        assert near(received.position_e7(kind))
        fix = received.newest[kind]
        assert (fix.fix_type, fix.satellites_visible, fix.alt) == (3, 6, 501_000)


def give_key(port: int, key: bytes) -> None:
    """Sends SETUP_SIGNING with the current time, as a ground station does."""
    station = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.bind(("127.0.0.1", port))
        wire.settimeout(WAIT_S)
        firmware = wire.recvfrom(4096)[1]
        time.sleep(2.0)  # until the firmware has started its links
        packet = mavlink.MAVLink_setup_signing_message(1, 1, list(key), timestamp(time.time_ns())).pack(station)
        wire.sendto(packet, firmware)
        time.sleep(1.0)


def test_fact_signed_packets_pass_both_ways_and_none_with_another_key(tmp_path: Path) -> None:
    port, key = free_port(), bytes(range(32))
    files = {"right": key, "wrong": bytes(32)}
    for name, content in files.items():
        (tmp_path / name).touch(mode=0o600)
        (tmp_path / name).write_bytes(content)
    devices = {"device": f"udpin:127.0.0.1:{port}"}
    with copter(tmp_path, {"GPS1_TYPE": 14}, port, free_port(socket.SOCK_STREAM)):
        give_key(port, key)
        right = run_link(
            LinkSection(**devices, signing_key=str(tmp_path / "right")), lambda h: near(h.position_e7("GPS_RAW_INT"))
        )
        began_s = time.monotonic()
        wrong = run_link(
            LinkSection(**devices, signing_key=str(tmp_path / "wrong")), lambda _: time.monotonic() > began_s + 4
        )
    # Signing works in both directions: our GPS_INPUT was accepted, and so was the firmware's GPS_RAW_INT.
    assert near(right.position_e7("GPS_RAW_INT")), right.texts
    assert right.newest["GPS_RAW_INT"].get_msgbuf()[2] & 1
    assert wrong.newest == {}


def test_preflight_reads_and_sets_parameters_until_all_checks_pass(tmp_path: Path) -> None:
    port = free_port()
    command = [sys.executable, "-m", "terrafix_tools.cli", "preflight", "--link", f"udpin:127.0.0.1:{port}"]
    command += ["--autopilot-only", "--json", "--out", str(tmp_path / "out")]
    with copter(tmp_path, {}, port, free_port(socket.SOCK_STREAM)):
        time.sleep(4.0)  # until the firmware has started its links
        runs = [
            subprocess.run([*command, *more], capture_output=True, text=True, timeout=WAIT_S, check=False)
            for more in ([], ["--write", "--yes"], [])
        ]
    assert [run.returncode for run in runs] == [1, 0, 0], runs[-1].stdout + runs[-1].stderr
    before, written, after = (json.loads(run.stdout) for run in runs)
    assert {line["check"] for line in before["lines"] if line["status"] == "fail"} >= {"GPS1_TYPE", "GPS1_DELAY_MS"}
    assert {line["check"] for line in after["lines"] if line["status"] != "ok"} == {"mission"}  # the vehicle has none
    old = dict(line.split(",") for line in Path(written["saved_to"]).read_text().splitlines())
    assert float(old["GPS1_TYPE"]) == 1.0


SPOOF_DEG = 0.001  # 111 m


class Spoofer:
    """Arms the copter on the ground after 30 s, when the link trusts the receiver; 3 s later shifts the receiver's
    position by SPOOF_DEG to the north. -> True when the firmware has answered the change of GPS_PRIMARY."""

    def __init__(self) -> None:
        self._began_s = time.monotonic()
        self._armed = self._spoofed = False

    def __call__(self, received: ReceivedMessages) -> bool:
        elapsed_s = time.monotonic() - self._began_s
        if elapsed_s > 30.0 and not self._armed:
            self._armed = True
            force = (1.0, 21196.0, *(0.0,) * 5)
            received.send(mavlink.MAVLink_command_long_message(1, 1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, *force))
        if elapsed_s > 33.0 and not self._spoofed:
            self._spoofed = True
            for name in (b"SIM_GPS1_GLTCH_X", b"SIM_GPS_GLITCH_X"):  # depending on the firmware's version
                received.send(mavlink.MAVLink_param_set_message(1, 1, name, SPOOF_DEG, mavlink.MAV_PARAM_TYPE_REAL32))
        value = received.newest.get("PARAM_VALUE")
        return elapsed_s > 36.0 and value is not None and value.param_id == "GPS_PRIMARY"


def test_fact_a_spoofed_autopilot_is_switched_to_gps_input_in_flight(tmp_path: Path) -> None:
    """The receiver is off by 111 m; the spoofing detector sets GPS_PRIMARY, and the EKF keeps the true position."""
    port = free_port()
    two_receivers = {"GPS2_TYPE": 14, "GPS2_DELAY_MS": 5, "GPS_AUTO_SWITCH": 4, "GPS_PRIMARY": 0, "ARMING_CHECK": 0}
    parameters = two_receivers | {"DISARM_DELAY": 0, "EK3_GPS_CHECK": 23}
    config = LinkSection(device=f"udpin:127.0.0.1:{port}", gps_id=1, gnss="act")
    with copter(tmp_path, parameters, port, free_port(socket.SOCK_STREAM)):
        received = run_link(config, Spoofer(), HOME)
    spoofed, reported = received.position_e7("GPS_RAW_INT"), received.position_e7("GLOBAL_POSITION_INT")
    assert spoofed is not None and reported is not None
    assert spoofed[0] - round(HOME[0] * 1e7) == pytest.approx(SPOOF_DEG * 1e7, abs=500)
    assert abs(reported[0] - round(HOME[0] * 1e7)) < 700  # 8 m
    assert received.newest["PARAM_VALUE"].param_value == 1.0
