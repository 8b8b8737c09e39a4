"""python -m terrafix_tools.console.compute: one flight, from its first image to its completion or until it is ended.

Deterministic: after a kill the next process computes the same again and stores only what is missing. It reports on
standard output, a word a line: "frame N" (begins), "stored", "waiting", "done", "failed WHY". A line on its standard
input wakes it; the end of the input ends it."""

import argparse
import fcntl
import os
import resource
import signal
import sys
from pathlib import Path
from typing import Any, NoReturn

import msgspec

from terrafix.core.errors import TerrafixError
from terrafix.messages import Frame, Message, Origin, PositionHint
from terrafix.runtime.fork_server import set_parent_death_signal
from terrafix_tools.console.compute.description import stored_pixel
from terrafix_tools.console.compute.observed import FlightObserver, FrameOutcome
from terrafix_tools.console.compute.source import UploadedImages
from terrafix_tools.console.compute.steering import fix_message, hint_message
from terrafix_tools.console.payloads import Hint, UserFix
from terrafix_tools.console.store import flights
from terrafix_tools.console.store.database import Database, open_database
from terrafix_tools.replay import replay

MEMORY_BYTES = (
    6 * 2**30
)  # address space of one flight: a decoder that asks for more fails [spec: five times what is used]


class FlightProcess:
    """The flight ``flight_id`` of the console in ``data``."""

    def __init__(self, database: Database, data: Path, flight_id: str, report: Any) -> None:
        self._database, self._flight_id, self._report = database, flight_id, report
        self._folder = data / "flights" / flight_id
        self._observer = FlightObserver(lambda frame_id: f"/flights/{flight_id}/frames/{frame_id}/image")
        with database.read() as db:
            self._known = flights.result_count(db, flight_id)  # frames that an earlier process has stored
        self.source = UploadedImages(
            database, flight_id, self._folder, wait=self._wait, begins=self._begins, steer=self._steer
        )

    def run(self, map_path: Path, configs: list[Path], models: list[str]) -> None:
        """Raises TerrafixError."""
        replay(
            self.source,
            map_path,
            self._folder / "out",
            configs=configs,
            models=models,
            watch=self._watch,
        )
        with self._database.write() as db:
            flights.complete(db, self._flight_id, self._observer.completed())
        self._say("stored")

    def _say(self, words: str) -> None:
        self._report.write(words + "\n")
        self._report.flush()

    def _begins(self, frame_id: int) -> None:
        self._say(f"frame {frame_id}")

    def _wait(self) -> None:
        self._say("waiting")
        if not sys.stdin.readline():
            raise SystemExit(0)

    def _steer(self, hint_id: int, given: Hint | UserFix, t_ns: int) -> PositionHint | None:
        t_ns += hint_id  # nanoseconds: the answer names a hint by its time
        if isinstance(given, Hint):
            message: PositionHint | None = hint_message(given, t_ns)
        else:
            pixel = stored_pixel(given.pixel.u, given.pixel.v, self.source.new)
            camera = self.source.origin().camera
            message = fix_message(given, pixel, camera, self._observer.estimates, t_ns)
        if message is not None:
            self._observer.hints[message.t_ns] = hint_id
        return message

    def _watch(self, messages: list[Message]) -> None:
        """Stores what the messages of one step add, all of it or nothing."""
        self._observer.take(messages)
        frame = next((m for m in messages if isinstance(m, Frame)), None)
        if frame is not None:
            outcome = self._observer.frame_done()
            if frame.frame_id >= self._known:
                self._store(f"frame {frame.frame_id}", outcome)
        elif not any(isinstance(m, Origin) for m in messages):
            self._store("end", self._observer.rest())

    def _store(self, step: str, outcome: FrameOutcome) -> None:
        with self._database.write() as db:
            flights.store_outcome(db, self._flight_id, step, outcome)
        self._say("stored")


def main() -> NoReturn:
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--flight", required=True)
    parser.add_argument("--map", type=Path, required=True)
    parser.add_argument("--parent", type=int, required=True)
    parser.add_argument("--nice", type=int, default=0)
    parser.add_argument("--config", type=Path, action="append", default=[])
    parser.add_argument("--model", action="append", default=[])
    given = parser.parse_args()
    if not set_parent_death_signal(given.parent, signal.SIGKILL):
        raise SystemExit(0)
    os.nice(given.nice)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    report = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what a library prints is no report
    with (given.data / "flights" / given.flight / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # a process of a killed service may still be ending
        database = open_database(given.data, durable=False)
        try:
            FlightProcess(database, given.data, given.flight, report).run(given.map, given.config, given.model)
        except TerrafixError as error:
            report.write(f"failed {msgspec.json.encode(str(error)).decode()}\n")
            report.flush()
            raise SystemExit(error.exit_code) from None
        finally:
            database.close()
    report.write("done\n")
    report.flush()
    raise SystemExit(0)


if __name__ == "__main__":
    main()
