"""The order in which a process handled its inputs: written by the live shell, followed by a replay of the record."""

import zlib

from terrafix.core import codec
from terrafix.messages import InputOrder, Message

MAX_INPUTS = 256  # of one InputOrder: bounds the loss when a process without outputs is killed


def key_of(message: Message) -> int:
    """CRC-32 of the encoded message. Equal messages have equal keys, whether they came by the bus or from a record."""
    return zlib.crc32(codec.encode(message))


class InputLog:
    """Collects the inputs of one instance of a process."""

    def __init__(self, process: str, began_ns: int) -> None:
        self._process, self._began_ns = process, began_ns
        self._inputs: list[int] = []

    def add(self, message: Message) -> None:
        """Call it for each message that the node handles, in order."""
        self._inputs.append(key_of(message))

    @property
    def full(self) -> bool:
        """Whether the inputs have to be published although no output followed."""
        return len(self._inputs) >= MAX_INPUTS

    def take(self, now_ns: int) -> InputOrder | None:
        """-> the inputs since the last call, or None without any."""
        if not self._inputs:
            return None
        inputs, self._inputs = self._inputs, []
        return InputOrder(t_ns=now_ns, process=self._process, began_ns=self._began_ns, inputs=inputs)
