"""The two commands of the README: CI runs them; without their requirements they state what is missing."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
README = (ROOT / "README.md").read_text(encoding="utf-8")
DEMO, CHECK = "sh scripts/demo", "sh scripts/check"
TOOLS = ("cat", "cksum", "dirname", "pwd", "sh")  # system tools that the scripts need before Python is found


def lines(path: Path) -> list[str]:
    return [line for line in path.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]


def clone(folder: Path) -> Path:
    """The files of a clone that the set-up commands need."""
    shutil.copytree(ROOT / "scripts", folder / "scripts")
    (folder / "tools").mkdir()
    for name in ("pyproject.toml", "requirements.lock", "tools/pyproject.toml"):
        shutil.copy(ROOT / name, folder / name)
    return folder


def path_with(folder: Path, **programs: str) -> str:
    """A PATH that contains only TOOLS and the given shell scripts."""
    folder.mkdir()
    for tool in TOOLS:
        found = shutil.which(tool)
        if found is not None:
            (folder / tool).symlink_to(found)
    for name, body in programs.items():
        script = folder / name.replace("_", ".")
        script.write_text(f"#!/bin/sh\n{body}\n", encoding="utf-8")
        script.chmod(0o755)
    return str(folder)


def attempt(tmp_path: Path, command: str, **programs: str) -> subprocess.CompletedProcess[str]:
    repository = clone(tmp_path / "clone")
    path = path_with(tmp_path / "bin", **programs)
    return subprocess.run(
        command.split(), cwd=repository, env={"PATH": path}, capture_output=True, text=True, timeout=60
    )


def test_the_readme_has_exactly_two_set_up_commands() -> None:
    section = README.split("## Two commands")[1].split("\n## ")[0]
    assert re.findall(r"```sh\n(.*?)```", section, flags=re.S) == [f"{DEMO}\n", f"{CHECK}\n"]
    assert README.count("```sh\n") == 2


def test_ci_runs_only_the_check_command() -> None:
    ci = ROOT / ".ci" / "run"
    assert os.access(ci, os.X_OK)
    assert lines(ci) == ["set -eu", 'cd "$(dirname "$0")/.."', CHECK]


@pytest.mark.parametrize("script", ["demo", "check", "install", "lock", "nightly", "pythons", "site"])
def test_scripts_have_no_shell_syntax_errors(script: str) -> None:
    done = subprocess.run(["sh", "-n", f"scripts/{script}"], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("command", [DEMO, CHECK])
def test_without_python_one_line_states_what_to_install(command: str, tmp_path: Path) -> None:
    done = attempt(tmp_path, command)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1 and "needs Python 3.11 to 3.14; found none" in done.stderr


@pytest.mark.parametrize("version", ["3.10.12", "3.15.2"])
def test_a_python_that_is_too_old_or_too_new_is_stated_in_the_error(version: str, tmp_path: Path) -> None:
    """The program is this Python that says that it is another one."""
    says = f"import sys; sys.version_info = ({version.replace('.', ', ')})"
    other = f'if [ "$1" = --version ]; then echo "Python {version}"; else exec {sys.executable} -c "{says}; $2"; fi'
    done = attempt(tmp_path, DEMO, python3=other)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1 and f"needs Python 3.11 to 3.14; found Python {version}." in done.stderr


def test_a_python_without_the_venv_module_is_detected(tmp_path: Path) -> None:
    bare = 'case "$2" in *ensurepip*) exit 1 ;; *print*) echo python3.11-venv ;; esac'
    done = attempt(tmp_path, CHECK, python3_11=bare)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "venv module is missing" in done.stderr and "apt install python3.11-venv" in done.stderr


def test_a_python_that_is_not_to_be_had_is_a_row_with_the_reason(tmp_path: Path) -> None:
    tools = {name: f'exec {shutil.which(name)} "$@"' for name in ("mkdir", "date")}
    done = attempt(tmp_path, "sh scripts/pythons 3.12 3.14", **tools, id="echo 1000")
    assert done.returncode == 0, done.stderr
    assert "| 3.12 | not to be had here: no python3.12 with venv on the PATH | | | |\n" in done.stdout
    assert "python3.14 with venv on the PATH, and no root rights or no debootstrap for sid |" in done.stdout


def test_commands_and_options_in_the_readme_exist() -> None:
    from typer.testing import CliRunner

    from terrafix_tools.cli import app

    used = re.findall(r"^\.venv/bin/terrafix ((?:map |sim )?\w+)(.*)$", README, flags=re.M)
    assert {command for command, _ in used} == {"map build", "replay", "evaluate", "report", "run", "accept", "sim fly"}
    for command, rest in used:
        shown = CliRunner().invoke(app, [*command.split(), "--help"], env={"COLUMNS": "300"})
        assert shown.exit_code == 0
        for option in re.findall(r"--[a-z-]+", rest):
            assert option in shown.output, f"terrafix {command} has no {option}"
