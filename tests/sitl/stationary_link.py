"""The link of Terrafix as one program, for tests that kill it: ``python stationary_link.py PORT``.

It runs the real edge and node. The estimates have the simulator's true position and velocity (SIM_STATE), at 2.5 Hz.
With the first 3D fix it prints ``fix MONOTONIC_S CPU_S``: the time of the monotonic clock, and its processor time."""

import sys
import time
from collections.abc import Iterator
from typing import Any

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from stationary_copter import stationary_estimate

from terrafix.core.config import LinkSection
from terrafix.link.edge import open_edge
from terrafix.link.mavlink.transport import Address
from terrafix.link.node import LinkNode
from terrafix.messages import GpsInput, Message, NavEstimate
from terrafix_tools.in_process import InProcessShell

ESTIMATE_NS = 400_000_000
SIM_STATE_INTERVAL_US = 50_000.0
REQUEST_NS = 500_000_000  # SIM_STATE is requested at this period until it arrives


def main(port: str) -> None:
    edge = open_edge(LinkSection(device=f"udpin:127.0.0.1:{port}"))
    process_packet = edge._on_packet
    newest: list[NavEstimate] = []  # at most one: from the newest SIM_STATE
    fixed: list[GpsInput] = []  # the first with a 3D fix
    due_ns = {"request": 0, "estimate": 0}

    def record_packet(message: Any, sender: Address | None, now_ns: int) -> Iterator[Message]:
        if message.get_type() == "SIM_STATE":
            place = message.lat_int / 1e7, message.lon_int / 1e7, message.alt
            velocity_enu_mps = message.ve, message.vn, -message.vd
            estimate = stationary_estimate(now_ns, place)
            newest[:] = [msgspec.structs.replace(estimate, velocity_enu_mps=velocity_enu_mps)]
        return process_packet(message, sender, now_ns)

    def is_due(task: str, now_ns: int, period_ns: int) -> bool:
        if now_ns < due_ns[task]:
            return False
        due_ns[task] = now_ns + period_ns
        return True

    def report_first_fix(_publisher: str, message: Message) -> None:
        if not fixed and isinstance(message, GpsInput) and message.fix_type == 3:
            fixed.append(message)
            sys.stdout.write(f"fix {time.monotonic()} {time.process_time()}\n")
            sys.stdout.flush()

    edge._on_packet = record_packet  # type: ignore[method-assign]
    shell = InProcessShell({"link": LinkNode(10.0)}, report_first_fix, edges={"link": edge})
    while True:
        now_ns = time.monotonic_ns()
        shell.poll(now_ns)
        if not newest and is_due("request", now_ns, REQUEST_NS):
            command, unused = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, (0.0,) * 5
            params = float(mavlink.MAVLINK_MSG_ID_SIM_STATE), SIM_STATE_INTERVAL_US
            edge._send(mavlink.MAVLink_command_long_message(1, 1, command, 0, *params, *unused))
        if newest and is_due("estimate", now_ns, ESTIMATE_NS):
            shell.feed(newest[0])
        shell.tick(now_ns)
        time.sleep(0.002)


if __name__ == "__main__":
    main(sys.argv[1])
