"""The runs whose messages are compared: recorded flights, simulated ones, a restart in flight, the link, finalise.

A case takes the data folder and a working folder and returns its digests. All are deterministic on one computer with
one thread for linear algebra (``one.py`` and ``__main__.py`` set that); another processor may round differently.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.node import Edge, Node, NodeContext
from terrafix.estimator.node import EstimatorNode
from terrafix.estimator.prior import CheckpointWriter
from terrafix.link.node import TICK_HZ, LinkNode
from terrafix.link.output.gps_input import encode
from terrafix.messages import (
    CalibrationFault,
    GpsInput,
    Message,
    NavEstimate,
    Odometry,
    Origin,
    SearchState,
    VehicleState,
    WallClock,
)
from terrafix.recorder.reader import read_flight
from terrafix_lab.golden.digest import Digest, Digests
from terrafix_lab.montecarlo.flight import Run
from terrafix_lab.montecarlo.plan import plan
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.flights import make as making
from terrafix_tools.finalise.run import finalise
from terrafix_tools.finalised import TABLE
from terrafix_tools.in_process import InProcessShell
from terrafix_tools.replay import MakeNodes, make_nodes, replay

VILLAGE, TOWN = "flights/village-1", "flights/town-a"
SIMULATED_S = 60.0
MONTECARLO_SEED, MONTECARLO_FLIGHTS, MONTECARLO_S = 3, 12, 120.0
RESTARTED_AT = 40  # frame id of the simulated flight after which the estimator runs in a new process
UNIX_NS = 1_750_000_000_000_000_000  # wall clock of the link: any time for which GPS week and leap seconds are known

DigestsOf = Callable[[Path, Path], dict[str, Digest]]  # (data folder, working folder) -> digests


@dataclass(frozen=True)
class GoldenCase:
    """``needs``: required files of the data folder."""

    name: str
    digests: DigestsOf
    needs: tuple[str, ...] = ()


def record_digests(folder: Path) -> Digests:
    digests = Digests()
    for _, _, message in read_flight(folder):
        digests.take(message)
    return digests


def _replayed(flight: str, map_name: str, models: tuple[str, ...] = ()) -> DigestsOf:
    def digests(data: Path, work: Path) -> dict[str, Digest]:
        wanted = [f"{name}={data / path}" for name, path in (model.split("=") for model in models)]
        replay(data / flight, data / map_name, work / "out", models=wanted)
        return record_digests(work / "out").result()

    return digests


def _fly(work: Path, kind: Kind, seed: int, nodes: MakeNodes = make_nodes) -> Path:
    """Simulates and replays a flight; returns the folder of the replay."""
    making.make(work / "flight", making.FlightOptions(seed=seed, vehicle=kind, duration_s=SIMULATED_S), progress=False)
    replay(work / "flight", None, work / "out", nodes=nodes)
    return work / "out"


def _simulated(kind: Kind, seed: int, nodes: MakeNodes = make_nodes) -> DigestsOf:
    def digests(_: Path, work: Path) -> dict[str, Digest]:
        return record_digests(_fly(work, kind, seed, nodes)).result()

    return digests


def montecarlo(_: Path, __: Path) -> dict[str, Digest]:
    """Digests of every message that the estimator publishes in a round of simulated flights."""
    digests = Digests()
    for number in range(MONTECARLO_FLIGHTS):
        drawn = plan(MONTECARLO_SEED, number, fault=None, duration_s=MONTECARLO_S, lie_share=0.05)
        Run(drawn, _DigestedEstimator(digests)).record(refine=True)
    return digests.result()


class _DigestedEstimator(EstimatorNode):
    def __init__(self, digests: Digests) -> None:
        super().__init__()
        self._digests = digests

    def on(self, message: Message) -> list[Message]:
        published = list(super().on(message))
        for one in published:
            self._digests.take(one)
        return published


class RestartedEstimator:
    """The estimator node, replaced at frame ``at`` by a new one that starts from the checkpoint of the first."""

    def __init__(self, ctx: NodeContext, node: Node, at: int) -> None:
        self._ctx, self._node, self._at = ctx, node, at
        self._file = ctx.out_dir / "checkpoint"
        self._edge: Edge = CheckpointWriter(self._file)
        self._origin: Origin | None = None

    def on(self, message: Message) -> Iterable[Message]:
        if isinstance(message, Origin):
            self._origin = message
        if isinstance(message, Odometry) and message.frame_id == self._at and self._origin is not None:
            again = replace(self._ctx, checkpoint=self._file, epoch_ns=self._origin.t_ns)
            self._node = make_nodes(again)["estimator"]
            yield from self._node.on(self._origin)
        self._edge.on_message(message)
        for published in self._node.on(message):
            self._edge.on_message(published)
            yield published

    def tick(self, now_ns: int) -> Iterable[Message]:
        return self._node.tick(now_ns)


def restarted(ctx: NodeContext) -> dict[str, Node]:
    nodes = make_nodes(ctx)
    return {**nodes, "estimator": RestartedEstimator(ctx, nodes["estimator"], RESTARTED_AT)}


def finalised(data: Path, work: Path) -> dict[str, Digest]:
    """Digest of the whole-flight solution of a recorded flight; its record is not compared again."""
    replay(data / VILLAGE, data / "maps/village-2014-01.tif", work / "out")
    finalise(work / "out")
    digests = Digests()
    digests.take_bytes(TABLE, (work / "out" / TABLE).read_bytes())
    return digests.result()


def link(_: Path, work: Path) -> dict[str, Digest]:
    """Digests of the link on a simulated flight with ticks: GpsInput, the bytes of GPS_INPUT, texts, verdicts."""
    record = _fly(work, Kind.COPTER, 33)
    digests, wire = Digests(), mavlink.MAVLink(None, srcSystem=1, srcComponent=191)

    def take(publisher: str, published: Message) -> None:
        if publisher == "link":
            digests.take(published)
            if isinstance(published, GpsInput):
                digests.take_bytes("GPS_INPUT", bytes(encode(published, 0).pack(wire)))

    shell = InProcessShell({"link": LinkNode(10.0)}, take)
    shell.feed_read("link", WallClock(t_ns=0, source="golden", unix_ns=UNIX_NS))
    tick_ns = round(1e9 / TICK_HZ)
    now_ns = 0
    for _topic, _log_ns, message in read_flight(record):
        if not isinstance(message, (Origin, NavEstimate, CalibrationFault, SearchState, VehicleState)):
            continue
        while now_ns + tick_ns <= message.t_ns:
            now_ns += tick_ns
            shell.tick(now_ns)
        if isinstance(message, VehicleState):
            shell.feed_read("link", message)
        elif isinstance(message, NavEstimate):
            shell.feed(msgspec.structs.replace(message, emitted_at_ns=message.t_ns))
        else:
            shell.feed(message)
    return digests.result()


CASES = (
    GoldenCase("montecarlo", montecarlo),
    GoldenCase("copter", _simulated(Kind.COPTER, 31)),
    GoldenCase("plane", _simulated(Kind.PLANE, 32)),
    GoldenCase("restart in flight", _simulated(Kind.COPTER, 31, restarted)),
    GoldenCase("link", link),
    GoldenCase(
        "village-1 on 2014-01",
        _replayed(VILLAGE, "maps/village-2014-01.tif"),
        (VILLAGE, "maps/village-2014-01.tif"),
    ),
    GoldenCase(
        "village-1 on 2014-03",
        _replayed(VILLAGE, "maps/village-2014-03.tif"),
        (VILLAGE, "maps/village-2014-03.tif"),
    ),
    GoldenCase(
        "village-1 by XFeat",
        _replayed(VILLAGE, "maps/village-2014-01.tif", ("xfeat=models/xfeat.onnx",)),
        (VILLAGE, "maps/village-2014-01.tif", "models/xfeat.onnx"),
    ),
    GoldenCase("town-a", _replayed(TOWN, "maps/town.tif"), (TOWN, "maps/town.tif")),
    GoldenCase("finalise village-1", finalised, (VILLAGE, "maps/village-2014-01.tif")),
)
