"""The benchmark of damaged records leaves folders alone that it has not made."""

from pathlib import Path

import pytest

from flight_records import live_messages, write_record
from terrafix.core.errors import OutputError
from terrafix_tools.bench.record_damage import bench


def test_existing_folder_is_refused_and_stays(tmp_path: Path) -> None:
    write_record(tmp_path / "flight.mcap", live_messages())
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "own.txt").write_text("mine")
    with pytest.raises(OutputError, match="exists; give a new folder"):
        bench(tmp_path, tmp_path / "out", kills_wanted=0, cuts_wanted=0)
    assert (tmp_path / "out" / "own.txt").read_text() == "mine"
