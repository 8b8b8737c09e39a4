"""Initial position from the GNSS receiver of ArduPilot's firmware (SITL), on the ground, without a configured start."""

import socket
import time
from collections.abc import Iterable
from pathlib import Path

import pytest
from stationary_copter import HOME, WAIT_S, copter, free_port

from terrafix import messages as m
from terrafix.anchor.node import AnchorNode
from terrafix.core.config import LinkSection
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.geodesy import LocalFrame
from terrafix.estimator.node import EstimatorNode
from terrafix.link.edge import open_edge
from terrafix.link.node import LinkNode
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_tools.in_process import InProcessShell

pytestmark = pytest.mark.slow
AWAY_M = (700.0, -400.0)  # home, east and north of the Origin


def test_fact_the_initial_position_is_that_of_the_firmwares_receiver(tmp_path: Path) -> None:
    port = free_port()
    with copter(tmp_path, {}, port, free_port(socket.SOCK_STREAM)):
        published = run_processes(port)
    starts = [x for x in published if isinstance(x, m.InitialPosition)]
    estimates = [x for x in published if isinstance(x, m.NavEstimate)]
    texts = [x.text for x in published if isinstance(x, m.StatusText)]
    assert starts, texts
    assert [text for text in texts if "start" in text] == ["Terrafix: start from GNSS, 2 m"]
    frame = LocalFrame(HOME[0], HOME[1])
    assert min(x.cov[0] for x in estimates if x.t_ns < starts[0].t_ns) > 1900.0**2
    east_m, north_m = frame.to_local(estimates[-1].lat_deg, estimates[-1].lon_deg)
    assert max(abs(east_m), abs(north_m)) < 3.0 and estimates[-1].cov[0] < 3.0**2
    assert any(x.fix_type == 3 for x in published if isinstance(x, m.GpsInput))


def run_processes(port: int) -> list[m.Message]:
    """Runs link, anchor and estimator until 30 GpsInput have a 3D fix, at most WAIT_S -> what they published."""
    edge, link = open_edge(LinkSection(device=f"udpin:127.0.0.1:{port}", gps_id=1)), LinkNode(10.0)
    anchor = AnchorNode(MemoryFrameStore(1), None, GradientDescriber(), 10.0)
    published: list[m.Message] = []

    def sink(_process: str, message: m.Message) -> None:
        published.append(message)
        edge.on_message(message)

    shell = InProcessShell({"link": link, "anchor": anchor, "estimator": EstimatorNode()}, sink)
    shell.feed(origin())
    began_s, next_ns, frame_id = time.monotonic(), 0, 0
    try:
        while time.monotonic() - began_s < WAIT_S and fixes(published) < 30:
            now_ns = time.monotonic_ns()
            for message in edge.poll(now_ns):
                for reply in link.on(message):  # messages of the edge also reach the node of its own process
                    shell.feed(reply)
                shell.feed(message)
            if now_ns >= next_ns:
                next_ns, frame_id = now_ns + 500_000_000, frame_id + 1
                shell.feed(
                    m.Odometry(t_ns=now_ns, frame_id=frame_id, keyframe_id=frame_id, verdict=m.Verdict.NO_FEATURES)
                )
            shell.tick(now_ns)
            time.sleep(0.002)
    finally:
        edge.close()
    return published


def fixes(messages: Iterable[m.Message]) -> int:
    """-> number of GpsInput with a 3D fix."""
    return sum(isinstance(x, m.GpsInput) and x.fix_type == 3 for x in messages)


def origin() -> m.Origin:
    """Origin of a map of 4 km whose centre is AWAY_M from home."""
    lat_deg, lon_deg = LocalFrame(HOME[0], HOME[1]).to_wgs84(-AWAY_M[0], -AWAY_M[1])
    camera = m.Camera(width=640, height=480, fx=500, fy=500, cx=320, cy=240)
    sigmas = {"start_sigma_m": 2000.0, "yaw_sigma_deg": 5.0, "agl_sigma_m": 5.0, "attitude_sigma_deg": 2.0}
    return m.Origin(t_ns=0, camera=camera, lat_deg=lat_deg, lon_deg=lon_deg, ground_amsl_m=HOME[2], **sigmas)
