"""The program `terrafix`: the fork server that starts before the command line is imported, and its use."""

import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import pytest

from terrafix.runtime.supervisor import RunOptions
from terrafix_tools import program

RUN = ["terrafix", "run", "--map", "area.gpkg", "--source", "/dev/video0"]


class ForkServer:
    """Records when it is started and closed."""

    created: "list[ForkServer]"
    events: list[str]

    def __init__(self) -> None:
        self.created.append(self)
        self.events.append("after typer" if "terrafix_tools.cli" in sys.modules else "started first")

    def __enter__(self) -> "ForkServer":
        return self

    def __exit__(self, *_: object) -> None:
        self.events.append("closed")


@pytest.fixture
def fork_server(monkeypatch: pytest.MonkeyPatch) -> type[ForkServer]:
    ForkServer.created, ForkServer.events = [], []
    monkeypatch.setattr("terrafix.runtime.fork_server.ForkServer", ForkServer)
    return ForkServer


def test_a_run_uses_the_fork_server_started_before_the_command_line(
    fork_server: type[ForkServer], monkeypatch: pytest.MonkeyPatch
) -> None:
    got: dict[str, Any] = {}

    def run(options: RunOptions, *_: object, **arguments: Any) -> int:
        got.update(arguments, ground_amsl_m=options.ground_amsl_m, closed="closed" in fork_server.events)
        return 3

    spec = SimpleNamespace(ground_amsl_m=320.0)
    monkeypatch.setattr("terrafix.runtime.supervisor.run", run)
    monkeypatch.setattr("terrafix.runtime.supervisor.recently_killed_spec", lambda _: spec)
    monkeypatch.delitem(sys.modules, "terrafix_tools.cli", raising=False)
    monkeypatch.setattr(sys, "argv", RUN)
    with pytest.raises(SystemExit) as ended:
        program.main()
    assert ended.value.code == 3
    assert got["fork_server"] is fork_server.created[0] and not got["closed"] and got["ground_amsl_m"] == 320.0
    assert fork_server.events == ["started first", "closed"]


def test_a_run_with_wrong_arguments_closes_the_fork_server(
    fork_server: type[ForkServer], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["terrafix", "run", "--mapp", "area.gpkg"])
    with pytest.raises(SystemExit) as ended:
        program.main()
    assert ended.value.code == 2 and "--mapp" in capsys.readouterr().err
    assert fork_server.events[-1] == "closed"


def test_other_commands_start_no_fork_server(fork_server: type[ForkServer], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["terrafix", "--help"])
    with pytest.raises(SystemExit):
        program.main()
    assert fork_server.created == []


def test_the_program_module_does_not_import_the_command_line() -> None:
    code = """
import sys
import terrafix_tools.program, terrafix.runtime.fork_server
print("typer" in sys.modules, "numpy" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]
