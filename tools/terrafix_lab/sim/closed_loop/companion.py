"""The companion computer in lock-step: the flight's nodes and MAVLink edge, driven by a simulated clock.

The processing times of vision and anchor are modelled as constants, independent of this machine: the same flight gives
the same result, and the autopilot receives estimates with the delay of a real flight.
"""

import importlib
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from terrafix.core.frames import MemoryFrameStore
from terrafix.core.node import Image, Node, NodeBase, NodeContext
from terrafix.link.edge import MavlinkEdge
from terrafix.link.mavlink.transport import Transport
from terrafix.messages import (
    Frame,
    Message,
    NavEstimate,
    Origin,
    Prediction,
    SourceEnded,
    TemperatureZone,
    ThermalReading,
)
from terrafix.processes import PROCESSES
from terrafix_tools.in_process import InProcessShell

PROCESS_NAMES = ("vision", "anchor", "estimator", "smoother", "link", "health")
HEALTH_NS = 1_000_000_000
COOL_C = 50.0
UNIX_NS_AT_ZERO = 1_782_900_000 * 1_000_000_000  # 2026-07-01: the simulated computer has a wall clock
OnMessages = Callable[[list[Message]], None]


@dataclass(frozen=True)
class Delays:
    """Processing times of the computer, seconds; of the order of a Jetson Orin Nano."""

    vision_s: float = 0.05  # from the exposure to the odometry estimate
    anchor_s: float = 0.20  # from there to the estimate with the map match


class DelayedNode(NodeBase):
    """A node whose outputs are delayed. Of the predictions that arrive while it is busy only the newest is processed,
    as in runtime/inbox.py.
    """

    def __init__(self, node: Node, delay_ns: int) -> None:
        self._node, self._delay_ns = node, delay_ns
        self._waiting: Prediction | None = None
        self._outputs: list[Message] = []
        self._done_ns: int | None = None
        self.now_ns = 0
        self.skipped = 0

    def on(self, message: Message) -> Iterable[Message]:
        if not isinstance(message, Prediction):
            return list(self._node.on(message))
        self.skipped += self._waiting is not None
        self._waiting = message
        self._start_next()
        return []

    def ready_outputs(self) -> list[Message]:
        """Returns the outputs that are ready at ``now_ns``."""
        if self._done_ns is None or self.now_ns < self._done_ns:
            return []
        ready, self._outputs, self._done_ns = self._outputs, [], None
        self._start_next()
        return ready

    def finish_now(self) -> None:
        """Completes the current work immediately."""
        if self._done_ns is not None:
            self._done_ns = self.now_ns

    def _start_next(self) -> None:
        if self._done_ns is None and self._waiting is not None:
            message, self._waiting = self._waiting, None
            self._outputs, self._done_ns = list(self._node.on(message)), self.now_ns + self._delay_ns


class Companion:
    """Interface: ``step`` at every step of the flight, ``expose`` for every frame, ``end`` once."""

    def __init__(
        self, ctx: NodeContext, frames: MemoryFrameStore, transport: Transport, delays: Delays, on_messages: OnMessages
    ) -> None:
        """``on_messages`` receives all published messages. The computer's clock is 0 at the start of the flight."""
        nodes: dict[str, Node] = {
            p.name: importlib.import_module(p.module).make_node(ctx) for p in PROCESSES if p.name in PROCESS_NAMES
        }
        self._anchor = DelayedNode(nodes["anchor"], round(delays.anchor_s * 1e9))
        self._edge = MavlinkEdge(ctx.config.link, transport, lambda: UNIX_NS_AT_ZERO + self._now_ns)
        self._shell = InProcessShell({**nodes, "anchor": self._anchor}, self._sink, edges={"link": self._edge})
        self._frames, self._on_messages = frames, on_messages
        self._vision_ns = round(delays.vision_s * 1e9)
        self._queue: deque[Frame] = deque()
        self._published: list[Message] = []
        self._now_ns = 0
        self._health_ns = 0
        self._count = 0
        self.temperature_c: Callable[[float], float] = lambda _: COOL_C  # of the computer, by seconds of the flight
        self.estimated_ns: dict[int, int] = {}  # frame id -> time at which its last estimate was published

    @property
    def skipped(self) -> int:
        """Number of predictions that arrived while the anchor was busy and were dropped."""
        return self._anchor.skipped

    def start(self, origin: Origin) -> None:
        self._shell.feed(origin)
        self._flush()

    def expose(self, frame: Frame, image: Image | None) -> None:
        """Adds an image taken now; it is processed after the delay of vision."""
        if image is not None:
            self._frames.put(frame.frame_id, image)
        self._queue.append(frame)
        self._count += 1

    def step(self, now_ns: int) -> None:
        self._now_ns = self._anchor.now_ns = now_ns
        self._shell.poll(now_ns)
        while self._queue and now_ns - self._queue[0].t_ns >= self._vision_ns:
            self._shell.feed(self._queue.popleft())
        for message in self._anchor.ready_outputs():
            self._shell.feed(message)
        if now_ns >= self._health_ns:
            self._health_ns += HEALTH_NS
            zones = [TemperatureZone(name="cpu", temperature_c=self.temperature_c(now_ns * 1e-9))]
            self._shell.feed(ThermalReading(t_ns=now_ns, zones=zones, throttling=[], disk_free_mb=None))
        self._shell.tick(now_ns)
        self._flush()

    def end(self) -> None:
        """After the last frame: finishes pending work, and lets the nodes refine the flight."""
        while self._queue:
            self._shell.feed(self._queue.popleft())
        self._anchor.finish_now()
        for message in self._anchor.ready_outputs():
            self._shell.feed(message)
        self._shell.feed(SourceEnded(t_ns=self._now_ns, frames=self._count))
        self._edge.close()
        self._flush()

    def _sink(self, _who: str, message: Message) -> None:
        self._published.append(message)
        if isinstance(message, NavEstimate):
            self.estimated_ns[message.frame_id] = self._now_ns

    def _flush(self) -> None:
        published, self._published = self._published, []
        self._on_messages(published)
