"""What a search costs, on a small map: every line is measured, and a file that is no map is told."""

import json
import sys
from pathlib import Path

import pytest

from terrafix_tools.bench import map_size, searching
from terrafix_tools.mapping.build import build


@pytest.mark.slow
def test_every_line_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    map_size._draw(tmp_path / "map.tif", 800)
    package, out = tmp_path / "map.gpkg", tmp_path / "out.json"
    build(tmp_path / "map.tif", package)
    monkeypatch.setattr(sys, "argv", ["searching", str(package), "--json", str(out)])
    searching.main()
    written = json.loads(out.read_text(encoding="utf-8"))
    assert len(written) == len(capsys.readouterr().out.splitlines()) - 1 == 4
    assert all(line["first_cpu_s"] > 0.0 and line["next_s"] > 0.0 for line in written)
    monkeypatch.setattr(sys, "argv", ["searching", str(out)])
    with pytest.raises(SystemExit, match=r"out\.json"):
        searching.main()
