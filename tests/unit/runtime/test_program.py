"""The program `terrafix`: what is begun before the command line is there, and who gets it."""

import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import pytest

from terrafix_tools import program

RUN = ["terrafix", "run", "--map", "area.gpkg", "--source", "/dev/video0"]


class ForkServer:
    """Says when it was begun and closed."""

    made: "list[ForkServer]"
    said: list[str]

    def __init__(self) -> None:
        self.made.append(self)
        self.said.append("typer" if "terrafix_tools.cli" in sys.modules else "begun first")

    def __enter__(self) -> "ForkServer":
        return self

    def __exit__(self, *_: object) -> None:
        self.said.append("closed")


@pytest.fixture
def fork_server(monkeypatch: pytest.MonkeyPatch) -> type[ForkServer]:
    ForkServer.made, ForkServer.said = [], []
    monkeypatch.setattr("terrafix.runtime.fork_server.ForkServer", ForkServer)
    return ForkServer


def test_a_run_gets_the_nursery_that_was_begun_before_the_command_line(
    fork_server: type[ForkServer], monkeypatch: pytest.MonkeyPatch
) -> None:
    got: dict[str, Any] = {}

    def run(**wanted: Any) -> int:
        got.update(wanted, closed="closed" in fork_server.said)
        return 3

    monkeypatch.setattr("terrafix.runtime.supervisor.run", run)
    monkeypatch.setattr("terrafix.runtime.supervisor.killed_just_now", lambda **_: SimpleNamespace(ground_amsl_m=320.0))
    monkeypatch.delitem(sys.modules, "terrafix_tools.cli", raising=False)
    monkeypatch.setattr(sys, "argv", RUN)
    with pytest.raises(SystemExit) as ended:
        program.main()
    assert ended.value.code == 3
    assert got["fork_server"] is fork_server.made[0] and not got["closed"] and got["ground_amsl_m"] == 320.0
    assert fork_server.said == ["begun first", "closed"]


def test_a_run_that_cannot_begin_leaves_no_nursery(
    fork_server: type[ForkServer], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["terrafix", "run", "--mapp", "area.gpkg"])
    with pytest.raises(SystemExit) as ended:
        program.main()
    assert ended.value.code == 2 and "--mapp" in capsys.readouterr().err
    assert fork_server.said[-1] == "closed"


def test_other_commands_have_no_nursery(fork_server: type[ForkServer], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["terrafix", "--help"])
    with pytest.raises(SystemExit):
        program.main()
    assert fork_server.made == []


def test_the_program_itself_loads_no_command_line() -> None:
    code = """
import sys
import terrafix_tools.program, terrafix.runtime.fork_server
print("typer" in sys.modules, "numpy" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]
