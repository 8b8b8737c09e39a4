"""Checkpoint: the state of a process in a file of the run folder, read by the next instance of the process.

The run folder is in shared memory, so that a checkpoint survives the process and costs no disk access."""

from contextlib import suppress
from pathlib import Path
from typing import Generic, Literal, TypeVar

import msgspec

from terrafix.core import logs
from terrafix.runtime.run_dir import write_atomic

T = TypeVar("T", bound=msgspec.Struct)
Encoding = Literal["msgpack", "json"]


class CheckpointFile(Generic[T]):
    """One struct of type ``kind`` in the file ``path``; None: nothing is read or written."""

    def __init__(self, path: Path | None, kind: type[T], encoding: Encoding = "msgpack") -> None:
        self._path = path
        self._encode = msgspec.json.encode if encoding == "json" else msgspec.msgpack.encode
        self._decoder: msgspec.json.Decoder[T] | msgspec.msgpack.Decoder[T] = (
            msgspec.json.Decoder(kind) if encoding == "json" else msgspec.msgpack.Decoder(kind)
        )

    def load(self) -> T | None:
        """None: there is no checkpoint, or it is damaged or of another version, which is logged as a warning."""
        if self._path is None:
            return None
        try:
            return self._decoder.decode(self._path.read_bytes())
        except FileNotFoundError:
            return None
        except (OSError, msgspec.DecodeError) as error:
            logs.get().warning("checkpoint ignored", file=str(self._path), reason=str(error))
            return None

    def save(self, state: T) -> None:
        """Atomic. When memory is full the previous checkpoint stays: a process must not fail in flight for it."""
        if self._path is not None:
            with suppress(OSError):
                write_atomic(self._path, self._encode(state))

    def remove(self) -> None:
        if self._path is not None:
            self._path.unlink(missing_ok=True)
