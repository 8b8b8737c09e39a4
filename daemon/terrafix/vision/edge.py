"""The live edge of the vision process: a source in a thread of its own, paced by its times, newest frame first.

A recorded source plays on a clock whose zero is the first poll, a camera on one that began when it was opened, and
``Origin.t_ns`` says so. A vision process that is
started again in mid-flight is given that time as ``NodeContext.epoch_ns``: it goes on where the flight is now, with the
same frame ids, and waits for a camera that is not there."""

import threading
from collections import deque
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor

import msgspec

from terrafix.core.clock import now_ns
from terrafix.core.errors import SourceError
from terrafix.core.frames import FrameWriter
from terrafix.core.initial_position import Bounds, map_bounds, placed, start_is_unknown
from terrafix.core.node import Edge, NodeContext
from terrafix.messages import Message, SourceEnded
from terrafix.vision.sources import Shot, Source, open_configured

QUEUE_SHOTS = 3  # with pixels; a frame that waits behind more than these is too old to be worth its time
OVERTAKEN_MESSAGES = 1024  # without pixels: frames that were overtaken and their telemetry; 20 s at 50 Hz
MAX_LATE_NS = 2_000_000_000  # a source that reads slower than its pace skips ahead when it is this late
OVERTAKEN = "overtaken: a newer frame was there first"


class SourceEdge:
    """``poll`` gives at most one frame with pixels; what was overtaken is a Frame with an error."""

    def __init__(
        self,
        source: Source,
        frames: FrameWriter,
        epoch_ns: int | None,
        realtime: bool,
        ground_amsl_m: float | None = None,
        bounds: Bounds | None = None,
    ) -> None:
        self._source = source
        self._frames = frames
        self._realtime = realtime
        self._ground_amsl_m = ground_amsl_m  # where the source does not know it
        self._bounds = bounds  # of the map, for a source that knows no start
        self._epoch_ns = epoch_ns
        self._zero_ns = 0  # of the source's clock; set when the reader starts
        self._first_id = 0
        self._changed = threading.Condition()
        self._shots: deque[Shot] = deque()
        self._overtaken: deque[Message] = deque(maxlen=OVERTAKEN_MESSAGES)
        self._stopping = threading.Event()
        self._count = 0
        self._said_end = False
        self._reader = ThreadPoolExecutor(1, "source")
        # A camera has pictures now, before anybody is there who takes them: when all are, the newest wait for them.
        self._reading: Future[None] | None = self._start(now_ns()) if source.live else None
        self._said_origin = False

    def poll(self, now_ns: int) -> Iterable[Message]:
        if self._reading is None:
            self._reading = self._start(now_ns)
        if not self._said_origin:
            self._said_origin = True
            origin = self._source.origin() if self._bounds is None else placed(self._source.origin(), self._bounds)
            ground_m = self._ground_amsl_m if origin.ground_amsl_m is None else origin.ground_amsl_m
            return [msgspec.structs.replace(origin, t_ns=self._zero_ns, ground_amsl_m=ground_m)]
        ended = self._reading.done()
        with self._changed:
            said = list(self._overtaken)
            self._overtaken.clear()
            shot = self._shots.popleft() if self._shots else None
            self._changed.notify()
        if shot is not None:
            if shot.image is not None:
                self._frames.put(shot.frame.frame_id, shot.image)
            said += [*shot.imu, *shot.states, shot.frame]
        elif ended and not self._said_end:
            self._reading.result()  # a bug in the thread is a bug of this process
            self._said_end = True
            said.append(SourceEnded(t_ns=now_ns, frames=self._source.length() or self._count))
        return said

    def heard(self, message: Message) -> None:
        """The source takes no advice."""

    def close(self) -> None:
        self._stopping.set()
        self._source.close()
        with self._changed:
            self._changed.notify()
        self._reader.shutdown(wait=True)

    def _start(self, now_ns: int) -> Future[None]:
        """Of a recording: at the first poll, not before, until then nobody takes the frames."""
        self._zero_ns = now_ns if self._epoch_ns is None else self._epoch_ns
        # A camera counts from 0 each time it is opened; ids must still grow over a restart: at most 1000 a second.
        self._first_id = max(0, (now_ns - self._zero_ns) // 1_000_000) if self._source.live else 0
        paced = self._realtime and not self._source.live
        return self._reader.submit(self._read, max(0, now_ns - self._zero_ns) if paced else 0)

    def _read(self, from_ns: int) -> None:
        while from_ns >= 0 and not self._stopping.is_set():
            from_ns = self._play(from_ns)

    def _play(self, from_ns: int) -> int:
        """Plays from ``from_ns`` of the source's clock; -> where to go on when it fell too far behind, or -1."""
        for index, shot in enumerate(self._source.shots(from_ns / 1e9)):
            if self._stopping.is_set():
                return -1
            ours = self._on_our_clock(shot)
            if self._realtime and not self._source.live:
                late_ns = now_ns() - ours.frame.t_ns
                if late_ns > MAX_LATE_NS and index > 0:  # the first is said however late: there must be progress
                    return now_ns() - self._zero_ns
                if late_ns < 0 and self._stopping.wait(-late_ns / 1e9):
                    return -1
            self._push(ours)
        return -1

    def _on_our_clock(self, shot: Shot) -> Shot:
        shift_ns = 0 if self._source.live else self._zero_ns
        frame = msgspec.structs.replace(
            shot.frame, t_ns=shot.frame.t_ns + shift_ns, frame_id=shot.frame.frame_id + self._first_id
        )
        states = tuple(msgspec.structs.replace(state, t_ns=state.t_ns + shift_ns) for state in shot.states)
        imu = tuple(msgspec.structs.replace(said, t_ns=said.t_ns + shift_ns) for said in shot.imu)
        return Shot(frame, states, shot.image, imu)

    def _push(self, shot: Shot) -> None:
        with self._changed:
            if not self._realtime and not self._source.live:  # nothing is lost: the reader waits
                self._changed.wait_for(lambda: len(self._shots) < QUEUE_SHOTS or self._stopping.is_set())
            self._count += 1
            self._shots.append(shot)
            if len(self._shots) > QUEUE_SHOTS:
                old = self._shots.popleft()
                self._overtaken.extend((*old.imu, *old.states))
                self._overtaken.append(msgspec.structs.replace(old.frame, error=old.frame.error or OVERTAKEN))


def make_edge(ctx: NodeContext) -> Edge:
    """Opens the source that the configuration names. Raises SourceError, UsageError (start), MapError."""
    if not isinstance(ctx.frames, FrameWriter):
        raise TypeError("the process that opens the source needs a frame store to write to")
    wanted = ctx.config.source
    source = open_configured(wanted, wait_for_camera=ctx.epoch_ns is not None)
    if ctx.map_path is None and start_is_unknown(source.origin()):
        source.close()
        raise SourceError(
            f"{source.name()}: neither a start coordinate nor a map to search; give --map, or --start LAT,LON"
        )
    bounds = map_bounds(ctx.map_path) if ctx.map_path is not None and start_is_unknown(source.origin()) else None
    return SourceEdge(source, ctx.frames, ctx.epoch_ns, wanted.realtime, ctx.ground_amsl_m, bounds)
