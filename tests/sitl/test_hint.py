"""Position hints of a ground station through ArduPilot's firmware: the hints reach Terrafix, and its reply and texts
reach the ground station."""

import math
import socket
import time
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from stationary_copter import ReceivedMessages, copter, free_port, run_link

from terrafix.core.config import LinkSection

pytestmark = pytest.mark.slow
EXTERNAL = mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
PLACE = (481_000_000, 111_000_000)


class GroundStation:
    """A ground station on the firmware's SERIAL0. It sends both kinds of hints once the firmware has a position.

    ``acks``: (component, result) of the received COMMAND_ACKs; ``texts``: STATUSTEXT of Terrafix; ``origins``: EKF
    origins that the firmware has reported (1e-7 deg)."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self._socket.setblocking(False)
        self._mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self._firmware_address: Any = None
        self._heartbeat_s = self._hint_s = 0.0
        self.acks: list[tuple[int, int]] = []
        self.texts: list[str] = []
        self.origins: set[tuple[int, int]] = set()

    def __call__(self, received: ReceivedMessages) -> bool:
        """Receives and sends what is due -> True: both hints have arrived, and a reply and a text of Terrafix."""
        self._receive()
        now_s = time.monotonic()
        if self._firmware_address and now_s - self._heartbeat_s > 1.0:
            self._heartbeat_s = now_s
            self._send(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3))
            self._send(mavlink.MAVLink_command_long_message(1, 1, 512, 0, 49.0, *(0.0,) * 6))  # GPS_GLOBAL_ORIGIN
        if self.origins and received.position_e7("GPS_RAW_INT") and now_s - self._hint_s > 4.0:
            self._hint_s = now_s
            place = (PLACE[0] + len(received.hints) * 1000, PLACE[1])
            self._send(mavlink.MAVLink_command_int_message(1, 197, 0, EXTERNAL, 0, 0, 0, 0, 400, 0, *place, math.nan))
            self._send(mavlink.MAVLink_set_gps_global_origin_message(1, place[0] + 500, place[1], 0))
        return len(received.hints) >= 4 and bool(self.acks) and bool(self.texts)

    def _send(self, message: Any) -> None:
        self._socket.sendto(message.pack(self._mav), self._firmware_address)

    def _receive(self) -> None:
        while True:
            try:
                data, self._firmware_address = self._socket.recvfrom(4096)
            except BlockingIOError:
                return
            for message in self._parser.parse_buffer(data) or []:
                kind = message.get_type()
                if kind == "COMMAND_ACK" and message.command == EXTERNAL:
                    self.acks.append((message.get_srcComponent(), message.result))
                elif kind == "STATUSTEXT" and message.get_srcComponent() == 197:
                    self.texts.append(message.text)
                elif kind == "GPS_GLOBAL_ORIGIN":
                    self.origins.add((message.latitude, message.longitude))

    def close(self) -> None:
        self._socket.close()


def test_fact_hints_pass_through_the_firmware_and_do_not_change_its_origin(tmp_path: Path) -> None:
    port, ground_port = free_port(), free_port()
    ground = GroundStation(ground_port)
    config = LinkSection(device=f"udpin:127.0.0.1:{port}")
    try:
        with copter(tmp_path, {"GPS1_TYPE": 14}, port, free_port(socket.SOCK_STREAM), ground_port):
            received = run_link(config, ground)
    finally:
        ground.close()
    radii = sorted({round(hint.radius_m) for hint in received.hints})
    assert radii == [979, 5000], received.texts  # the command with its accuracy, the origin without
    assert {hint.source for hint in received.hints} == {"ground station 255"}
    # Only Terrafix replies: the firmware forwards the command and does not execute it.
    assert set(ground.acks) == {(197, mavlink.MAV_RESULT_ACCEPTED)}
    assert len(ground.origins) == 1  # the firmware's origin is unchanged
    assert any(text.startswith("Terrafix: ") for text in ground.texts)
