"""A ground station's hint reaches us through ArduPilot's own firmware, and our answer and our texts reach it."""

import math
import socket
import time
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from standing_copter import Heard, copter, free_port, stand

from terrafix.core.config import LinkSection

pytestmark = pytest.mark.slow
EXTERNAL = mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
PLACE = (481_000_000, 111_000_000)


class GroundStation:
    """On the firmware's SERIAL0: gives both kinds of hints once the firmware has a position, and listens."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self._socket.setblocking(False)
        self._mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self._ear = mavlink.MAVLink(None)
        self._ear.robust_parsing = True
        self._firmware: Any = None
        self._beat_s = self._hint_s = 0.0
        self.acks: list[tuple[int, int]] = []  # (component, result)
        self.texts: list[str] = []  # of Terrafix
        self.origins: set[tuple[int, int]] = set()

    def __call__(self, heard: Heard) -> bool:
        """One look; True when both hints have arrived, the answer is there and a text of ours was read."""
        self._listen()
        now_s = time.monotonic()
        if self._firmware and now_s - self._beat_s > 1.0:
            self._beat_s = now_s
            self._send(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3))
            self._send(mavlink.MAVLink_command_long_message(1, 1, 512, 0, 49.0, *(0.0,) * 6))  # GPS_GLOBAL_ORIGIN
        if self.origins and heard.at("GPS_RAW_INT") and now_s - self._hint_s > 4.0:  # the second one after the first
            self._hint_s = now_s
            place = (PLACE[0] + len(heard.hints) * 1000, PLACE[1])
            self._send(mavlink.MAVLink_command_int_message(1, 197, 0, EXTERNAL, 0, 0, 0, 0, 400, 0, *place, math.nan))
            self._send(mavlink.MAVLink_set_gps_global_origin_message(1, place[0] + 500, place[1], 0))
        return len(heard.hints) >= 4 and bool(self.acks) and bool(self.texts)

    def _send(self, message: Any) -> None:
        self._socket.sendto(message.pack(self._mav), self._firmware)

    def _listen(self) -> None:
        while True:
            try:
                data, self._firmware = self._socket.recvfrom(4096)
            except BlockingIOError:
                return
            for message in self._ear.parse_buffer(data) or []:
                kind = message.get_type()
                if kind == "COMMAND_ACK" and message.command == EXTERNAL:
                    self.acks.append((message.get_srcComponent(), message.result))
                elif kind == "STATUSTEXT" and message.get_srcComponent() == 197:
                    self.texts.append(message.text)
                elif kind == "GPS_GLOBAL_ORIGIN":
                    self.origins.add((message.latitude, message.longitude))

    def close(self) -> None:
        self._socket.close()


def test_fact_hints_pass_through_the_firmware_and_leave_its_origin_alone(tmp_path: Path) -> None:
    port, ground_port = free_port(), free_port()
    ground = GroundStation(ground_port)
    config = LinkSection(device=f"udpin:127.0.0.1:{port}")
    try:
        with copter(tmp_path, {"GPS1_TYPE": 14}, port, free_port(socket.SOCK_STREAM), ground_port):
            heard = stand(config, ground)
    finally:
        ground.close()
    radii = sorted({round(hint.radius_m) for hint in heard.hints})
    assert radii == [979, 5000], heard.texts  # the command with its accuracy, the origin without
    assert {hint.source for hint in heard.hints} == {"ground station 255"}
    assert set(ground.acks) == {(197, mavlink.MAV_RESULT_ACCEPTED)}  # ours; the firmware did not take it for itself
    assert len(ground.origins) == 1  # it kept the one that it had
    assert any(text.startswith("Terrafix: ") for text in ground.texts)
