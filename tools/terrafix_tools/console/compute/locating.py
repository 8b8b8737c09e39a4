"""python -m terrafix_tools.console.compute.locating: positions of pixels, from the records of flights.

Reads a question a line from standard input (JSON: Question) and writes the answer as a line (JSON: LocateAnswer)."""

import argparse
import os
import signal
import sys
from pathlib import Path

import msgspec

from terrafix.core.errors import TerrafixError
from terrafix.runtime.fork_server import set_parent_death_signal
from terrafix_tools.console.locating import LocateAnswer, Question
from terrafix_tools.finalised import TABLE
from terrafix_tools.locate.locator import FlightLocator

NICE = 5  # after the service, before the flights [spec: nice(2)]


class Locators:
    """Keeps the flight that was asked for last, as long as its record does not grow."""

    def __init__(self) -> None:
        self._key: object = None
        self._locator: FlightLocator | None = None

    def answer(self, question: Question) -> LocateAnswer:
        try:
            locator = self._of(Path(question.out), Path(question.map) if question.map else None)
            found = locator.locate([(str(frame_id), pixel) for frame_id, pixel in question.pixels])
        except TerrafixError as error:
            return LocateAnswer(refused=str(error))
        except OSError as error:
            return LocateAnswer(refused=f"the record of the flight cannot be read ({error.strerror})")
        lat_deg, lon_deg = locator.flight.frame.to_wgs84(float(found.p_m[0]), float(found.p_m[1]))
        return LocateAnswer(
            lat_deg=lat_deg,
            lon_deg=lon_deg,
            alt_amsl_m=float(found.p_m[2]) if locator.amsl_known else None,
            radius95_m=found.radius95_m,
            surface=str(found.surface),
            consistent=found.consistent,
        )

    def _of(self, out: Path, map_path: Path | None) -> FlightLocator:
        files = {file.name: file.stat() for file in (*out.glob("flight*.mcap*"), *out.glob(TABLE))}
        key = str(out), tuple((name, found.st_size, found.st_mtime_ns) for name, found in sorted(files.items()))
        if self._locator is None or key != self._key:
            self._locator, self._key = FlightLocator.open(out, map_path), key
        return self._locator


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--parent", type=int, required=True)
    if not set_parent_death_signal(parser.parse_args().parent, signal.SIGKILL):
        return
    os.nice(NICE)
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no answer
    locators = Locators()
    for line in sys.stdin.buffer:
        answers.write(msgspec.json.encode(locators.answer(msgspec.json.decode(line, type=Question))) + b"\n")
        answers.flush()


if __name__ == "__main__":
    main()
