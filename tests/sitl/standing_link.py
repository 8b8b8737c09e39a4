"""A Terrafix that is one process: the real edge and node, and estimates as good as the simulator's truth.

For tests that kill it: ``python standing_link.py PORT``. With its first 3D fix it says when that was, on the monotonic
clock, and what of a processor it had taken until then."""

import sys
import time
from collections.abc import Iterator
from typing import Any

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from standing_copter import standing

from terrafix.core.config import LinkSection
from terrafix.link.edge import open_edge
from terrafix.link.node import LinkNode
from terrafix.messages import GpsInput, Message, NavEstimate

ESTIMATE_NS, TICK_NS = 400_000_000, 20_000_000
TRUTH_US = 50_000.0
ASK_NS = 500_000_000


def main(port: str) -> None:
    edge, node = open_edge(LinkSection(device=f"udpin:127.0.0.1:{port}")), LinkNode(10.0)
    take = edge._take
    seen: list[NavEstimate] = []
    first = True
    due = {"ask": 0, "estimate": 0, "tick": 0}

    def watching(message: Any, now_ns: int) -> Iterator[Message]:
        if message.get_type() == "SIM_STATE":
            place = message.lat_int / 1e7, message.lon_int / 1e7, message.alt
            velocity = message.ve, message.vn, -message.vd
            seen[:] = [msgspec.structs.replace(standing(now_ns, place), velocity_enu_mps=velocity)]
        return take(message, now_ns)

    def is_due(what: str, now_ns: int, period_ns: int) -> bool:
        if now_ns < due[what]:
            return False
        due[what] = now_ns + period_ns
        return True

    edge._take = watching  # type: ignore[method-assign]
    while True:
        now_ns = time.monotonic_ns()
        for message in edge.poll(now_ns):
            for said in node.on(message):
                edge.heard(said)
        if not seen and is_due("ask", now_ns, ASK_NS):
            interval, no = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, (0.0,) * 5
            wanted = float(mavlink.MAVLINK_MSG_ID_SIM_STATE), TRUTH_US
            edge._send(mavlink.MAVLink_command_long_message(1, 1, interval, 0, *wanted, *no))
        if seen and is_due("estimate", now_ns, ESTIMATE_NS):
            node.on(seen[0])
        if is_due("tick", now_ns, TICK_NS):
            for said in node.tick(now_ns):
                edge.heard(said)
                if first and isinstance(said, GpsInput) and said.fix_type == 3:
                    first = False
                    sys.stdout.write(f"fix {time.monotonic()} {time.process_time()}\n")
                    sys.stdout.flush()
        time.sleep(0.002)


if __name__ == "__main__":
    main(sys.argv[1])
