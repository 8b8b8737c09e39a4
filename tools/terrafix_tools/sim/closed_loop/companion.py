"""The onboard computer in lock-step: the real nodes and the real MAVLink edge, with a clock that is given.

The time that vision and anchor take is modelled and constant, whatever this machine needs: the same flight gives the
same result, and estimates are as late for the autopilot as in the air."""

import importlib
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from terrafix.core.frames import MemoryFrameStore
from terrafix.core.node import Image, Node, NodeContext
from terrafix.link.edge import MavlinkEdge
from terrafix.link.mavlink.transport import Transport
from terrafix.messages import (
    Frame,
    GpsInput,
    Message,
    NavEstimate,
    Origin,
    PositionSource,
    Prediction,
    SourceEnded,
    StatusText,
    TemperatureZone,
    ThermalReading,
)
from terrafix.processes import PROCESSES
from terrafix.runtime.executor import InProcessShell

ALL = ("vision", "anchor", "estimator", "link", "health")
HEALTH_NS = 1_000_000_000
COOL_C = 50.0
UNIX_NS_AT_ZERO = 1_782_900_000 * 1_000_000_000  # 2026-07-01: the simulated computer has a clock
Hear = Callable[[list[Message]], None]


@dataclass(frozen=True)
class Delays:
    """How long the computer takes, seconds; of the order of a Jetson Orin Nano."""

    vision_s: float = 0.05  # from the exposure to the estimate by odometry
    anchor_s: float = 0.20  # from there to the estimate by the map


class Slow:
    """A node whose answers come later. What arrives while it works waits, and only the newest of it
    (runtime/inbox.py)."""

    def __init__(self, node: Node, delay_ns: int) -> None:
        self._node, self._delay_ns = node, delay_ns
        self._waiting: Prediction | None = None
        self._answers: list[Message] = []
        self._done_ns: int | None = None
        self.now_ns = 0
        self.skipped = 0

    def on(self, message: Message) -> Iterable[Message]:
        if not isinstance(message, Prediction):
            return list(self._node.on(message))
        self.skipped += self._waiting is not None
        self._waiting = message
        self._begin()
        return []

    def tick(self, now_ns: int) -> Iterable[Message]:
        return ()

    def answers(self) -> list[Message]:
        """What is ready at ``now_ns``."""
        if self._done_ns is None or self.now_ns < self._done_ns:
            return []
        ready, self._answers, self._done_ns = self._answers, [], None
        self._begin()
        return ready

    def hurry(self) -> None:
        """The work in hand is done now."""
        if self._done_ns is not None:
            self._done_ns = self.now_ns

    def _begin(self) -> None:
        if self._done_ns is None and self._waiting is not None:
            message, self._waiting = self._waiting, None
            self._answers, self._done_ns = list(self._node.on(message)), self.now_ns + self._delay_ns


class Companion:
    """``step`` at every step of the flight, ``expose`` for every frame, ``end`` once."""

    def __init__(
        self, ctx: NodeContext, frames: MemoryFrameStore, transport: Transport, delays: Delays, hear: Hear
    ) -> None:
        """``hear`` gets everything that is said. The computer's clock is 0 at the start of the flight."""
        made: dict[str, Node] = {
            p.name: importlib.import_module(p.module).make_node(ctx) for p in PROCESSES if p.name in ALL
        }
        self._link = made["link"]
        self._anchor = Slow(made["anchor"], round(delays.anchor_s * 1e9))
        self._shell = InProcessShell({**made, "anchor": self._anchor}, self._sink)
        self._frames, self._hear = frames, hear
        self._edge = MavlinkEdge(ctx.config.link, transport, lambda: UNIX_NS_AT_ZERO + self._now_ns)
        self._vision_ns = round(delays.vision_s * 1e9)
        self._queue: deque[Frame] = deque()
        self._heard: list[Message] = []
        self._now_ns = 0
        self._health_ns = 0
        self._count = 0
        self.temperature_c: Callable[[float], float] = lambda _: COOL_C  # of the computer, at seconds of the flight
        self.said_ns: dict[int, int] = {}  # frame id -> when its last estimate was said

    @property
    def skipped(self) -> int:
        """Predictions that the anchor was too busy for."""
        return self._anchor.skipped

    def begin(self, origin: Origin) -> None:
        self._shell.feed(origin)
        self._flush()

    def expose(self, frame: Frame, image: Image | None) -> None:
        """A picture was taken now; it is worked on when vision has had its time."""
        if image is not None:
            self._frames.put(frame.frame_id, image)
        self._queue.append(frame)
        self._count += 1

    def step(self, now_ns: int) -> None:
        self._now_ns = self._anchor.now_ns = now_ns
        for message in self._edge.poll(now_ns):
            self._shell.feed(message)
            for answer in self._link.on(message):  # the edge's words reach the node of its own process too
                self._shell.feed(answer)
        while self._queue and now_ns - self._queue[0].t_ns >= self._vision_ns:
            self._shell.feed(self._queue.popleft())
        for message in self._anchor.answers():
            self._shell.feed(message)
        if now_ns >= self._health_ns:
            self._health_ns += HEALTH_NS
            zones = [TemperatureZone(name="cpu", temperature_c=self.temperature_c(now_ns * 1e-9))]
            self._shell.feed(ThermalReading(t_ns=now_ns, zones=zones, throttling=[], disk_free_mb=None))
        self._shell.tick(now_ns)
        self._flush()

    def end(self) -> None:
        """The camera has stopped: what is under way is finished, and the flight is refined."""
        while self._queue:
            self._shell.feed(self._queue.popleft())
        self._anchor.hurry()
        for message in self._anchor.answers():
            self._shell.feed(message)
        self._shell.feed(SourceEnded(t_ns=self._now_ns, frames=self._count))
        self._edge.close()
        self._flush()

    def _sink(self, _who: str, message: Message) -> None:
        self._heard.append(message)
        if isinstance(message, GpsInput | PositionSource | StatusText):
            self._edge.heard(message)
        elif isinstance(message, NavEstimate):
            self.said_ns[message.frame_id] = self._now_ns

    def _flush(self) -> None:
        heard, self._heard = self._heard, []
        self._hear(heard)
