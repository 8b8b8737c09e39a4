"""Benchmark of kidnapped starts: counts of the table, truth file and its errors."""

from pathlib import Path

import pytest

from terrafix.core.errors import SourceError
from terrafix_tools.bench.search import kidnapped
from terrafix_tools.bench.search.kidnapped import Try, row


def attempt(found_after: int | None, wrong: int = 0) -> Try:
    return Try(3, found_after, None if found_after is None else 4.0, wrong, 10, 1.2, 0.5)


def test_a_row_counts_found_tries_and_tries_with_a_wrong_position() -> None:
    assert row("somewhere", [attempt(2), attempt(None, wrong=3), attempt(9), attempt(4)]).split() == [
        "somewhere", "4", "3", "after", "4", "(worst", "9)", "1", "1.2", "0.50",
    ]  # fmt: skip
    assert "never" in row("nowhere", [attempt(None)])


def test_a_flight_without_usable_truth_raises_a_source_error(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no usable truth"):
        kidnapped._truth(tmp_path)
    (tmp_path / "truth.csv").write_text("file,lat_deg\n1.jpg,3\n", encoding="utf-8")
    with pytest.raises(SourceError, match="no usable truth"):
        kidnapped._truth(tmp_path)
    (tmp_path / "truth.csv").write_text("file,lat_deg,lon_deg\n1.jpg,3,4.5\n", encoding="utf-8")
    assert kidnapped._truth(tmp_path) == {"1.jpg": (3.0, 4.5)}


def test_distances_are_horizontal_ground_distances() -> None:
    assert kidnapped._apart_m((50.0, 8.0), (50.001, 8.0)) == pytest.approx(111.2, abs=0.2)
