"""TOML files of users: bounded in size, depth and numbers, so that no file ends in a traceback or takes the memory."""

import tomllib
from pathlib import Path

MAX_BYTES = 1_000_000  # a thousand times the longest configuration [spec: any bound that no user meets]
MAX_DEPTH = 8  # tables and arrays in each other; no file of this program needs more than 3 [spec: as MAX_BYTES]
MAX_INTEGER = 2**63  # TOML promises 64 bits [spec: TOML 1.0]


class OutOfBoundsError(tomllib.TOMLDecodeError):
    """A file of TOML that is not read."""

    def __init__(self, reason: str) -> None:
        ValueError.__init__(self, reason)  # that of TOMLDecodeError wants a place in the file since Python 3.14


def read_toml(path: Path) -> dict[str, object]:
    """-> the table of a file in UTF-8, with or without byte order mark. Raises OSError, UnicodeDecodeError, and
    tomllib.TOMLDecodeError: not TOML, too large, nested too deeply, or an integer of more than 64 bits."""
    with path.open("rb") as file:
        data = file.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise OutOfBoundsError(f"larger than {MAX_BYTES / 1e6:g} MB")
    try:
        table = tomllib.loads(data.decode("utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError):
        raise
    except RecursionError:
        raise OutOfBoundsError("tables or arrays are nested too deeply") from None
    except ValueError as error:  # an integer of thousands of digits
        raise OutOfBoundsError(str(error)) from None
    _check(table, MAX_DEPTH)
    return table


def _check(value: object, depth: int) -> None:
    """Raises tomllib.TOMLDecodeError."""
    if isinstance(value, int) and not -MAX_INTEGER <= value < MAX_INTEGER:
        raise OutOfBoundsError("an integer has more than 64 bits")
    if not isinstance(value, dict | list):
        return
    if depth == 0:
        raise OutOfBoundsError("tables or arrays are nested too deeply")
    for inner in value.values() if isinstance(value, dict) else value:
        _check(inner, depth - 1)
