"""The help of the command line: groups in the order of a flight, and nothing lost between source and terminal."""

import re
from collections.abc import Iterator
from typing import Any

import pytest
import typer.main
from typer.testing import CliRunner

from terrafix_tools.cli import GROUPS, MODULES, app

ROOT = typer.main.get_command(app)


def commands(command: Any = ROOT, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command with its path."""
    yield path, command
    if hasattr(command, "list_commands"):
        for name in command.list_commands(None):
            yield from commands(command.get_command(None, name), (*path, name))


def words(text: str) -> str:
    """Without spaces, line breaks and the frames of panels."""
    return re.sub(r"[\s│╭╮╰╯─]", "", text)


def test_every_command_is_in_exactly_one_group() -> None:
    grouped = [name for names in GROUPS.values() for name in names]
    assert sorted(grouped) == sorted({"run", "replay", "evaluate", "report", *MODULES})


@pytest.mark.parametrize("flag", ["-h", "--help"])
def test_help_shows_the_groups_in_the_order_of_a_flight(flag: str) -> None:
    shown = CliRunner().invoke(app, [flag], env={"COLUMNS": "100"}).output
    places = [shown.index(f"─ {group} ─") for group in GROUPS]
    assert places == sorted(places)


def test_the_help_of_every_command_shows_its_text_with_brackets() -> None:
    lost = []
    for path, command in commands():
        shown = words(CliRunner().invoke(app, [*path, "-h"], env={"COLUMNS": "200"}).output)
        for item in (command, *command.params):
            text = (getattr(item, "help", None) or "").replace("\\[", "[").split("\f")[0]
            if words(text) not in shown and not getattr(item, "hidden", False):
                lost.append((path, text))
    assert not lost
