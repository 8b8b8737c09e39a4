"""Scenarios with false inputs over many places: selection of the places, and the table."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from terrafix.core.errors import UsageError
from terrafix_lab.accept import adversary
from terrafix_lab.accept.cases_table import Case, CaseLine, lines_of, markdown
from terrafix_lab.accept.fly import Result
from terrafix_lab.accept.measuring.criteria import PERMANENT, TEMPORARY, unmeasured
from terrafix_lab.accept.measuring.results import JudgedRow, Verdict
from terrafix_lab.accept.run import AcceptOptions
from terrafix_lab.accept.table import conclude
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.flights import make as making


def image(path: Path, *, bands: int = 3, pixel_m: float = 0.5) -> None:
    path.parent.mkdir(exist_ok=True)
    profile = {"driver": "GTiff", "width": 8, "height": 8, "count": bands, "dtype": "uint8", "crs": "EPSG:32632"}
    with rasterio.open(path, "w", transform=Affine(pixel_m, 0, 690_000, 0, -pixel_m, 5_320_000), **profile) as file:
        file.write(np.zeros((bands, 8, 8), np.uint8))


def test_pairs_are_folders_with_two_fine_colour_images_in_both_directions(tmp_path: Path) -> None:
    for name in ("b/dry.tif", "b/wet.tif", "a/1.tif", "a/2.tif", "alone/1.tif"):
        image(tmp_path / name)
    image(tmp_path / "coarse" / "1.tif", pixel_m=5.0)
    image(tmp_path / "coarse" / "2.tif", pixel_m=5.0)
    image(tmp_path / "grey" / "1.tif", bands=1)
    image(tmp_path / "grey" / "2.tif", bands=1)
    found = adversary.pairs(tmp_path)
    assert [p.name for p in found] == ["a", "b", "a, reversed", "b, reversed"]
    assert (found[1].camera.name, found[1].map_path.name) == ("dry.tif", "wet.tif")
    assert (found[3].camera.name, found[3].map_path.name) == ("wet.tif", "dry.tif")
    with pytest.raises(UsageError, match="no folder there has two GeoTIFFs"):
        adversary.pairs(tmp_path / "coarse")


def test_the_other_map_is_of_another_folder_and_every_seed_has_its_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a/1.tif", "a/2.tif", "b/1.tif", "b/2.tif"):
        image(tmp_path / name)
    made: list[tuple[str, int]] = []
    monkeypatch.setattr(adversary, "_make", lambda folder, _, seed: made.append((folder.name, seed)))
    options = AcceptOptions(out=tmp_path, lies=True)
    cases = list(adversary.over_pairs(adversary.pairs(tmp_path)[:3], [1, 2], tmp_path / "out", options))
    assert [c.name for c in cases][:3] == ["a, seed 1", "b, seed 1", "a, reversed, seed 1"] and len(cases) == 6
    assert made[0] == ("a-seed-1", 1) and made[5] == ("a-reversed-seed-2", 2)
    others = [c.options.other_map for c in cases[:3]]
    assert [o.parent.name for o in others if o] == ["b", "a", "b"]
    assert cases[2].options.map_path == tmp_path / "a" / "1.tif" and cases[2].options.lies


def test_the_first_vehicle_that_fits_over_an_image_flies_and_a_flight_is_made_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair, tried = adversary.Pair("a", Path("a/1.tif"), Path("a/2.tif")), []

    def make(out: Path, options: making.FlightOptions, *, progress: bool) -> None:
        tried.append((options.vehicle, options.agl_m, options.seed, options.map_path))
        if options.vehicle is Kind.PLANE:
            raise UsageError("no room")
        out.mkdir()

    monkeypatch.setattr(making, "make", make)
    adversary._make(tmp_path / "a", pair, 7)
    assert (tmp_path / "a").is_dir() and [t[0] for t in tried] == [Kind.PLANE, Kind.COPTER]
    assert tried[1][1:] == (110.0, 7, Path("a/2.tif"))
    adversary._make(tmp_path / "a", pair, 7)
    assert len(tried) == 2
    monkeypatch.setattr(adversary, "FLOWN_BY", ((Kind.PLANE, 130.0),))
    with pytest.raises(UsageError, match=r"1\.tif: no flight has room over it; no room"):
        adversary._make(tmp_path / "b", pair, 7)


def test_a_usage_error_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="nowhere to fly"):
        adversary.main(tmp_path)
    with pytest.raises(UsageError, match="write numbers"):
        adversary.main(tmp_path, generated=True, seeds="one")


def test_the_name_of_a_case_has_flight_and_map(tmp_path: Path) -> None:
    (case,) = adversary.over_flights(["flights/x,maps/y.tif"], tmp_path, AcceptOptions(out=tmp_path))
    assert (case.options.flight, case.options.map_path) == ("flights/x", Path("maps/y.tif"))
    with pytest.raises(UsageError, match="write FLIGHT,MAP"):
        list(adversary.over_flights(["flights/x"], tmp_path, AcceptOptions(out=tmp_path)))


def test_generated_cases_differ_by_their_seed(tmp_path: Path) -> None:
    cases = list(adversary.over_generated([3, 4], tmp_path, AcceptOptions(out=tmp_path)))
    assert [(c.options.seed, c.options.flight) for c in cases] == [(3, ""), (4, "")]
    assert len({c.options.out for c in cases}) == 2


def measured(names: tuple[str, ...], **values: float) -> list[JudgedRow]:
    """Rows of a flight; "false fixes in all" is written false_fixes_in_all. Others are not measured."""
    by_name = {name.replace("_", " "): value for name, value in values.items()}
    rows = []
    for name, row in zip(names, unmeasured("s", names, "why not"), strict=True):
        value = by_name.get(name)
        late = name == "late false fixes" and bool(value)
        never = name == "recovery" and value is None
        verdict = Verdict.BELOW if late or never else Verdict.PASS
        kept = {f: getattr(row, f) for f in row.__struct_fields__}
        rows.append(JudgedRow(**(kept | {"measured": value, "verdict": verdict})))
    return rows


def test_the_table_pools_flights_and_marks_those_that_never_recovered() -> None:
    def line(place: str, **values: float) -> list[CaseLine]:
        rows = measured(TEMPORARY, near_at_all=0.5, **values)
        results = [Result(scenario="s", promise="", rows=rows, frames=100)]
        case = Case(place, AcceptOptions(out=Path("out")))
        return lines_of(case, conclude(results, flight="", map_path="", quick=True, seed=1, whole=False))

    lines = line("a", late_false_fixes=3.0, false_fixes_in_all=5.0, time_to_notice=7.5, recovery=4.0, claim_width=2.0)
    lines += line("b", late_false_fixes=0.0, false_fixes_in_all=1.0, time_to_notice=1.0, claim_width=1.0)
    assert (lines[0].broken, lines[1].broken) == (1, 1) and lines[1].never_recovered
    not_flown = Result(scenario="s", promise="", rows=unmeasured("s", PERMANENT, "too short"))
    acceptance = conclude([not_flown], flight="", map_path="", quick=True, seed=1, whole=False)
    lines += lines_of(Case("c", AcceptOptions(out=Path("out"))), acceptance)
    table = markdown(lines).splitlines()
    assert "| s | 2 | 200 | 50 % | 6 | 3 | 7.50 s | 4, 1 never | 1.50 | 2 of 2 |" in table
    assert "| s | b | 100 | 50 % | 1 | 0 | 1 s | never | 1 | 1 |" in table
    assert any("not flown: too short" in row for row in table)
    assert len({row.count("|") for row in table if row.startswith("| s")}) <= 2
