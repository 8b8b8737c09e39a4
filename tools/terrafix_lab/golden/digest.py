"""SHA-256 over the messages of a run, one digest per type, in the order of publication.

Like openpilot's process_replay: a change that must not alter behaviour leaves every digest unchanged, and a changed
digest names the message type that differs.
"""

import hashlib
from dataclasses import dataclass, field
from typing import Any

import msgspec

from terrafix.messages import Message

# Set by the process shell from the computer's clock.
NOT_COMPARED = ("emitted_at_ns",)


class Digest(msgspec.Struct, frozen=True):
    sha256: str
    count: int


@dataclass
class _Stream:
    count: int = 0
    hash: Any = field(default_factory=hashlib.sha256)

    def take(self, data: bytes) -> None:
        self.count += 1
        self.hash.update(len(data).to_bytes(8, "little") + data)


class Digests:
    """The digests of one case, keyed by the tag of a message, which stays when its class is renamed, or by a given
    name.
    """

    def __init__(self) -> None:
        self._streams: dict[str, _Stream] = {}

    def take(self, message: Message) -> None:
        fixed = {name: 0 for name in NOT_COMPARED if name in message.__struct_fields__}
        compared = msgspec.structs.replace(message, **fixed) if fixed else message
        self.take_bytes(str(message.__struct_config__.tag), msgspec.msgpack.encode(compared))

    def take_bytes(self, name: str, data: bytes) -> None:
        self._streams.setdefault(name, _Stream()).take(data)

    def result(self) -> dict[str, Digest]:
        streams = sorted(self._streams.items())
        return {name: Digest(stream.hash.hexdigest(), stream.count) for name, stream in streams}


References = dict[str, dict[str, Digest]]  # case -> stream -> digest


def differences(expected: dict[str, Digest], found: dict[str, Digest]) -> list[str]:
    """Returns one line for each stream that differs; empty when all are equal."""
    lines = []
    for name in sorted(expected.keys() | found.keys()):
        before, now = expected.get(name), found.get(name)
        if before is None or now is None:
            known = before or now
            assert known is not None
            lines.append(f"{name}: {'new' if before is None else 'gone'} ({known.count})")
        elif before != now:
            counts = f"{before.count} -> {now.count}" if before.count != now.count else f"{now.count}, other contents"
            lines.append(f"{name}: {counts}")
    return lines
