"""Edge and node of the link at the simulated autopilot, with estimates that are the truth and a chosen accuracy."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from autopilot_rig import FRAME, Rig
from link_rig import LinkRun, S, estimate
from link_wire import MemoryWire
from terrafix import messages as m
from terrafix.core.config import Config, LinkSection
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.node import NodeContext
from terrafix.link.edge import MavlinkEdge
from terrafix.link.gnss.previous_source import PreviousSourceFile
from terrafix.link.mavlink.transport import Address
from terrafix.link.node import make_node

STEP_S = 0.02
ESTIMATES_EVERY = 25  # steps


class RigWire(MemoryWire):
    """Connects the real edge with the simulated autopilot; the rig reads the autopilot's packets too."""

    def __init__(self, rig: Rig) -> None:
        super().__init__()
        self._rig, transmit = rig, rig.autopilot.transmit

        def tapped() -> bytes:
            packets = transmit()
            self.arrive(packets)
            return packets

        rig.autopilot.transmit = tapped  # type: ignore[method-assign]

    def write(self, packet: bytes, to: Address | None = None) -> bool:
        self._rig.autopilot.receive(packet, self._rig.t_s)
        return True

    def read(self) -> list[Any]:
        self._rig.autopilot.transmit()
        return super().read()


class Companion:
    """``fly`` runs the vehicle and the link; ``start`` is a new process of the link, whose earlier one was killed."""

    def __init__(self, rig: Rig, link: LinkSection, folder: Path) -> None:
        self.rig, self.folder = rig, folder
        self.published: list[m.Message] = []
        self.start(link)

    def start(self, link: LinkSection) -> None:
        self.edge = MavlinkEdge(link, RigWire(self.rig), lambda: 0, previous_source=PreviousSourceFile(self.folder))
        context = NodeContext(Config(link=link), MemoryFrameStore(), None, self.folder, state_dir=self.folder)
        self.run = LinkRun(make_node(context), self.edge)

    def fly(
        self,
        until_s: float,
        sigma_m: Callable[[float], float | None] = lambda _: 1.5,
        *,
        until: Callable[[], bool] = lambda: False,
    ) -> None:
        """``sigma_m``: of the estimate at a time [s]; None: there is none. ``until``: ends it early when it is true."""
        while self.rig.t_s < until_s and not until():
            self.rig.fly(STEP_S)
            now_ns = round(self.rig.t_s * S)
            self.run.shell.poll(now_ns)
            if round(self.rig.t_s / STEP_S) % ESTIMATES_EVERY == 0 and (sigma := sigma_m(self.rig.t_s)) is not None:
                self.run.feed([self._estimate(now_ns, sigma)])
            self.run.shell.tick(now_ns)
            self.published += self.run.published
            self.run.published.clear()

    def _estimate(self, now_ns: int, sigma_m: float) -> m.NavEstimate:
        lat, lon = FRAME.to_wgs84(*self.rig.truth(self.rig.t_s)[:2])
        velocity = tuple(float(v) for v in self.rig.velocity)
        here = estimate(now_ns, late_ns=0, velocity_enu_mps=velocity, sigma_m=sigma_m)
        return msgspec.structs.replace(here, lat_deg=lat, lon_deg=lon)
