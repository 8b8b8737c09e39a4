"""Notifications and journal of systemd: with the package systemd-python, and without it."""

import io
import json
import os
import socket
import sys
import types
from pathlib import Path
from typing import Any

import pytest

from terrafix.core import logs
from terrafix.runtime import systemd


def test_without_systemd_a_notification_has_no_effect(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    systemd.notify("READY=1")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody listens"))
    systemd.notify("READY=1")


@pytest.mark.parametrize("abstract", [False, True], ids=["path", "abstract"])
@pytest.mark.parametrize("with_package", [False, True], ids=["plain", "systemd-python"])
def test_a_notification_arrives_at_the_socket_of_systemd(
    abstract: bool, with_package: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    if with_package:
        pytest.importorskip("systemd.daemon")
    else:
        monkeypatch.setitem(sys.modules, "systemd", None)
    name = f"@terrafix-{os.getpid()}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind("\0" + name[1:] if abstract else name)
        listener.settimeout(5.0)
        monkeypatch.setenv("NOTIFY_SOCKET", name)
        systemd.notify("WATCHDOG=1\nSTATUS=flying")
        assert listener.recv(1000) == b"WATCHDOG=1\nSTATUS=flying"


class Journal(types.ModuleType):
    """Stands for systemd.journal."""

    def __init__(self) -> None:
        super().__init__("systemd.journal")
        self.entries: list[tuple[str, dict[str, Any]]] = []

    def send(self, message: str, **fields: Any) -> None:
        self.entries.append((message, fields))


def test_in_the_journal_a_line_has_its_priority_and_a_field_for_each_of_its_values() -> None:
    journal = Journal()
    writer = logs.configure("INFO", "recorder", systemd.JournalStream(journal.send))
    logs.get().error("recording stopped", reason="disk full", todo="make room")
    writer.close()
    ((message, fields),) = journal.entries
    assert message == "recording stopped, reason disk full, todo make room"
    assert fields["PRIORITY"] == 3 and fields["SYSLOG_IDENTIFIER"] == "terrafix"
    assert (fields["TERRAFIX_PROCESS"], fields["TERRAFIX_EVENT"]) == ("recorder", "recording stopped")
    assert (fields["TERRAFIX_REASON"], fields["TERRAFIX_TODO"]) == ("disk full", "make room")
    assert int(fields["TERRAFIX_T_NS"]) > 0


def test_the_journal_is_used_only_where_stdout_is_connected_to_it_and_the_package_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = types.ModuleType("systemd")
    package.journal = Journal()  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "systemd", package)
    monkeypatch.setitem(sys.modules, "systemd.journal", package.journal)  # type: ignore[attr-defined]
    with (tmp_path / "stdout").open("w") as stdout:
        status = os.fstat(stdout.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
        assert isinstance(systemd.log_stream(stdout), systemd.JournalStream)
        monkeypatch.setitem(sys.modules, "systemd", None)
        assert systemd.log_stream(stdout) is stdout
        monkeypatch.setitem(sys.modules, "systemd", package)
        monkeypatch.setenv("JOURNAL_STREAM", "1:2")
        assert systemd.log_stream(stdout) is stdout
    no_descriptor = io.StringIO()
    assert systemd.log_stream(no_descriptor) is no_descriptor


def test_a_line_of_the_plain_log_is_json() -> None:
    stream = io.StringIO()
    writer = logs.configure("INFO", "link", systemd.log_stream(stream))
    logs.get().info("autopilot", firmware="ardupilot")
    writer.close()
    assert json.loads(stream.getvalue())["firmware"] == "ardupilot"
