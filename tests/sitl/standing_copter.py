"""What the tests on ArduPilot's firmware share: a copter that stands, and a Terrafix that says where."""

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
from terrafix.link.node import LinkNode
from terrafix_tools.sim.autopilot.parameters import Kind
from terrafix_tools.sim.sitl.firmware import BINARY_VARIABLE
from terrafix_tools.sim.sitl.setup import write_parameters

NAMED = os.environ.get(BINARY_VARIABLE, "")
BINARY = Path(NAMED).expanduser().with_name(Path(NAMED).name.replace("plane", "copter")) if NAMED else None

HOME = (48.0, 11.0, 500.0)
SENT = (48.001, 11.002, 501.0)  # 111 m north and 149 m east of home
WAIT_S = 90.0  # generous: the machine may be busy


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def copter(
    folder: Path, parameters: dict[str, float], companion: int, base: int, ground: int | None = None
) -> Iterator[None]:
    """The firmware on the ground; its SERIAL1 speaks to ``companion``, SERIAL0 to ``ground`` (None: nobody),
    SERIAL3 and 4 listen at ``base`` + 3 and 4."""
    if BINARY is None or not BINARY.is_file():
        pytest.skip(f"SITL MISSING: set {BINARY_VARIABLE} to an ArduPilot binary, docs/sitl.md says how to get one")
    write_parameters(folder / "vehicle.param", Kind.COPTER)
    (folder / "more.param").write_text("".join(f"{name},{value}\n" for name, value in parameters.items()))
    command = [str(BINARY), "--model", "quad", "--speedup", "1", "--rc-in-port", str(free_port())]
    command += ["--base-port", str(base), "--home", f"{HOME[0]},{HOME[1]},{HOME[2]},0"]
    command += ["--defaults", f"{folder / 'vehicle.param'},{folder / 'more.param'}"]
    for serial, target in ((0, ground or free_port()), (1, companion), (2, free_port())):
        command += [f"--serial{serial}", f"udpclient:127.0.0.1:{target}"]
    if "SERIAL4_PROTOCOL" in parameters:  # else SERIAL3 stays what it is: the simulated receiver
        command += ["--serial3", "tcp:3", "--serial4", "tcp:4"]
    with (folder / "console").open("wb") as console:
        process = subprocess.Popen(command, cwd=folder, stdin=subprocess.DEVNULL, stdout=console, stderr=console)
        try:
            yield
        finally:
            process.terminate()
            process.wait(10)


def standing(now_ns: int, place: tuple[float, float, float]) -> m.NavEstimate:
    cov = [0.0] * 36
    cov[0] = cov[7] = cov[14] = 16.0
    return m.NavEstimate(
        t_ns=now_ns,
        frame_id=now_ns,
        lat_deg=place[0],
        lon_deg=place[1],
        alt_amsl_m=place[2],
        agl_m=1.0,
        velocity_enu_mps=(0.0, 0.0, 0.0),
        velocity_sigma_mps=0.4,
        q_w_b=(1.0, 0.0, 0.0, 0.0),
        cov=tuple(cov),
        source_label=m.SourceLabel.SATELLITE_ANCHORED,
        covariance_mode=m.CovarianceMode.MARGINALS,
        last_anchor_age_ms=0,
        emitted_at_ns=now_ns,
    )


class Heard:
    """The newest message of each kind that the firmware said."""

    def __init__(self, edge: MavlinkEdge) -> None:
        self.newest: dict[str, Any] = {}
        self.texts: list[str] = []
        self.hints: list[m.PositionHint] = []
        self.send = edge._send  # orders to the firmware
        take = edge._take

        def listening(message: Any, now_ns: int) -> Iterator[m.Message]:
            self.newest[message.get_type()] = message
            if message.get_type() == "STATUSTEXT":
                self.texts.append(message.text)
            return take(message, now_ns)

        edge._take = listening  # type: ignore[method-assign]

    def at(self, kind: str) -> tuple[int, int] | None:
        message = self.newest.get(kind)
        return None if message is None else (message.lat, message.lon)


def stand(config: LinkSection, until: Callable[[Heard], bool], place: tuple[float, float, float] = SENT) -> Heard:
    """Estimates of a vehicle that stands at ``place``, through the real node and edge, until the firmware shows it."""
    edge, node = open_edge(config), LinkNode(10.0, config.gnss)
    heard = Heard(edge)
    camera = m.Camera(width=1, height=1, fx=1, fy=1, cx=0, cy=0)
    sigmas = {"start_sigma_m": 5.0, "yaw_sigma_deg": 5.0, "agl_sigma_m": 5.0, "attitude_sigma_deg": 2.0}
    edge.heard(m.Origin(t_ns=0, camera=camera, lat_deg=HOME[0], lon_deg=HOME[1], ground_amsl_m=HOME[2], **sigmas))
    began, next_estimate_ns, next_tick_ns = time.monotonic(), 0, 0
    try:
        while time.monotonic() - began < WAIT_S and not until(heard):
            now_ns = time.monotonic_ns()
            for message in edge.poll(now_ns):
                heard.hints += [message] if isinstance(message, m.PositionHint) else []
                for said in node.on(message):
                    edge.heard(said)
            if now_ns >= next_estimate_ns:
                next_estimate_ns = now_ns + 400_000_000
                node.on(standing(now_ns, place))
            if now_ns >= next_tick_ns:
                next_tick_ns = now_ns + 20_000_000
                for said in node.tick(now_ns):
                    edge.heard(said)
            time.sleep(0.002)
    finally:
        edge.close()
    return heard
