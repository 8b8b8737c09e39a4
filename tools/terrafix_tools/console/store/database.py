"""The database file: opened, made, and its transactions."""

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from terrafix.core.errors import OutputError
from terrafix_tools.console.store import schema

FILE = "console.sqlite"
EARLIER = (0, 1, 2)  # versions of tables that are brought up to date; 0: none, or of the time before versions
BUSY_MS = 10_000  # time-out of a write that waits for that of another process


class Database:
    """Transactions on one SQLite file in WAL mode, from any thread and several processes."""

    def __init__(self, engine: sa.Engine) -> None:
        self._engine = engine

    @contextmanager
    def read(self) -> Iterator[sa.Connection]:
        with self._engine.connect() as connection:
            yield connection

    @contextmanager
    def write(self) -> Iterator[sa.Connection]:
        """All of it is committed, or nothing. Takes the write lock at its beginning, so that what it reads first cannot
        change meanwhile. Raises OutputError: the disk is full."""
        with self._engine.connect() as connection:
            try:
                connection.exec_driver_sql("BEGIN IMMEDIATE")
                yield connection
                connection.exec_driver_sql("COMMIT")
            except sa.exc.OperationalError as error:
                _roll_back(connection)
                if is_full(error):
                    raise OutputError("the disk of the console is full; delete flights or free space") from None
                raise
            except BaseException:
                _roll_back(connection)
                raise

    def close(self) -> None:
        self._engine.dispose()


def open_database(folder: Path, *, durable: bool = True) -> Database:
    """Opens ``folder``/FILE and makes its tables where it has none. ``durable``: a commit waits for the disk; else it
    survives the end of the process, but maybe not a loss of power. Raises OutputError, also for a later version."""
    file = folder / FILE
    engine = sa.create_engine(f"sqlite:///{file}", connect_args={"check_same_thread": False, "timeout": BUSY_MS / 1e3})

    def settings(connection: Any, _record: Any) -> None:
        connection.isolation_level = None  # transactions begin where `write` begins them
        for setting in (
            "journal_mode=WAL",
            f"synchronous={'FULL' if durable else 'NORMAL'}",
            "foreign_keys=ON",
            f"busy_timeout={BUSY_MS}",
        ):
            connection.execute(f"PRAGMA {setting}")

    sa.event.listen(engine, "connect", settings)
    try:
        with engine.connect() as connection:
            version = connection.exec_driver_sql("PRAGMA user_version").scalar()
            if version in EARLIER:
                connection.exec_driver_sql("BEGIN IMMEDIATE")  # another process may open it now
                schema.metadata.create_all(connection)  # tables that are there already stay as they are
                columns = [column["name"] for column in sa.inspect(connection).get_columns("fragments")]
                if "state" not in columns:
                    connection.exec_driver_sql(schema.SINCE_1)
                connection.exec_driver_sql(f"PRAGMA user_version = {schema.VERSION}")
                connection.exec_driver_sql("COMMIT")
    except (sa.exc.DatabaseError, sqlite3.DatabaseError) as error:
        engine.dispose()
        raise OutputError(f"{file}: cannot be opened ({error.args[0]}); name another folder with --data") from None
    if version not in (*EARLIER, schema.VERSION):
        engine.dispose()
        raise OutputError(
            f"{file}: has tables of version {version}, this Terrafix knows {schema.VERSION}; "
            "update Terrafix, or name another folder with --data"
        )
    return Database(engine)


def is_full(error: sa.exc.OperationalError) -> bool:
    """Whether a statement failed because the disk is full."""
    return getattr(error.orig, "sqlite_errorname", "") in ("SQLITE_FULL", "SQLITE_IOERR_WRITE")


def _roll_back(connection: sa.Connection) -> None:
    if connection.connection.dbapi_connection is not None and connection.connection.dbapi_connection.in_transaction:
        connection.exec_driver_sql("ROLLBACK")
