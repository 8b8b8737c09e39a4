"""ArduPilot's own firmware takes each output, signed if asked, and its parameters can be read and set."""

import json
import socket
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from standing_copter import HOME, WAIT_S, Heard, copter, free_port, stand

from terrafix.core.config import LinkSection
from terrafix.link.mavlink.signing import timestamp

pytestmark = pytest.mark.slow
EXTERNAL_NAV = {"GPS1_TYPE": 0, "VISO_TYPE": 1, "EK3_SRC1_POSXY": 6, "EK3_SRC1_POSZ": 1, "EK3_SRC1_YAW": 1}
ODOMETRY = EXTERNAL_NAV | {"EK3_SRC1_VELXY": 6, "EK3_SRC1_VELZ": 6}
VISION = EXTERNAL_NAV | {"EK3_SRC1_VELXY": 0, "EK3_SRC1_VELZ": 0}
RECEIVERS = {"SERIAL3_PROTOCOL": 5, "SERIAL4_PROTOCOL": 32, "GPS1_TYPE": 5, "GPS2_TYPE": 19, "GPS_AUTO_SWITCH": 0}
PLACE = (480_010_000, 110_020_000)


def near(place: tuple[int, int] | None) -> bool:
    return place is not None and max(abs(a - b) for a, b in zip(place, PLACE, strict=True)) < 10  # 0.1 m


@pytest.mark.parametrize(("output", "parameters"), [("odometry", ODOMETRY), ("vision_position", VISION)])
def test_fact_the_filter_takes_a_local_pose_and_stands_where_we_say(
    output: str, parameters: dict[str, float], tmp_path: Path
) -> None:
    port = free_port()
    config = msgspec.convert({"device": f"udpin:127.0.0.1:{port}", "outputs": [output]}, LinkSection)
    with copter(tmp_path, parameters, port, free_port(socket.SOCK_STREAM)):
        heard = stand(config, lambda h: near(h.at("GLOBAL_POSITION_INT")))
    assert near(heard.at("GLOBAL_POSITION_INT")), heard.texts
    assert any("is using external nav data" in text for text in heard.texts)


def test_fact_nmea_and_msp_are_receivers_with_a_3d_fix(tmp_path: Path) -> None:
    port, base = free_port(), free_port(socket.SOCK_STREAM)
    tcp = [f"tcp:127.0.0.1:{base + serial}" for serial in (3, 4)]
    config = LinkSection(device=f"udpin:127.0.0.1:{port}", nmea_device=tcp[0], msp_device=tcp[1])
    with copter(tmp_path, RECEIVERS, port, base):
        time.sleep(5.0)  # its serial ports listen
        heard = stand(config, lambda h: near(h.at("GPS_RAW_INT")) and near(h.at("GPS2_RAW")))
    for kind in ("GPS_RAW_INT", "GPS2_RAW"):
        assert near(heard.at(kind))
        said = heard.newest[kind]
        assert (said.fix_type, said.satellites_visible, said.alt) == (3, 6, 501_000)


def give_key(port: int, key: bytes) -> None:
    """As a ground station does it: SETUP_SIGNING, with the time of now."""
    ours = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.bind(("127.0.0.1", port))
        wire.settimeout(WAIT_S)
        firmware = wire.recvfrom(4096)[1]
        time.sleep(2.0)  # it has started its links
        packet = mavlink.MAVLink_setup_signing_message(1, 1, list(key), timestamp(time.time_ns())).pack(ours)
        wire.sendto(packet, firmware)
        time.sleep(1.0)


def test_fact_signed_both_ways_and_nothing_with_another_key(tmp_path: Path) -> None:
    port, key = free_port(), bytes(range(32))
    files = {"right": key, "wrong": bytes(32)}
    for name, content in files.items():
        (tmp_path / name).touch(mode=0o600)
        (tmp_path / name).write_bytes(content)
    devices = {"device": f"udpin:127.0.0.1:{port}"}
    with copter(tmp_path, {"GPS1_TYPE": 14}, port, free_port(socket.SOCK_STREAM)):
        give_key(port, key)
        right = stand(LinkSection(**devices, signing_key=str(tmp_path / "right")), lambda h: near(h.at("GPS_RAW_INT")))
        began = time.monotonic()
        wrong = stand(
            LinkSection(**devices, signing_key=str(tmp_path / "wrong")), lambda _: time.monotonic() > began + 4
        )
    assert near(right.at("GPS_RAW_INT")), right.texts  # so it took our signed GPS_INPUT, and we its signed answer
    assert right.newest["GPS_RAW_INT"].get_msgbuf()[2] & 1
    assert wrong.newest == {}


def test_preflight_reads_sets_and_is_content(tmp_path: Path) -> None:
    port = free_port()
    command = [sys.executable, "-m", "terrafix_tools.cli", "preflight", "--link", f"udpin:127.0.0.1:{port}"]
    command += ["--autopilot-only", "--json", "--out", str(tmp_path / "out")]
    with copter(tmp_path, {}, port, free_port(socket.SOCK_STREAM)):
        time.sleep(4.0)  # it has started its links
        runs = [
            subprocess.run([*command, *more], capture_output=True, text=True, timeout=WAIT_S, check=False)
            for more in ([], ["--write", "--yes"], [])
        ]
    assert [run.returncode for run in runs] == [1, 0, 0], runs[-1].stdout + runs[-1].stderr
    before, written, after = (json.loads(run.stdout) for run in runs)
    assert {line["check"] for line in before["lines"] if line["status"] == "fail"} >= {"GPS1_TYPE", "GPS1_DELAY_MS"}
    assert {line["check"] for line in after["lines"] if line["status"] != "ok"} == {"mission"}  # none on board
    old = dict(line.split(",") for line in Path(written["saved_to"]).read_text().splitlines())
    assert float(old["GPS1_TYPE"]) == 1.0


SPOOF_DEG = 0.001  # 111 m


class Spoofer:
    """Arms the copter on the ground when the receiver is trusted, then moves what its receiver says."""

    def __init__(self) -> None:
        self._began_s = time.monotonic()
        self._armed = self._spoofed = False

    def __call__(self, heard: Heard) -> bool:
        elapsed_s = time.monotonic() - self._began_s
        if elapsed_s > 30.0 and not self._armed:
            self._armed = True
            force = (1.0, 21196.0, *(0.0,) * 5)
            heard.send(mavlink.MAVLink_command_long_message(1, 1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, *force))
        if elapsed_s > 33.0 and not self._spoofed:
            self._spoofed = True
            for name in (b"SIM_GPS1_GLTCH_X", b"SIM_GPS_GLITCH_X"):  # as the firmware's version has it
                heard.send(mavlink.MAVLink_param_set_message(1, 1, name, SPOOF_DEG, mavlink.MAV_PARAM_TYPE_REAL32))
        value = heard.newest.get("PARAM_VALUE")
        return elapsed_s > 36.0 and value is not None and value.param_id == "GPS_PRIMARY"


def test_fact_a_spoofed_firmware_is_switched_to_gps_input_in_flight(tmp_path: Path) -> None:
    """The receiver is moved by 111 m; the judge sees it, sets GPS_PRIMARY, and the filter stays with the vehicle."""
    port = free_port()
    beside = {"GPS2_TYPE": 14, "GPS2_DELAY_MS": 5, "GPS_AUTO_SWITCH": 4, "GPS_PRIMARY": 0, "ARMING_CHECK": 0}
    parameters = beside | {"DISARM_DELAY": 0, "EK3_GPS_CHECK": 23}
    config = LinkSection(device=f"udpin:127.0.0.1:{port}", gps_id=1, gnss="act")
    with copter(tmp_path, parameters, port, free_port(socket.SOCK_STREAM)):
        heard = stand(config, Spoofer(), HOME)
    spoofed, believed = heard.at("GPS_RAW_INT"), heard.at("GLOBAL_POSITION_INT")
    assert spoofed is not None and believed is not None
    assert spoofed[0] - round(HOME[0] * 1e7) == pytest.approx(SPOOF_DEG * 1e7, abs=500)
    assert abs(believed[0] - round(HOME[0] * 1e7)) < 700  # 8 m
    assert heard.newest["PARAM_VALUE"].param_value == 1.0
