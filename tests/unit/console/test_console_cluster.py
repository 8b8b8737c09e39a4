"""A console whose flights a Dask cluster should compute, and which none answers. Flights: test_console_flights.py."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from terrafix_tools.cli import app
from terrafix_tools.parallel.scheduler import check_scheduler


def test_a_service_whose_scheduler_does_not_answer_does_not_start(tmp_path: Path) -> None:
    words = ["serve", "--data", str(tmp_path), "--scheduler", "tcp://127.0.0.1:1"]
    refused = CliRunner().invoke(app, words)
    assert "no Dask scheduler answers there" in str(refused.exception)
    with pytest.raises(Exception, match="write tcp://host:port"):
        check_scheduler("127.0.0.1:8786")
