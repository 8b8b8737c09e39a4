"""Options of the command `terrafix` before the name of a command."""

import subprocess
import sys

from typer.testing import CliRunner

from terrafix import __version__
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
