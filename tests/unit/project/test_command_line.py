"""Options of the command `terrafix` before the name of a command."""

import subprocess
import sys

import pytest
from typer.testing import CliRunner

from terrafix import __version__
from terrafix_tools import cli, program
from terrafix_tools.cli import app


def test_the_version_names_program_and_python() -> None:
    done = CliRunner().invoke(app, ["--version"])
    assert done.exit_code == 0
    assert done.output.startswith(f"terrafix {__version__}")
    assert f"Python {sys.version.split()[0]}" in done.output


def test_without_a_command_the_help_lists_the_commands() -> None:
    done = CliRunner().invoke(app, [])
    assert "Position without GNSS" in done.output and "replay" in done.output and "--version" in done.output


def test_the_shell_completes_the_names_of_commands() -> None:
    command = [sys.executable, "-c", "import sys; sys.argv = ['terrafix']; from terrafix_tools.cli import main; main()"]
    asked = {"_TERRAFIX_COMPLETE": "complete_bash", "COMP_WORDS": "terrafix re", "COMP_CWORD": "1"}
    env = asked | {"PYTHONPATH": ":".join(sys.path), "PATH": "/usr/bin:/bin"}
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=60)
    assert done.stdout.split() == ["replay", "report"]


def test_an_error_is_one_line_whatever_the_name_of_the_file(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["terrafix", "report", "new\nline \udce9"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 4
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("terrafix: new\\nline \\udce9: no such folder")


def test_a_full_disk_is_one_line() -> None:
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "terrafix_tools.program", "--help"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60, check=False)
    assert done.returncode == 6
    assert done.stderr == (
        "terrafix: output cannot be written (No space left on device); free some space, or write elsewhere\n"
    )


def test_ctrl_c_while_the_command_line_is_loaded_is_no_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sys.argv", ["terrafix", "--help"])
    monkeypatch.setattr(cli, "main", interrupted)
    with pytest.raises(SystemExit) as ended:
        program.main()
    assert ended.value.code == 130
