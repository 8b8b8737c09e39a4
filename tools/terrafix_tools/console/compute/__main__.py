"""python -m terrafix_tools.console.compute: one flight, from its first image to its completion or until it is ended.

Deterministic: after a kill the next process computes the same again and stores only what is missing. It reports on
standard output, a word a line: "frame N" (begins), "stored", "waiting", "done", "failed WHY". A line on its standard
input wakes it; the end of the input ends it."""

import argparse
import fcntl
import json
import os
import resource
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import msgspec

from terrafix.core.errors import TerrafixError
from terrafix.messages import Frame, Message, Origin, PositionHint
from terrafix.runtime.fork_server import set_parent_death_signal
from terrafix_tools.console.compute.description import stored_pixel
from terrafix_tools.console.compute.limits import MEMORY_BYTES
from terrafix_tools.console.compute.observed import FlightObserver, FrameOutcome
from terrafix_tools.console.compute.packets import Begin
from terrafix_tools.console.compute.source import Upload, UploadedImages
from terrafix_tools.console.compute.steering import fix_message, hint_message
from terrafix_tools.console.events import FinaliseProgress
from terrafix_tools.console.payloads import Hint, UserFix, WholeVerdict
from terrafix_tools.console.store import flights
from terrafix_tools.console.store.database import Database, open_database
from terrafix_tools.finalised import read_poses
from terrafix_tools.replay import replay
from terrafix_tools.replay_output import SUMMARY

PROGRESS_STEPS = 10  # events of a stage of finalise [spec: docs/console.md]


class FlightProcess:
    """A flight of the console, from its first image; ``options``: of this program."""

    def __init__(self, database: Database, options: argparse.Namespace, report: Any) -> None:
        flight_id = str(options.flight)
        self._database, self._flight_id, self._report, self._options = database, flight_id, report, options
        self._folder = options.data / "flights" / flight_id
        self._observer = FlightObserver(lambda frame_id: f"/flights/{flight_id}/frames/{frame_id}/image")
        self._finalised_to, self._progress_events = ("", 0), 0
        with database.read() as db:
            self._known = flights.result_count(db, flight_id)  # frames that an earlier process has stored
        self.source = UploadedImages(
            database, flight_id, self._folder, wait=self._wait, begins=self._begins, steer=self._steer
        )

    def run(self) -> None:
        """Raises TerrafixError."""
        replay(
            self.source,
            self._options.map,
            self._folder / "out",
            configs=self._options.config,
            models=self._options.model,
            watch=self.take,
        )
        self.complete()

    def begin(self) -> Begin:
        """What a program on a cluster needs to know."""
        stored = self.source.stored
        return Begin(
            origin=self.source.origin(),
            name=self.source.name(),
            width=stored.width,
            height=stored.height,
            out=str(self._folder / "out"),
            map_path=str(self._options.map),
            nice=self._options.nice,
            configs=[str(path.absolute()) for path in self._options.config],
            models=self._options.model,
        )

    def uploads(self) -> Iterator[Upload]:
        return self.source.uploads()

    def complete(self) -> None:
        not_finalised = self._finalise()
        summary = json.loads((self._folder / "out" / SUMMARY).read_bytes())
        verdict = WholeVerdict.model_validate(summary["verdict"])
        with self._database.write() as db:
            flights.complete(db, self._flight_id, self._observer.completed(verdict, not_finalised))
        self._say("stored")

    def _finalise(self) -> str:
        """Solves the flight as a whole. -> why that is not possible; else empty."""
        from terrafix_tools.finalise.run import finalise  # imported by no flight before its end

        out = self._folder / "out"
        try:
            finalise(out, self._finalising)
        except TerrafixError as error:
            return str(error)
        self._store("finalised", self._observer.finalised(read_poses(out)))
        return ""

    def _finalising(self, stage: str, done: int, of: int | None) -> None:
        """Stores the progress: at the beginning of each stage, and every tenth of it."""
        tenth = stage, 0 if not of else PROGRESS_STEPS * done // of
        if tenth == self._finalised_to:
            return
        self._finalised_to, self._progress_events = tenth, self._progress_events + 1
        with self._database.write() as db:
            progress = FinaliseProgress(stage=stage, done=done, of=of)
            flights.add_events(db, self._flight_id, f"finalise {self._progress_events}", [progress])
        self._say("stored")

    def _say(self, words: str) -> None:
        self._report.write(words + "\n")
        self._report.flush()

    def _begins(self, frame_id: int) -> None:
        self._say(f"frame {frame_id}")

    def _wait(self) -> None:
        if (outcome := self._observer.images_through()) is not None and outcome.request is not None:
            self._store(f"asked {outcome.request.request_id}", outcome)
        elif not self._observer.asks and self._has_all_images():
            with self._database.write() as db:
                flights.update(db, self._flight_id, completing=True)
            return
        self._say("waiting")
        if not sys.stdin.readline():
            raise SystemExit(0)

    def _has_all_images(self) -> bool:
        with self._database.read() as db:
            count = flights.image_count(db, self._flight_id)
        return self.source.new.images is not None and count >= self.source.new.images

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

    def take(self, messages: list[Message]) -> None:
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


def _run(database: Database, given: argparse.Namespace, report: Any) -> None:
    """Raises TerrafixError."""
    if not given.scheduler:
        FlightProcess(database, given, report).run()
        return
    from terrafix_tools.console.compute.cluster import compute
    from terrafix_tools.parallel.remote_program import ProgramEnded

    try:
        compute(given.scheduler, lambda: FlightProcess(database, given, report))
    except ProgramEnded as ended:  # this process dies as the program did, which counts as a death at this image
        if ended.code < 0:
            os.kill(os.getpid(), -ended.code)
        raise SystemExit(ended.code or 1) from None


def main() -> NoReturn:
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--flight", required=True)
    parser.add_argument("--map", type=Path, required=True)
    parser.add_argument("--parent", type=int, required=True)
    parser.add_argument("--nice", type=int, default=0)
    parser.add_argument("--config", type=Path, action="append", default=[])
    parser.add_argument("--model", action="append", default=[])
    parser.add_argument("--scheduler", default="")
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
            _run(database, given, report)
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
