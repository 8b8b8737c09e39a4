"""The checkpoint mechanism that all processes share (runtime/checkpoint.py)."""

from pathlib import Path
from typing import Literal

import msgspec
import pytest

from terrafix.runtime.checkpoint import CheckpointFile


class State(msgspec.Struct, frozen=True):
    number: int
    place_m: tuple[float, float] | None = None


SAVED = State(7, (1.5, -2.0))


@pytest.mark.parametrize("encoding", ["msgpack", "json"])
def test_a_saved_state_is_restored(tmp_path: Path, encoding: Literal["msgpack", "json"]) -> None:
    file = tmp_path / "some.checkpoint"
    CheckpointFile(file, State, encoding).save(State(1))
    CheckpointFile(file, State, encoding).save(SAVED)
    assert CheckpointFile(file, State, encoding).load() == SAVED
    codec = msgspec.json if encoding == "json" else msgspec.msgpack
    assert codec.decode(file.read_bytes(), type=State) == SAVED
    assert [path.name for path in tmp_path.iterdir()] == ["some.checkpoint"]  # no temporary file


def test_a_missing_checkpoint_is_no_state_and_no_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert CheckpointFile(tmp_path / "none", State).load() is None
    assert CheckpointFile(None, State).load() is None
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("data", [b"", b"\x82\xa6number", msgspec.msgpack.encode({"number": "seven"})])
def test_a_damaged_checkpoint_is_ignored_with_a_stated_error(
    tmp_path: Path, data: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    warnings = list[dict[str, str]]()

    class Log:
        def warning(self, event: str, **values: str) -> None:
            warnings.append({"event": event, **values})

    monkeypatch.setattr("terrafix.core.logs.get", Log)
    file = tmp_path / "some.checkpoint"
    file.write_bytes(data)
    assert CheckpointFile(file, State).load() is None
    (warning,) = warnings
    assert warning["event"] == "checkpoint ignored" and warning["file"] == str(file) and warning["reason"]


def test_a_failed_write_does_not_end_the_process(tmp_path: Path) -> None:
    """Shared memory is full, or the run folder is gone."""
    checkpoint = CheckpointFile(tmp_path / "not there" / "some.checkpoint", State)
    checkpoint.save(SAVED)
    checkpoint.remove()
    assert checkpoint.load() is None
    CheckpointFile(None, State).save(SAVED)


def test_a_removed_checkpoint_is_not_restored(tmp_path: Path) -> None:
    checkpoint = CheckpointFile(tmp_path / "some.checkpoint", State)
    checkpoint.save(SAVED)
    checkpoint.remove()
    checkpoint.remove()
    assert checkpoint.load() is None
