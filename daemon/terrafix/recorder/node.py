"""The recorder process: hears everything, writes it down in a thread of its own, and never makes anybody wait."""

import queue
import threading
from collections import Counter
from collections.abc import Iterable

from terrafix.core.node import Edge, FrameStore, Node, NodeContext
from terrafix.messages import Dropped, Frame, Message
from terrafix.recorder.segments import SegmentRing
from terrafix.recorder.writer import header, thumbnail_jpeg

QUEUE_LENGTH = 8192  # about 30 s of all messages; more would only hide a disk that cannot follow
FLUSH_S = 0.25  # at most this much of the flight is lost when the process is killed
CLOSE_TIMEOUT_S = 10.0


class RecorderNode:
    """Decides nothing: what the process hears goes to the edge."""

    def on(self, message: Message) -> Iterable[Message]:
        return ()

    def tick(self, now_ns: int) -> Iterable[Message]:
        return ()


class RecorderEdge:
    """Queue in front, one writing thread behind; a full queue drops and counts, and the count is recorded too."""

    def __init__(self, ring: SegmentRing, frames: FrameStore, thumbnail_width_px: int | None) -> None:
        self._ring = ring
        self._frames = frames
        self._thumbnail_width_px = thumbnail_width_px
        self._queue: queue.Queue[tuple[int, Message]] = queue.Queue(QUEUE_LENGTH)
        self._dropped: Counter[str] = Counter()
        self._dropped_lock = threading.Lock()
        self._now_ns = 0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._write_all, name="recorder-writer", daemon=True)
        self._thread.start()

    def poll(self, now_ns: int) -> Iterable[Message]:
        self._now_ns = now_ns
        if not self._thread.is_alive():
            # Its traceback is on stderr; the process must die with it to be restarted.
            raise RuntimeError("the recorder's writing thread has died")
        return ()

    def heard(self, message: Message) -> None:
        try:
            # Before the first poll the message's own time is the best guess.
            self._queue.put_nowait((self._now_ns or message.t_ns, message))
        except queue.Full:
            with self._dropped_lock:
                self._dropped[type(message).__name__] += 1

    def close(self) -> None:
        self._closing.set()
        self._thread.join(CLOSE_TIMEOUT_S)

    def _write_all(self) -> None:
        while True:
            closing = self._closing.is_set()  # read before the queue is emptied, so that nothing is left behind
            self._drain()
            self._ring.flush()
            if closing:
                self._ring.close()
                return
            self._closing.wait(FLUSH_S)

    def _drain(self) -> None:
        while True:
            try:
                heard_ns, message = self._queue.get_nowait()
            except queue.Empty:
                break
            self._ring.write(message, heard_ns)
            if isinstance(message, Frame):
                self._thumbnail(message)
        with self._dropped_lock:
            lost, self._dropped = self._dropped, Counter()
        for name, count in lost.items():
            now_ns = self._now_ns
            self._ring.write(Dropped(t_ns=now_ns, process="recorder", message=name, count=count), now_ns)

    def _thumbnail(self, frame: Frame) -> None:
        if self._thumbnail_width_px is None or frame.error:
            return
        image = self._frames.get(frame.frame_id)
        if image is not None:
            self._ring.write_thumbnail(frame.t_ns, frame.frame_id, thumbnail_jpeg(image, self._thumbnail_width_px))


def make_node(ctx: NodeContext) -> Node:
    return RecorderNode()


def make_edge(ctx: NodeContext) -> Edge:
    """Raises OutputError when the folder cannot be written."""
    settings = ctx.config.recorder
    ring = SegmentRing(ctx.out_dir, header(ctx.config), settings.budget_mb)
    width_px = settings.thumbnail_width_px if settings.thumbnails else None
    return RecorderEdge(ring, ctx.frames, width_px)
