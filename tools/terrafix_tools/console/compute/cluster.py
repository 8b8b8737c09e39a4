"""A flight that is computed by a program on a worker of a Dask cluster (`terrafix serve --scheduler`).

The process of the flight stays on the computer of the console: it alone reads and writes the database, gives the
program its images and hints, and stores what comes of them, as if it had computed that itself. After the death of a
worker the flight is computed from its first image again; what is stored already is not stored again."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Protocol

from terrafix.core.errors import SourceError
from terrafix.messages import Message
from terrafix.recorder.provenance import versions
from terrafix_tools.console.compute.packets import (
    Begin,
    Done,
    Failed,
    NextUpload,
    NoMore,
    Step,
    from_program,
    messages_of,
    pack,
)
from terrafix_tools.console.compute.source import Upload
from terrafix_tools.parallel.pool import Workload
from terrafix_tools.parallel.remote_program import NewConnection, RemoteProgram

PROGRAM = "terrafix_tools.console.compute.remote"
NOT_COMPARED = ("platform", "git")  # that may differ between the computers of a cluster


class ComputedFlight(Protocol):
    """The flight from its first image."""

    def begin(self) -> Begin: ...

    def uploads(self) -> Iterator[Upload]:
        """Its images; the next one is waited for."""

    def take(self, messages: list[Message]) -> None:
        """Stores what the messages of a step add."""

    def complete(self) -> None: ...


class FlightFailed(SourceError):
    """The program refused the flight."""

    def __init__(self, why: str, exit_code: int) -> None:
        super().__init__(why)
        self.exit_code = exit_code  # that of the error, as of a flight on this computer


def compute(address: str, begin_anew: Callable[[], ComputedFlight]) -> None:
    """Until the flight is complete. Raises TerrafixError, ProgramEnded (the program died with this exit code)."""
    with RemoteProgram(address, FLIGHT, PROGRAM) as program:
        while True:
            program.wait_for_start()
            with contextlib.suppress(NewConnection):
                _converse(program, begin_anew())
                return


def _converse(program: RemoteProgram, flight: ComputedFlight) -> None:
    """Raises NewConnection, ProgramEnded, FlightFailed."""
    program.send(pack(flight.begin()))
    uploads = flight.uploads()
    while True:
        match from_program(program.receive()):
            case NextUpload():
                program.send(pack(next(uploads, NoMore())))
            case Step() as step:
                flight.take(messages_of(step))
            case Failed(why, exit_code):
                raise FlightFailed(why, exit_code)
            case Done():
                flight.complete()
                return


def _built_with() -> str:
    found = versions()
    return ", ".join(f"{name} {value}" for name, value in found.items() if name not in NOT_COMPARED)


@contextlib.contextmanager
def _environment(_workers: int) -> Iterator[None]:
    yield


FLIGHT = Workload(
    name="terrafix-flight",
    module=PROGRAM,
    environment=_environment,
    built_with=_built_with,
    error=SourceError,
    died=SourceError,
    again="start the service again",
)
