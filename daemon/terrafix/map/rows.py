"""Rows of a map package whose columns have the types that the format states; SQLite itself stores any type anywhere."""

import sqlite3
from types import GenericAlias
from typing import TypeVar

import msgspec

Row = TypeVar("Row")


def typed_rows(db: sqlite3.Connection, query: str, row: type[Row]) -> list[Row]:
    """All rows of ``query`` as the tuple type ``row``. Raises sqlite3.DatabaseError: damaged, or another type."""
    found = db.execute(query).fetchall()
    try:
        return msgspec.convert(found, GenericAlias(list, (row,)), builtin_types=(bytes,))
    except msgspec.ValidationError as error:
        raise sqlite3.DataError(f"{error} of {query.rpartition('FROM ')[2]}") from None
