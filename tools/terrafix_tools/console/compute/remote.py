"""python -m terrafix_tools.console.compute.remote: computes a flight on a worker of a cluster.

It has no database: it asks the process of the flight for one image after the other, reads them from the shared folder,
and sends the messages of each. It ends when the connection does."""

import argparse
import fcntl
import os
import resource
import signal
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NoReturn

from terrafix.core.errors import SourceError, TerrafixError
from terrafix.messages import Message
from terrafix.runtime.fork_server import set_parent_death_signal
from terrafix.vision.sources import Shot
from terrafix.vision.sources.contract import SourceBase
from terrafix_tools.console.compute.limits import MEMORY_BYTES
from terrafix_tools.console.compute.packets import Begin, Done, Failed, NextUpload, pack, step_of, to_program
from terrafix_tools.console.compute.source import Upload
from terrafix_tools.parallel.remote_program import PACKET_BYTES, connection_of
from terrafix_tools.replay import replay


class RemoteImages(SourceBase):
    """A Source: the images of a flight, as its process names them."""

    def __init__(self, connection: "Connection[Any, Any]", begin: Begin) -> None:
        self._connection, self._begin, self._origin = connection, begin, begin.origin

    def name(self) -> str:
        return self._begin.name

    def shots(self, from_s: float = 0.0) -> Iterator[Shot]:
        while True:
            self._connection.send_bytes(pack(NextUpload()))
            upload = to_program(self._connection.recv_bytes(PACKET_BYTES))
            if not isinstance(upload, Upload):
                return
            if upload.frame.t_ns >= from_s * 1e9:
                if upload.path and not Path(upload.path).is_file():
                    raise SourceError(f"{upload.path}: not on {os.uname().nodename}; workers need the same folders")
                yield upload.read(self._begin.width, self._begin.height)


def compute(connection: "Connection[Any, Any]", begin: Begin) -> None:
    """Raises TerrafixError; EOFError, OSError: nobody listens any more."""

    def send(messages: list[Message]) -> None:
        connection.send_bytes(pack(step_of(messages)))

    out = Path(begin.out)
    with (out.parent / "computing").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # a program that lost its connection may still be ending
        replay(
            RemoteImages(connection, begin),
            Path(begin.map_path),
            out,
            configs=[Path(path) for path in begin.configs],
            models=begin.models,
            watch=send,
        )


def main() -> NoReturn:
    parser = argparse.ArgumentParser()
    parser.add_argument("--to", required=True)
    parser.add_argument("--parent", type=int, required=True)
    given = parser.parse_args()
    if not set_parent_death_signal(given.parent, signal.SIGKILL):
        raise SystemExit(0)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    with connection_of(given.to) as connection:
        begin = to_program(connection.recv_bytes(PACKET_BYTES))
        assert isinstance(begin, Begin)
        os.nice(begin.nice)
        try:
            compute(connection, begin)
        except TerrafixError as error:
            connection.send_bytes(pack(Failed(str(error), error.exit_code)))
        except (EOFError, ConnectionError):
            raise SystemExit(0) from None
        else:
            connection.send_bytes(pack(Done()))
    raise SystemExit(0)


if __name__ == "__main__":
    main()
