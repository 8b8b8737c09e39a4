"""The benchmark of the times that the requirements promise."""

from pathlib import Path

import pytest
import typer

from terrafix_lab.bench import contract
from terrafix_lab.bench.growth import map_size


@pytest.mark.parametrize(
    ("sweep_s", "unloaded", "code", "words"),
    [(1.1, True, 0, "holds"), (1.3, True, 1, "BROKEN"), (1.1, False, 1, "STILL LOADED")],
)
def test_a_limit_that_does_not_hold_or_a_model_that_stays_loaded_is_exit_code_1(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    sweep_s: float,
    unloaded: bool,
    code: int,
    words: str,
) -> None:
    monkeypatch.setattr(map_size, "measure", lambda _km2, _out: {})
    monkeypatch.setattr(contract, "searched", lambda _package: {"sweep of all headings, one tile": sweep_s})
    monkeypatch.setattr(contract, "started", lambda _models, _work: (2.0, unloaded))
    try:
        contract.bench(tmp_path, models=tmp_path)
        found = 0
    except typer.Exit as stop:
        found = stop.exit_code
    assert found == code and words in capsys.readouterr().out
