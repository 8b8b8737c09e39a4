"""Benchmark of the search on a small map: all lines are measured, and a file that is not a map is reported."""

import json
import sys
from pathlib import Path

import pytest

from terrafix_tools.bench.growth import map_size
from terrafix_tools.bench.search import search_cost
from terrafix_tools.mapping.build import build


@pytest.mark.slow
def test_the_search_benchmark_measures_every_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    map_size._draw(tmp_path / "map.tif", 800)
    package, out = tmp_path / "map.gpkg", tmp_path / "out.json"
    build(tmp_path / "map.tif", package)
    monkeypatch.setattr(sys, "argv", ["searching", str(package), "--json", str(out)])
    search_cost.main()
    written = json.loads(out.read_text(encoding="utf-8"))
    assert len(written) == len(capsys.readouterr().out.splitlines()) - 1 == 4
    assert all(line["first_cpu_s"] > 0.0 and line["next_s"] > 0.0 for line in written)
    monkeypatch.setattr(sys, "argv", ["searching", str(out)])
    with pytest.raises(SystemExit, match=r"out\.json"):
        search_cost.main()
