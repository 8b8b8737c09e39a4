"""Small nodes for the tests of shell and supervisor. Child processes import this module by name (see ``TABLE``)."""

import contextlib
import os
import threading
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from origins import origin_of
from terrafix import messages as m
from terrafix.core.errors import LinkError
from terrafix.core.frames import FrameWriter
from terrafix.core.node import Edge, Node, NodeBase, NodeContext
from terrafix.processes import Process

CAMERA = m.Camera(width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0)
ORIGIN = origin_of(CAMERA)
FRAME_PERIOD_NS = 20_000_000


def frame(frame_id: int) -> m.Frame:
    return m.Frame(t_ns=frame_id, frame_id=frame_id, file="", width=1, height=1)


def prediction(frame_id: int, east_m: float, north_m: float) -> m.Prediction:
    """``east_m``, ``north_m``: motion since the frame before."""
    return m.Prediction(
        t_ns=frame_id,
        frame_id=frame_id,
        p_c_in_w_m=(0.0, 0.0, 100.0),
        q_w_c=(1.0, 0.0, 0.0, 0.0),
        cov=(1.0,) * 36,
        agl_m=100.0,
        agl_sigma_m=2.0,
        step_m=(east_m, north_m),
        step_cov_m2=(1.0, 0.5, 0.5, 2.0),
    )


def image_of(frame_id: int) -> np.ndarray:
    return np.full((48, 64, 3), frame_id % 251, np.uint8)


class SourceEdge:
    """Publishes the Origin, then frames at 50 Hz. Their number is ``config.link.baud`` minus 9600, because tests can
    set this value."""

    def __init__(self, ctx: NodeContext) -> None:
        assert isinstance(ctx.frames, FrameWriter)
        self._frames = ctx.frames
        self._count = ctx.config.link.baud - 9600
        self._epoch_ns = ctx.epoch_ns
        self._next_id = -1
        self._next_ns = 0

    def poll(self, now_ns: int) -> Iterable[m.Message]:
        if now_ns < self._next_ns or self._next_id > self._count:
            return
        if self._next_id < 0:
            yield msgspec.structs.replace(ORIGIN, t_ns=now_ns if self._epoch_ns is None else self._epoch_ns)
        elif self._next_id < self._count:
            self._frames.put(self._next_id, image_of(self._next_id))
            yield m.Frame(t_ns=now_ns, frame_id=self._next_id, file="", width=64, height=48)
        else:
            yield m.SourceEnded(t_ns=now_ns, frames=self._count)
        self._next_id += 1
        self._next_ns = now_ns + FRAME_PERIOD_NS

    def on_message(self, message: m.Message) -> None:
        pass

    def close(self) -> None:
        pass


class Worker(NodeBase):
    """Publishes for every frame whether it has the origin and the correct pixels. The environment variable ``TROUBLE``
    makes it fail once."""

    def __init__(self, ctx: NodeContext) -> None:
        self._ctx = ctx
        self._origin: m.Origin | None = None

    def on(self, message: m.Message) -> Iterable[m.Message]:
        if isinstance(message, m.Origin):
            self._origin = message
        if isinstance(message, m.Frame):
            self._maybe_trouble(message.frame_id)
            image = self._ctx.frames.get(message.frame_id)
            if message.frame_id == 0:
                yield m.SearchState(t_ns=message.t_ns, step=m.SearchStep.WIDEN)  # a message that the shell logs
            pixels_correct = image is not None and np.array_equal(image, image_of(message.frame_id))
            verdict = m.Verdict.ACCEPTED if pixels_correct and self._origin is not None else m.Verdict.BAD_IMAGE
            yield m.MeasurementVerdict(
                t_ns=message.t_ns,
                frame_id=message.frame_id,
                measurement="test",
                verdict=verdict,
                detail=f"pid {os.getpid()} origin {self._origin is not None} pixels {pixels_correct}",
            )

    def _maybe_trouble(self, frame_id: int) -> None:
        trouble = os.environ.get("TROUBLE")
        once = self._ctx.out_dir / "trouble"
        if trouble not in ("stuck", "bug") or frame_id < 10 or once.exists():
            return
        once.touch()
        if trouble == "stuck":
            threading.Event().wait()
        raise ZeroDivisionError("a bug for the test")


def status(now_ns: int) -> m.LinkStatus:
    return m.LinkStatus(
        t_ns=now_ns, connected=True, autopilot="none", sysid=1, sent=0, received=0, bad=0, time_offset_ms=None
    )


class Link(NodeBase):
    def tick(self, now_ns: int) -> Iterable[m.Message]:
        yield status(now_ns)


class FileEdge:
    """Writes every message of the process as a line, unbuffered."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("ab", buffering=0)

    def poll(self, now_ns: int) -> Iterable[m.Message]:
        return ()

    def on_message(self, message: m.Message) -> None:
        self._file.write(msgspec.json.encode(message) + b"\n")

    def close(self) -> None:
        self._file.close()


def make_node(ctx: NodeContext) -> Node:
    role = process_name()
    if os.environ.get("TROUBLE") == f"{role} always":
        raise ZeroDivisionError("a bug at every start")
    if role == "link" and ctx.config.link.device == "broken":
        raise LinkError("broken: no such device; check --link")
    return {"estimator": lambda: Worker(ctx), "link": Link}.get(role, NodeBase)()


def make_edge(ctx: NodeContext) -> Edge | None:
    edges = {"vision": lambda: SourceEdge(ctx), "recorder": lambda: FileEdge(ctx.out_dir / "received.jsonl")}
    return edges[process_name()]() if process_name() in edges else None


def process_name() -> str:
    """The process name as in `ps`, because one module implements all processes."""
    return Path("/proc/self/comm").read_text().strip()


_BASE = Process("", "runtime_nodes", (), (), 0.0, 5.0)
TABLE: tuple[Process, ...] = (
    replace(_BASE, name="recorder", subscribes=m.ALL_MESSAGES, tick_hz=1.0),
    replace(_BASE, name="link", subscribes=(m.Origin,), publishes=(m.LinkStatus,), tick_hz=50.0, stuck_after_s=1.0),
    replace(
        _BASE,
        name="estimator",
        subscribes=(m.Origin, m.Frame),
        publishes=(m.MeasurementVerdict, m.SearchState),
        stuck_after_s=0.7,
        nice=3,
    ),
    replace(_BASE, name="vision", publishes=(m.Origin, m.Frame, m.SourceEnded)),
)


def children_of(pid: int) -> dict[str, int]:
    """Process name as in `ps` -> pid; the fork server has the name of the interpreter."""
    pids = {}
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        with contextlib.suppress(FileNotFoundError):  # ended meanwhile
            pids[Path(f"/proc/{child}/comm").read_text().strip()] = int(child)
    return pids
