"""Text files of other programs, in whichever encoding they are."""

import codecs
from pathlib import Path

UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


def read_text(path: Path) -> str:
    """Raises OSError, and as `decode_text`."""
    return decode_text(path.read_bytes())


def decode_text(data: bytes) -> str:
    """Text in UTF-8, in UTF-16 with its mark, else in ISO 8859-1, which every byte is.

    Raises UnicodeDecodeError: a mark of UTF-16 and something else behind it."""
    if data.startswith(UTF_16):
        return data.decode("utf-16")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("iso-8859-1")
