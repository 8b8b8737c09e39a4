"""Systemd: notifications of the service and the journal, by the package systemd-python (extra ``vehicle``).

Without the package notifications are plain datagrams (sd_notify(3)) and log lines go to stdout as JSON, which systemd
forwards to the journal as text. Without systemd neither has an effect."""

import contextlib
import json
import os
import socket
import sys
from typing import Any, TextIO

from terrafix.core.logs import LineStream

SYSLOG_PRIORITY = {"error": 3, "warning": 4, "info": 6, "debug": 7}  # syslog(3)
IDENTIFIER = "terrafix"  # SyslogIdentifier= of the unit


def notify(state: str) -> None:
    """sd_notify(3): READY=1, WATCHDOG=1, STATUS=..., STOPPING=1. An error of systemd must not end a flight: if the
    notifications do not arrive, its watchdog reacts."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    try:
        from systemd import daemon  # type: ignore[attr-defined]  # no stubs
    except ImportError:
        _send_datagram(address, state)
        return
    with contextlib.suppress(OSError):
        daemon.notify(state)


def _send_datagram(address: str, state: str) -> None:
    if address.startswith("@"):
        address = "\0" + address[1:]  # abstract namespace
    kind = socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK
    with socket.socket(socket.AF_UNIX, kind) as sock, contextlib.suppress(OSError):
        sock.sendto(state.encode(), address)


def log_stream(stdout: TextIO | None = None) -> LineStream:
    """Where log lines go: the journal if it is connected to ``stdout`` and the package is there, else ``stdout``."""
    stream = stdout or sys.stdout
    if not _is_journal(stream):
        return stream
    try:
        from systemd import journal  # type: ignore[attr-defined]
    except ImportError:
        return stream
    return JournalStream(journal.send)


def _is_journal(stream: TextIO) -> bool:
    """Whether ``stream`` is the one that systemd has connected to the journal (JOURNAL_STREAM, systemd.exec(5))."""
    try:
        found = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{found.st_dev}:{found.st_ino}"


class JournalStream:
    """Entries of the journal from log lines: ``journalctl TERRAFIX_PROCESS=anchor PRIORITY=3``.

    MESSAGE is the event with its fields; each field is also TERRAFIX_<NAME>."""

    def __init__(self, send: Any) -> None:
        """``send``: systemd.journal.send(MESSAGE, **fields)."""
        self._send = send

    def write(self, text: str) -> None:
        line = json.loads(text)
        event, level, time = line.pop("event"), line.pop("level"), line.pop("time", None)
        details = {k: v for k, v in line.items() if k not in ("process", "t_ns") and v not in ("", None)}
        message = ", ".join((event, *(f"{name} {value}" for name, value in details.items())))
        fields = {f"TERRAFIX_{name.upper()}": str(value) for name, value in line.items()}
        with contextlib.suppress(OSError):
            self._send(
                message,
                SYSLOG_PRIORITY=SYSLOG_PRIORITY.get(level, SYSLOG_PRIORITY["info"]),
                SYSLOG_IDENTIFIER=IDENTIFIER,
                TERRAFIX_EVENT=event,
                TERRAFIX_TIME=str(time),
                **fields,
            )

    def flush(self) -> None:
        pass
