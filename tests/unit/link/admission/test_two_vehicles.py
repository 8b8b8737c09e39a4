"""Two simulated autopilots behind one router, a standing one that is heard first and one that flies with the camera,
with the real edge, link node and estimator node on real sockets."""

import math
import select
import socket
import threading
import time

import msgspec
import numpy as np
import pytest

from link_rig import MS, covariance, estimate, texts
from simulated_flight import CAMERA, KEYFRAME_EVERY, ORIGIN, keyframe_of, some_features
from terrafix import messages as m
from terrafix.core.camera import Mount
from terrafix.core.config import LinkSection
from terrafix.core.geodesy import LocalFrame, rot_w_b
from terrafix.core.node import Node
from terrafix.estimator.node import EstimatorNode
from terrafix.link.edge import open_edge
from terrafix.link.node import LinkNode
from terrafix_lab.sim.autopilot.course import PeerState
from terrafix_lab.sim.autopilot.peer import AutopilotPeer
from terrafix_lab.sim.true_messages import first_odometry, odometry
from terrafix_tools.in_process import InProcessShell

pytestmark = pytest.mark.real_time

FRAME_S = 0.5
HEIGHT_M, SPEED_MPS = 100.0, 5.0
DECIDES_WITHIN_S = 60.0  # generous: after 12 s on an idle computer
SERVED_S = 3.0


class DatagramRouter:
    """Forwards each datagram of one port to all other senders there, as MAVProxy does."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self.port: int = self._socket.getsockname()[1]
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._forward, daemon=True)
        self._thread.start()

    def _forward(self) -> None:
        senders: set[tuple[str, int]] = set()
        while not self._stopping.is_set():
            if not select.select([self._socket], [], [], 0.05)[0]:
                continue
            packet, sender = self._socket.recvfrom(4096)
            senders.add(sender)
            for other in senders - {sender}:
                self._socket.sendto(packet, other)

    def stop(self) -> None:
        self._stopping.set()
        self._thread.join()
        self._socket.close()


def yaw_rad(t_s: float) -> float:
    """A course that swings by 60 degrees to each side every 4 s."""
    return math.radians(60.0) * math.sin(2.0 * math.pi * t_s / 8.0)


def flying(t_s: float) -> PeerState:
    lat, lon = LocalFrame(ORIGIN.lat_deg, ORIGIN.lon_deg).to_wgs84(0.0, SPEED_MPS * t_s)
    return PeerState(lat, lon, HEIGHT_M, HEIGHT_M, yaw_rad(t_s), 0.0, 0.0, SPEED_MPS, 0.0, 0.0)


def standing(_t_s: float) -> PeerState:
    return PeerState(ORIGIN.lat_deg, ORIGIN.lon_deg, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class FlyingCamera:
    """Odometry and estimates of the flying vehicle. ``clock_s``: seconds of the flight are ``zero_ns`` on the clock."""

    def __init__(self, zero_ns: int) -> None:
        self._zero_ns, self._frame, self._next_ns = zero_ns, 0, zero_ns
        self._views: list[tuple[np.ndarray, np.ndarray]] = []

    def due(self, now_ns: int) -> list[m.Message]:
        """-> messages of a new frame."""
        if now_ns < self._next_ns:
            return []
        self._next_ns, i, t_s = now_ns + round(FRAME_S * 1e9), self._frame, (now_ns - self._zero_ns) * 1e-9
        self._frame += 1
        r_w_c = rot_w_b(yaw_rad(t_s), 0.0, 0.0) @ Mount.of(CAMERA).r_b_c()
        self._views.append((r_w_c, np.array([0.0, SPEED_MPS * t_s, HEIGHT_M])))
        keyframe = keyframe_of(i)
        poses, rng = (self._views[keyframe], self._views[i]), np.random.default_rng(i)
        seen = odometry(now_ns, (keyframe, i), poses, rng, becomes_keyframe=i % KEYFRAME_EVERY == 0, xy=some_features())
        if not i:
            seen = first_odometry(now_ns)
        lat, lon = flying(t_s).lat_deg, flying(t_s).lon_deg
        velocity = (0.0, SPEED_MPS, 0.0)
        fix = estimate(now_ns, cov=covariance(3.0), lat_deg=lat, lon_deg=lon, velocity_enu_mps=velocity, late_ns=0)
        return [seen, fix]


class CameraFinder:
    """An estimator that says nothing but which vehicle has the camera."""

    def __init__(self, node: EstimatorNode) -> None:
        self._node, self.tick = node, node.tick

    def on(self, message: m.Message) -> list[m.Message]:
        return [x for x in self._node.on(message) if isinstance(x, m.CameraVehicle)]


@pytest.mark.slow
def test_of_two_vehicles_behind_one_router_the_one_with_the_camera_is_served() -> None:
    router, zero_s = DatagramRouter(), time.monotonic()
    peers = {sysid: AutopilotPeer(seed=sysid, sysid=sysid) for sysid in (1, 2)}
    edge = open_edge(LinkSection(device=f"udpout:127.0.0.1:{router.port}"))
    camera, published = FlyingCamera(round(zero_s * 1e9)), list[m.Message]()
    nodes: dict[str, Node] = {"link": LinkNode(10.0), "estimator": CameraFinder(EstimatorNode())}
    shell = InProcessShell(nodes, lambda _, message: published.append(message), edges={"link": edge})
    shell.feed(msgspec.structs.replace(ORIGIN, agl_sigma_m=5.0))

    def run(until_ns: int, *, decided: bool = False) -> None:
        while (now_ns := time.monotonic_ns()) < until_ns:
            for message in camera.due(now_ns):
                shell.feed(message)
            shell.step(now_ns)
            if decided and any(isinstance(x, m.CameraVehicle) for x in published):
                return
            time.sleep(0.002)

    peers[1].start(0, standing, lambda: time.monotonic() - zero_s, to=router.port)
    run(time.monotonic_ns() + 300 * MS)
    peers[2].start(0, flying, lambda: time.monotonic() - zero_s, to=router.port)
    run(time.monotonic_ns() + round(DECIDES_WITHIN_S * 1e9), decided=True)
    before_ns = time.monotonic_ns()
    (answer, *_) = [x for x in published if isinstance(x, m.CameraVehicle)]
    run(before_ns + round(SERVED_S * 1e9))
    reports = {sysid: peer.stop() for sysid, peer in peers.items()}
    edge.close()
    router.stop()

    assert answer.sysid == 2
    unclear_ns = next(x.t_ns for x in published if isinstance(x, m.ServedVehicle) and x.candidates)
    fixes = [x for x in published if isinstance(x, m.GpsInput) if x.fix_type == 3]
    assert not [x for x in fixes if unclear_ns < x.t_ns < before_ns]
    assert not [t_s for t_s in peers[2].received_s if unclear_ns < t_s * 1e9 < before_ns]
    assert [x for x in fixes if x.t_ns > before_ns] and peers[2].received_s[-1] * 1e9 > before_ns
    served = [x for x in published if isinstance(x, m.VehicleState) and x.t_ns > before_ns]
    assert served and all(abs((x.yaw_rad or 0.0) - yaw_rad(x.t_ns * 1e-9 - zero_s)) < 0.3 for x in served)
    assert "Terrafix: set link.autopilot_sysid = 2" in texts(published)
    assert "Terrafix: set link.autopilot_sysid = 2" in reports[2].status_texts
