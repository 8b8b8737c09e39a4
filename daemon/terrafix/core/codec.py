"""Messages as bytes: msgpack between processes, JSON for people. No pickle: bytes from outside never run code."""

from typing import Any

import msgspec

from terrafix.messages import AnyMessage, Message


def _plain(value: Any) -> Any:
    """numpy scalars that slipped into a message become plain numbers; anything else is a bug of the sayer."""
    import numpy as np  # only here: the supervisor speaks, too, and has no arrays

    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be part of a message")


_msgpack_encoder = msgspec.msgpack.Encoder(enc_hook=_plain)
_msgpack_decoder = msgspec.msgpack.Decoder(AnyMessage)
_json_encoder = msgspec.json.Encoder(enc_hook=_plain)
_json_decoder = msgspec.json.Decoder(AnyMessage)


def encode(message: Message) -> bytes:
    return _msgpack_encoder.encode(message)


def decode(data: bytes | memoryview) -> Message:
    """Raises msgspec.ValidationError or DecodeError when ``data`` is no message of messages.py."""
    return _msgpack_decoder.decode(data)


def encode_json(message: Message) -> bytes:
    return _json_encoder.encode(message)


def decode_json(data: bytes | str) -> Message:
    return _json_decoder.decode(data)
