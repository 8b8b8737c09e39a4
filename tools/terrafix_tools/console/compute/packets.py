"""What the process of a flight and its program on a cluster send each other, as msgpack; the program asks."""

import msgspec

from terrafix.core.codec import decode, encode
from terrafix.messages import Message, Origin
from terrafix_tools.console.compute.source import Upload


class Begin(msgspec.Struct, frozen=True, tag=True):
    """The first packet, to the program. ``width``, ``height``: of the images as they are stored, pixels."""

    origin: Origin
    name: str
    width: int
    height: int
    map_path: str
    out: str
    nice: int
    configs: list[str]
    models: list[str]


class NextUpload(msgspec.Struct, frozen=True, tag=True):
    """From the program. The answer is an Upload, or NoMore; it comes when the image is there."""


class NoMore(msgspec.Struct, frozen=True, tag=True):
    """The flight is complete."""


class Step(msgspec.Struct, frozen=True, tag=True):
    """From the program: the messages of the origin, of a frame or of the end, encoded."""

    messages: list[bytes]


class Failed(msgspec.Struct, frozen=True, tag=True):
    """From the program: the flight cannot be computed."""

    why: str
    exit_code: int


class Done(msgspec.Struct, frozen=True, tag=True):
    """From the program: all is computed and written."""


ToProgram = Begin | Upload | NoMore
FromProgram = NextUpload | Step | Failed | Done
_to_program = msgspec.msgpack.Decoder(ToProgram)
_from_program = msgspec.msgpack.Decoder(FromProgram)
pack = msgspec.msgpack.encode
to_program, from_program = _to_program.decode, _from_program.decode


def step_of(messages: list[Message]) -> Step:
    return Step([encode(message) for message in messages])


def messages_of(step: Step) -> list[Message]:
    return [decode(data) for data in step.messages]
