"""Serialisation of messages between processes: msgpack.

No pickle, because unpickling bytes from outside can execute code."""

from typing import Any

import msgspec

from terrafix.messages import AnyMessage, Message


def _numpy_to_python(value: Any) -> Any:
    """Encoder hook: numpy scalar -> Python number. Raises TypeError for any other type, a bug in the publisher."""
    import numpy as np  # imported here because the supervisor publishes messages but must not load numpy

    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be part of a message")


_msgpack_encoder = msgspec.msgpack.Encoder(enc_hook=_numpy_to_python)
_msgpack_decoder = msgspec.msgpack.Decoder(AnyMessage)


def encode(message: Message) -> bytes:
    return _msgpack_encoder.encode(message)


def decode(data: bytes | memoryview) -> Message:
    """Raises msgspec.ValidationError or DecodeError when ``data`` is not a message of messages.py."""
    return _msgpack_decoder.decode(data)
