"""The recorder process: receives all messages and writes them in a separate thread, without blocking the process."""

import queue
import threading
from collections import Counter
from collections.abc import Iterable

from terrafix.core.node import Edge, FrameStore, Node, NodeBase, NodeContext
from terrafix.messages import Dropped, Frame, Message
from terrafix.recorder.images import ImagePolicy
from terrafix.recorder.provenance import header
from terrafix.recorder.segments import FRAME_IMAGE, SegmentRing

RECORD_QUEUE_LENGTH = 8192  # about 30 s of all messages; a longer queue would only hide a disk that is too slow
RECORD_FLUSH_S = 0.25  # interval of flushes: at most this much of the record is lost when the process is killed
CLOSE_TIMEOUT_S = 10.0


class RecorderEdge:
    """A queue and a writer thread. A full queue drops messages; their count is recorded as Dropped."""

    def __init__(self, ring: SegmentRing, frames: FrameStore, images: ImagePolicy) -> None:
        self._ring = ring
        self._frames = frames
        self._images = images
        self._queue: queue.Queue[tuple[int, Message]] = queue.Queue(RECORD_QUEUE_LENGTH)
        self._dropped: Counter[str] = Counter()
        self._dropped_lock = threading.Lock()
        self._now_ns = 0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._write_all, name="recorder-writer", daemon=True)
        self._thread.start()

    def poll(self, now_ns: int) -> Iterable[Message]:
        self._now_ns = now_ns
        if not self._thread.is_alive():
            # Its traceback is on stderr. The process must end as well, so that it is restarted.
            raise RuntimeError("the recorder's writing thread has died")
        return ()

    def on_message(self, message: Message) -> None:
        try:
            # Before the first poll the time of the message is the best approximation of its reception time.
            self._queue.put_nowait((self._now_ns or message.t_ns, message))
        except queue.Full:
            with self._dropped_lock:
                self._dropped[type(message).__name__] += 1

    def close(self) -> None:
        self._closing.set()
        self._thread.join(CLOSE_TIMEOUT_S)

    def _write_all(self) -> None:
        while True:
            closing = self._closing.is_set()  # read before the queue is emptied, so that no message is missed
            self._drain()
            self._ring.flush()
            if closing:
                self._ring.close()
                return
            self._closing.wait(RECORD_FLUSH_S)

    def _drain(self) -> None:
        while True:
            try:
                received_ns, message = self._queue.get_nowait()
            except queue.Empty:
                break
            self._ring.write(message, received_ns)
            self._write_images(message)
        if self._ring.blocked:
            return
        with self._dropped_lock:
            lost, self._dropped = self._dropped + self._ring.take_lost(), Counter()
        for name, count in lost.items():
            now_ns = self._now_ns
            self._ring.write(Dropped(t_ns=now_ns, process="recorder", message=name, count=count), now_ns)

    def _write_images(self, message: Message) -> None:
        """Thumbnail and full size of a frame. Its pixels are gone when this thread is seconds late."""
        small = message if isinstance(message, Frame) and self._images.thumbnails and not message.error else None
        full_id = self._images.full_frame(message)
        frame_id = small.frame_id if small is not None else full_id
        if frame_id is None:
            return
        image = self._frames.get(frame_id)  # a copy
        if small is not None and image is not None:
            self._ring.write_thumbnail(small.t_ns, frame_id, self._images.thumbnail(image))
        if full_id is None:
            return
        if image is None:
            self._ring.count_lost(FRAME_IMAGE)
        else:
            image_format = self._images.settings.frame_format
            self._ring.write_frame_image(message.t_ns, full_id, self._images.encoded(image), image_format)


def make_node(ctx: NodeContext) -> Node:
    return NodeBase()  # the edge writes the messages of the process


def make_edge(ctx: NodeContext) -> Edge:
    """Raises OutputError when the path or its permissions allow no folder; a disk that is full is no error."""
    settings = ctx.config.recorder
    ring = SegmentRing(ctx.out_dir, header(ctx.config, ctx.map_path), settings.budget_mb)
    return RecorderEdge(ring, ctx.frames, ImagePolicy(settings))
