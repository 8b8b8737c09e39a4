"""The layout for Foxglove names topics and fields that records have, and each of its panels is placed once."""

import json
import re
from pathlib import Path
from typing import Any

import msgspec
import pytest
from typer.testing import CliRunner

from terrafix.core.errors import OutputError
from terrafix.recorder.foxglove import FOXGLOVE_CHANNELS
from terrafix.recorder.schema import TYPE_BY_TOPIC
from terrafix_tools.cli import app

LAYOUT = json.loads(
    (Path(__file__).parents[3] / "config" / "foxglove" / "terrafix-layout.json").read_text(encoding="utf-8")
)
PATHS = [path["value"] for config in LAYOUT["configById"].values() for path in config.get("paths", ())]
TOPICS = [
    *(
        config[key]
        for config in LAYOUT["configById"].values()
        for key in ("followTopic", "topicToRender")
        if key in config
    ),
    LAYOUT["configById"]["Image!frames"]["imageMode"]["imageTopic"],
    *LAYOUT["configById"]["Image!frames"]["imageMode"]["annotations"],
    LAYOUT["configById"]["RawMessages!fault"]["topicPath"],
]


@pytest.mark.parametrize("path", PATHS)
def test_a_path_names_a_message_and_its_field(path: str) -> None:
    found = re.fullmatch(r'(/\w+)(?:\{(\w+)=="\w+"\})?\.(\w+)(?:\[\d+\])?(?:\.@sqrt)?', path)
    assert found is not None
    fields = {field.name for field in msgspec.structs.fields(TYPE_BY_TOPIC[found.group(1)])}
    assert {name for name in (found.group(2), found.group(3)) if name} <= fields


def test_topics_are_those_of_a_record() -> None:
    assert set(TOPICS) <= {*TYPE_BY_TOPIC, *FOXGLOVE_CHANNELS} and len(TOPICS) == 5


def test_each_panel_is_placed_once() -> None:
    def placed(node: Any) -> list[str]:
        return [node] if isinstance(node, str) else placed(node["first"]) + placed(node["second"])

    assert sorted(placed(LAYOUT["layout"])) == sorted(LAYOUT["configById"])


def test_the_command_writes_the_layout_and_not_over_another_file(tmp_path: Path) -> None:
    out = tmp_path / "layout.json"
    assert CliRunner().invoke(app, ["log", "layout", str(out)]).exit_code == 0
    assert json.loads(out.read_text()) == LAYOUT
    again = CliRunner().invoke(app, ["log", "layout", str(out)]).exception
    assert isinstance(again, OutputError) and "is not overwritten" in str(again)
