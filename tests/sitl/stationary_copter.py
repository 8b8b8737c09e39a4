"""Rig of the SITL tests: ArduPilot's firmware as a copter on the ground, and a Terrafix link that sends it estimates of
a stationary vehicle."""

import os
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from terrafix import messages as m
from terrafix.core.config import LinkSection
from terrafix.link.edge import MavlinkEdge, open_edge
from terrafix.link.mavlink.transport import Address
from terrafix.link.node import LinkNode
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.sitl.firmware import BINARY_VARIABLE
from terrafix_lab.sim.sitl.setup import write_parameters
from terrafix_lab.sim.true_messages import estimate
from terrafix_tools.in_process import InProcessShell

_SETTING = os.environ.get(BINARY_VARIABLE, "")
# The variable may name the plane's binary; the copter's is in the same folder.
BINARY = Path(_SETTING).expanduser().with_name(Path(_SETTING).name.replace("plane", "copter")) if _SETTING else None

HOME = (48.0, 11.0, 500.0)  # latitude, longitude [deg], AMSL [m]
SENT = (48.001, 11.002, 501.0)  # 111 m north and 149 m east of home
WAIT_S = 90.0  # time-out; long, because the machine may be busy


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def copter(
    folder: Path, parameters: dict[str, float], companion: int, base: int, ground: int | None = None
) -> Iterator[None]:
    """Runs the firmware with the vehicle on the ground; skips the test if there is no binary.

    UDP ports on 127.0.0.1: SERIAL1 sends to ``companion``, SERIAL0 to ``ground`` (None: to an unused port). TCP:
    SERIAL3 and SERIAL4 listen at ``base`` + 3 and ``base`` + 4 if SERIAL4_PROTOCOL is among the parameters."""
    if BINARY is None or not BINARY.is_file():
        pytest.skip(f"SITL MISSING: set {BINARY_VARIABLE} to an ArduPilot binary (see docs/sitl.md)")
    write_parameters(folder / "vehicle.param", Kind.COPTER)
    (folder / "more.param").write_text("".join(f"{name},{value}\n" for name, value in parameters.items()))
    command = [str(BINARY), "--model", "quad", "--speedup", "1", "--rc-in-port", str(free_port())]
    command += ["--base-port", str(base), "--home", f"{HOME[0]},{HOME[1]},{HOME[2]},0"]
    command += ["--defaults", f"{folder / 'vehicle.param'},{folder / 'more.param'}"]
    for serial, target in ((0, ground or free_port()), (1, companion), (2, free_port())):
        command += [f"--serial{serial}", f"udpclient:127.0.0.1:{target}"]
    if "SERIAL4_PROTOCOL" in parameters:  # otherwise SERIAL3 remains the simulated receiver
        command += ["--serial3", "tcp:3", "--serial4", "tcp:4"]
    with (folder / "console").open("wb") as console:
        process = subprocess.Popen(command, cwd=folder, stdin=subprocess.DEVNULL, stdout=console, stderr=console)
        try:
            yield
        finally:
            process.terminate()
            process.wait(10)


def stationary_estimate(t_ns: int, place: tuple[float, float, float]) -> m.NavEstimate:
    """Estimate of a stationary, level vehicle. ``place``: latitude, longitude [deg], AMSL [m]; 4 m 1-sigma per axis."""
    lat_deg, lon_deg, amsl_m = place
    return estimate(
        t_ns,
        lat_deg,
        lon_deg,
        sigmas=(4.0, 4.0, 0.0),
        frame_id=t_ns,
        alt_amsl_m=amsl_m,
        agl_m=1.0,
        velocity_sigma_mps=0.4,
    )


class ReceivedMessages:
    """Records what an edge receives. ``newest``: the newest MAVLink message of each type; ``texts``: all STATUSTEXT;
    ``hints``: the PositionHints that the edge has published. ``send(message)`` sends to the firmware."""

    def __init__(self, edge: MavlinkEdge) -> None:
        self.newest: dict[str, Any] = {}
        self.texts: list[str] = []
        self.hints: list[m.PositionHint] = []
        self.send = edge._send
        process_packet = edge._on_packet

        def record_packet(message: Any, sender: Address | None, now_ns: int) -> Iterator[m.Message]:
            self.newest[message.get_type()] = message
            if message.get_type() == "STATUSTEXT":
                self.texts.append(message.text)
            return process_packet(message, sender, now_ns)

        edge._on_packet = record_packet  # type: ignore[method-assign]

    def position_e7(self, kind: str) -> tuple[int, int] | None:
        """-> latitude and longitude [1e-7 deg] of the newest message of a type; None: none was received."""
        message = self.newest.get(kind)
        return None if message is None else (message.lat, message.lon)


def run_link(
    config: LinkSection, is_done: Callable[[ReceivedMessages], bool], place: tuple[float, float, float] = SENT
) -> ReceivedMessages:
    """Runs the real edge and node with estimates of a vehicle that is stationary at ``place`` (latitude, longitude
    [deg], AMSL [m]), at 2.5 Hz, until ``is_done`` or for WAIT_S. -> what was received."""
    edge = open_edge(config)
    received = ReceivedMessages(edge)

    def take(_publisher: str, message: m.Message) -> None:
        received.hints += [message] if isinstance(message, m.PositionHint) else []

    shell = InProcessShell({"link": LinkNode(10.0, config.gnss)}, take, edges={"link": edge})
    camera = m.Camera(width=1, height=1, fx=1, fy=1, cx=0, cy=0)
    sigmas = {"start_sigma_m": 5.0, "yaw_sigma_deg": 5.0, "agl_sigma_m": 5.0, "attitude_sigma_deg": 2.0}
    shell.feed(m.Origin(t_ns=0, camera=camera, lat_deg=HOME[0], lon_deg=HOME[1], ground_amsl_m=HOME[2], **sigmas))
    began_s, next_estimate_ns = time.monotonic(), 0
    try:
        while time.monotonic() - began_s < WAIT_S and not is_done(received):
            now_ns = time.monotonic_ns()
            shell.poll(now_ns)
            if now_ns >= next_estimate_ns:
                next_estimate_ns = now_ns + 400_000_000
                shell.feed(stationary_estimate(now_ns, place))
            shell.tick(now_ns)
            time.sleep(0.002)
    finally:
        edge.close()
    return received
