"""Flights under the kernels of other processors: which rows can run, figures, and distances between two answers."""

import json
from pathlib import Path

import pytest

from terrafix.core.errors import UsageError
from terrafix_lab.bench.processors import DEFAULT_ROWS, ROWS, _known, compare, complete, fly, impossible, tables
from terrafix_tools.estimates import COLUMNS

M_PER_DEGREE = 111_195.0  # of latitude, sphere; the ellipsoid differs by less than 1 %


def flown(folder: Path, lat_deg: float, refined_deg: float, final_deg: float) -> None:
    """A complete flight of two frames at these latitudes; the second one has no refined position."""
    folder.mkdir(parents=True)
    cells = dict.fromkeys(COLUMNS, "") | {"lat_deg": str(lat_deg), "lon_deg": "8", "refined_lon_deg": "8"}
    rows = [cells | {"file": "a", "refined_lat_deg": str(refined_deg)}, cells | {"file": "b", "refined_lon_deg": ""}]
    for name, table in (
        ("estimates.csv", rows),
        ("finalised.csv", [row | {"lat_deg": str(final_deg)} for row in rows]),
    ):
        lines = [",".join(COLUMNS), *(",".join(row[c] for c in COLUMNS) for row in table)]
        (folder / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
    errors = {f"{prefix}{key}": 2.0 for prefix in ("", "refined_", "finalised_") for key in ("median_m", "p95_m")}
    (folder / "evaluation.json").write_text(json.dumps({"finalised": 2, **errors}), encoding="utf-8")
    focal = {"what": "focal length", "before": 684.0, "after": 507.0, "after_sigma": 23.0}
    (folder / "finalised.json").write_text(json.dumps({"flights": [{"before_after": [focal]}]}), encoding="utf-8")


def test_distances_are_between_the_frames_that_both_have(tmp_path: Path) -> None:
    flown(tmp_path / "own" / "village-1", 48.0, 48.0, 48.0)
    flown(tmp_path / "weakest" / "village-1", 48.0 + 1 / M_PER_DEGREE, 48.0, 48.0 + 3 / M_PER_DEGREE)
    found = compare(tmp_path, ["own", "weakest"], ["village-1"])
    apart = found["distances"]["village-1"]["own, weakest"]
    assert apart["immediate"]["max_m"] == pytest.approx(1.0, rel=0.01)
    assert apart["refined"] == {"frames": 1, "only_one": 0, "median_m": 0.0, "p95_m": 0.0, "max_m": 0.0}
    assert apart["finalised"]["median_m"] == pytest.approx(3.0, rel=0.01)
    assert found["figures"]["village-1"]["own"]["focal_px"]["after"] == 507.0
    assert found["figures"]["village-1"]["own"]["map_points_px"] is None
    assert [table.row_count for table in tables(found)] == [2, 1]


def test_a_flight_is_complete_when_its_finalised_track_was_evaluated(tmp_path: Path) -> None:
    flown(tmp_path / "out", 48.0, 48.0, 48.0)
    assert complete(tmp_path / "out")
    (tmp_path / "out" / "evaluation.json").write_text("{}", encoding="utf-8")
    assert not complete(tmp_path / "out")
    assert compare(tmp_path.parent, [tmp_path.name], ["out"])["figures"] == {"out": {}}


def test_a_row_says_what_the_processor_lacks() -> None:
    assert impossible(ROWS["skylakex"], frozenset({"avx2", "fma"})) is not None
    assert "avx512f" in (impossible(ROWS["skylakex"], frozenset({"avx512bw", "avx512dq", "avx512vl"})) or "")
    assert impossible(ROWS["nehalem"], frozenset()) is None
    assert set(DEFAULT_ROWS) <= set(ROWS)


def test_an_unknown_row_is_named() -> None:
    with pytest.raises(UsageError, match="--row cray: unknown"):
        _known("--row", ["own", "cray"], ROWS)


def test_a_flight_that_fails_is_the_error_of_its_command(tmp_path: Path) -> None:
    with pytest.raises(Exception, match="replay failed") as caught:
        fly(tmp_path / "absent", ROWS["weakest"], tmp_path / "out")
    assert type(caught.value).__name__ == "SourceError"
