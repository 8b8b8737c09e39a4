"""Edge of the vision process: reads a source in its own thread, paced by its timestamps, newest frame first.

The time zero of a recording is the first poll, that of a camera is the time when it was opened; both are published as
``Origin.t_ns``. A vision process that restarts in flight gets that time as ``NodeContext.epoch_ns``: it continues at
the current flight time with the same frame ids, and waits for a camera that is not available."""

import threading
from collections import deque
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor

import msgspec

from terrafix import messages as m
from terrafix.core.clock import now_ns
from terrafix.core.errors import SourceError
from terrafix.core.flight_id import live_flight_id
from terrafix.core.frames import FrameWriter
from terrafix.core.initial_position import Bounds, map_bounds, start_is_unknown, with_map_center
from terrafix.core.node import Edge, NodeContext
from terrafix.vision.frame_rate import FrameRateLimit
from terrafix.vision.sources import Shot, Source, open_configured
from terrafix.vision.sources.exposed import ReportedExposures
from terrafix.vision.sources.facts import facts_of

QUEUE_SHOTS = 3  # shots with pixels that are read ahead from a recording that is not played in real time
MAX_DROPPED_MESSAGES = 1024  # dropped frames and their telemetry, without pixels; 20 s at 50 Hz
MAX_LAG_NS = 2_000_000_000  # a recording that lags real time by more than this skips ahead


class SourceEdge:
    """``poll`` returns at most one frame with pixels; a dropped frame becomes a Frame with an error.

    ``epoch_ns``: time zero of the flight after a restart, else None. ``realtime``: a recording plays in real time and
    drops frames, else it is read as fast as it is processed. ``ground_amsl_m``: default ground height. ``bounds``: of
    the map, for a source without an initial position. ``rate``: of the frames that are taken from a source in real
    time; one that is not taken is not published, its telemetry is."""

    def __init__(
        self,
        source: Source,
        frames: FrameWriter,
        epoch_ns: int | None,
        realtime: bool,
        ground_amsl_m: float | None = None,
        bounds: Bounds | None = None,
        rate: FrameRateLimit | None = None,
    ) -> None:
        self._source = source
        self._frames = frames
        self._realtime = realtime
        self._ground_amsl_m = ground_amsl_m  # used when the source has none
        self._bounds = bounds  # of the map, for a source without an initial position
        self._rate = rate if realtime or source.live else None
        self._epoch_ns = epoch_ns
        self._zero_ns = 0  # time zero of the source; set when the reader starts
        self._first_id = 0
        self._changed = threading.Condition()
        self._selected = source.live and self._rate is not None and source.select(self._takes)  # by the source
        self._shots: deque[Shot] = deque()
        self._exposures = ReportedExposures()
        self._dropped: deque[m.Message] = deque(maxlen=MAX_DROPPED_MESSAGES)
        self._stopping = threading.Event()
        self._count = 0
        self._end_published = False
        self._reader = ThreadPoolExecutor(1, "source")
        # A camera delivers frames before any subscriber is ready: the newest ones wait in the queue until all are.
        self._reading: Future[None] | None = self._start(now_ns()) if source.live else None
        self._origin_published = False

    def poll(self, now_ns: int) -> Iterable[m.Message]:
        if self._reading is None:
            self._reading = self._start(now_ns)
        if not self._origin_published:
            self._origin_published = True
            origin = self._source.origin()
            origin = origin if self._bounds is None else with_map_center(origin, self._bounds)
            ground_m = self._ground_amsl_m if origin.ground_amsl_m is None else origin.ground_amsl_m
            said = m.SourceFacts(t_ns=self._zero_ns, facts=tuple(facts_of(self._source)))
            flight_id = live_flight_id(self._zero_ns)
            origin = msgspec.structs.replace(origin, t_ns=self._zero_ns, ground_amsl_m=ground_m, flight_id=flight_id)
            return [origin, said]
        ended = self._reading.done()
        with self._changed:
            messages = list(self._dropped)
            self._dropped.clear()
            shot = self._shots.popleft() if self._shots else None
            self._changed.notify()
        if shot is not None:
            if shot.image is not None:
                self._frames.put(shot.frame.frame_id, shot.image)
            frame = self._exposures.exposed(shot.frame) if self._source.live else shot.frame
            messages += [*shot.imu, *shot.states, *shot.others, frame]
            if self._rate is not None:
                with self._changed:
                    messages += self._rate.published([one for one in messages if isinstance(one, m.Frame)], now_ns)
        elif ended and not self._end_published:
            self._reading.result()  # re-raises an exception of the reader thread in this process
            self._end_published = True
            messages.append(m.SourceEnded(t_ns=now_ns, frames=self._source.length() or self._count))
        return messages

    def on_message(self, message: m.Message) -> None:
        """Takes the thermal band of Health, exposures, and when estimates came."""
        if isinstance(message, m.Exposure):
            self._exposures.add(message)
        if self._rate is not None and isinstance(message, m.Health | m.NavEstimate):
            with self._changed:
                if isinstance(message, m.Health):
                    self._rate.band = message.band
                else:
                    self._rate.on_estimate(message)

    def close(self) -> None:
        self._stopping.set()
        self._source.close()
        with self._changed:
            self._changed.notify()
        self._reader.shutdown(wait=True)

    def _start(self, now_ns: int) -> Future[None]:
        """Starts the reader thread; for a recording at the first poll, because nothing consumes its frames earlier."""
        self._zero_ns = now_ns if self._epoch_ns is None else self._epoch_ns
        # A camera counts from 0 each time it is opened, but ids must increase over a restart; at most 1000 per second.
        self._first_id = max(0, (now_ns - self._zero_ns) // 1_000_000) if self._source.live else 0
        paced = self._realtime and not self._source.live
        return self._reader.submit(self._read, max(0, now_ns - self._zero_ns) if paced else 0)

    def _read(self, from_ns: int) -> None:
        while from_ns >= 0 and not self._stopping.is_set():
            from_ns = self._play(from_ns)

    def _play(self, from_ns: int) -> int:
        """Plays from ``from_ns`` in source time. -> source time to resume at after falling too far behind, or -1."""
        for index, shot in enumerate(self._source.shots(from_ns / 1e9)):
            if self._stopping.is_set():
                return -1
            timed = self._to_system_time(shot)
            if self._realtime and not self._source.live:
                late_ns = now_ns() - timed.frame.t_ns
                if late_ns > MAX_LAG_NS and index > 0:  # the first shot is always published, to guarantee progress
                    return now_ns() - self._zero_ns
                if late_ns < 0 and self._stopping.wait(-late_ns / 1e9):
                    return -1
            self._push(timed)
        return -1

    def _to_system_time(self, shot: Shot) -> Shot:
        shift_ns = 0 if self._source.live else self._zero_ns
        frame = msgspec.structs.replace(
            shot.frame, t_ns=shot.frame.t_ns + shift_ns, frame_id=shot.frame.frame_id + self._first_id
        )
        states = tuple(msgspec.structs.replace(state, t_ns=state.t_ns + shift_ns) for state in shot.states)
        imu = tuple(msgspec.structs.replace(reading, t_ns=reading.t_ns + shift_ns) for reading in shot.imu)
        others = tuple(msgspec.structs.replace(other, t_ns=other.t_ns + shift_ns) for other in shot.others)
        return Shot(frame, states, shot.image, imu, others)

    def _takes(self, t_ns: int) -> bool:
        with self._changed:
            return self._rate is None or self._rate.takes_frame(t_ns)

    def _push(self, shot: Shot) -> None:
        with self._changed:
            if not self._selected and not self._takes(shot.frame.t_ns):
                self._dropped.extend((*shot.imu, *shot.states, *shot.others))
                return
            if not self._realtime and not self._source.live:  # lossless: the reader blocks until there is room
                self._changed.wait_for(lambda: len(self._shots) < QUEUE_SHOTS or self._stopping.is_set())
            self._count += 1
            self._shots.append(shot)
            if len(self._shots) > 1 and (self._realtime or self._source.live):  # the newest first, and it alone
                old = self._shots.popleft()
                self._dropped.extend((*old.imu, *old.states, *old.others))
                self._dropped.append(msgspec.structs.replace(old.frame, error=old.frame.error or m.OVERTAKEN))


def make_edge(ctx: NodeContext) -> Edge:
    """Opens the configured source. Raises SourceError, UsageError (initial position), MapError."""
    if not isinstance(ctx.frames, FrameWriter):
        raise TypeError("the process that opens the source needs a frame store to write to")
    section = ctx.config.source
    source = open_configured(section, wait_for_camera=ctx.epoch_ns is not None)
    if ctx.map_path is None and start_is_unknown(source.origin()):
        source.close()
        raise SourceError(
            f"{source.name()}: neither a start coordinate nor a map to search; give --map, or --start LAT,LON"
        )
    bounds = map_bounds(ctx.map_path) if ctx.map_path is not None and start_is_unknown(source.origin()) else None
    rate = FrameRateLimit(ctx.config.health)
    return SourceEdge(source, ctx.frames, ctx.epoch_ns, section.realtime, ctx.ground_amsl_m, bounds, rate)
