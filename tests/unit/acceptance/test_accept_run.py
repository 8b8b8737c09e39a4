"""`terrafix accept` from the outside, without a flight: what is kept, what is judged, what a mistake says."""

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from rich.console import Console

from accept_case import Said, evidence
from terrafix.core.errors import MapError, OutputError, UsageError
from terrafix_tools.accept import fly, run
from terrafix_tools.accept.criteria import EVERYWHERE, unmeasured
from terrafix_tools.accept.fly import Job, Point, Result
from terrafix_tools.accept.judged import JudgedRow, Marks, Span, Verdict
from terrafix_tools.accept.lies import LIES
from terrafix_tools.accept.run import Wanted, accept, truth_of
from terrafix_tools.accept.scenarios import BY_NAME, SCENARIOS
from terrafix_tools.accept.table import conclude, headline, markdown, write


def row(verdict: Verdict, **more: object) -> JudgedRow:
    base = {
        "scenario": "baseline", "ac": "AC-1", "what": "frames within 50 m", "measured": 0.5, "unit": "%",
        "floor": ">= 80 %", "goal": ">= 99 %", "verdict": verdict, "goal_met": None}  # fmt: skip
    return JudgedRow(**(base | more))  # type: ignore[arg-type]


def result(name: str, *rows: JudgedRow, nees: tuple[float, ...] = ()) -> Result:
    points = [Point(float(i), 3.0 if i % 5 else None, 12.0, "satellite_anchored") for i in range(40)]
    spans = [Span(10.0, 20.0, "dark & cold")]
    return Result(
        scenario=name, promise="A <promise>.", rows=list(rows), points=points, spans=spans, nees=list(nees), frames=40
    )


def concluded(results: list[Result], *, whole: bool = False) -> object:
    return conclude(results, flight="a <flight>", map_path="", quick=False, seed=1, whole=whole)


def flights(nees: list[float]) -> list[Result]:
    return [result(f"s{i}", row(Verdict.PASS), nees=(value,) * 50) for i, value in enumerate(nees)]


def honest(nees: list[float]) -> JudgedRow:
    found = conclude(flights(nees), flight="", map_path="", quick=False, seed=1, whole=False)
    return next(r for r in found.rows if r.scenario == "all scenarios")


def test_one_flight_cannot_tell_whether_the_claim_is_honest() -> None:
    assert honest([2.0, 1.0]).verdict is Verdict.NOT_MEASURABLE


def test_a_claim_five_times_too_wide_is_not_honest() -> None:
    modest = honest([0.08] * 20)  # 2 / 25
    assert modest.verdict is Verdict.BELOW and modest.why.endswith("too modest")


def test_a_claim_that_is_too_narrow_is_not_honest() -> None:
    sure = honest([2.0] * 14 + [9.0] * 6)
    assert sure.verdict is Verdict.BELOW and sure.why.endswith("too sure") and sure.measured == pytest.approx(0.7)


def test_an_honest_claim() -> None:
    fair = honest([2.0] * 19 + [6.5])  # 95 % inside, mean NEES 2.2
    assert fair.verdict is Verdict.PASS and fair.measured == pytest.approx(0.95)


def test_what_is_not_built_counts_as_broken() -> None:
    part = concluded([result("baseline", row(Verdict.PASS))])
    assert part.broken == 0  # type: ignore[attr-defined]
    whole = concluded([result("baseline", row(Verdict.PASS), row(Verdict.BELOW))], whole=True)
    assert whole.broken == 2  # type: ignore[attr-defined]  # the one below its floor, and AC-17


def test_the_three_files_agree(tmp_path: Path) -> None:
    rows = (
        row(Verdict.PASS, goal_met=True),
        row(Verdict.BELOW, what="a|b"),
        row(Verdict.NOT_MEASURABLE, measured=None),
    )
    acceptance = conclude([result("baseline", *rows)], flight="a <flight>", map_path="", quick=True, seed=1, whole=True)
    write(acceptance, tmp_path)
    table = json.loads((tmp_path / "acceptance.json").read_text())
    assert [r["verdict"] for r in table["rows"]][:3] == ["pass", "below floor", "not measurable here"]
    lines = [line for line in markdown(acceptance).splitlines() if line.startswith("| ")]
    assert len(lines) == 1 + len(table["rows"]) and len({line.count("|") for line in lines}) == 1
    page = (tmp_path / "acceptance.html").read_text()
    assert page.count("<figure") == 1 and "a &lt;flight&gt;" in page and "dark &amp; cold" in page
    assert not re.search(r'(src|href)="', page)  # one file, works offline
    assert headline(acceptance).startswith("1 scenarios flown: 1 pass, 1 below floor")


def test_lies_are_flown_instead_of_the_ordinary_scenarios_and_any_by_its_name() -> None:
    out = Path("out")
    assert run._chosen(Wanted(out=out)) == list(SCENARIOS)
    assert run._chosen(Wanted(out=out, lies=True)) == list(LIES)
    named = Wanted(out=out, scenarios=("ten foreign frames", "baseline"))
    assert [s.name for s in run._chosen(named)] == ["baseline", "ten foreign frames"]


def test_a_job_names_the_other_map_and_a_quick_one_is_short(tmp_path: Path) -> None:
    wanted = Wanted(out=tmp_path, flight="f", truth=Path("t"), other_map=Path("town.tif"), quick=True)
    jobs = run._jobs(wanted, [BY_NAME["start 300 m off"], BY_NAME["photos every 155 m"]], Console())
    assert {job.other_map for job in jobs.values()} == {"town.tif"}
    assert [jobs[name].frames for name in ("start 300 m off", "photos every 155 m")] == [90, run.QUICK_FRAMES]
    whole = run._jobs(replace(wanted, quick=False), [BY_NAME["start 300 m off"]], Console())
    assert whole["start 300 m off"].frames is None


def test_frames_in_a_lie_say_nothing_of_the_claims(tmp_path: Path) -> None:
    lie = Span(5.0, 10.0, "lie")
    frames = [Said(error_m=3.0)] * 10 + [Said(error_m=90.0)] * 11 + [Said(error_m=3.0)] * 9
    found = evidence(tmp_path, frames, Marks(spans=(lie,), lie=lie))
    found.summary["wall_s"] = 1.0
    judged = fly._result(BY_NAME["ten foreign frames"], found)
    assert len(judged.nees) == 19 and max(judged.nees) < 1.0
    assert judged.claim_width == pytest.approx(5.0 * 1.1774 / 3.0, rel=0.01)


def test_a_kept_result_is_of_the_very_same_job(tmp_path: Path) -> None:
    out = tmp_path / "baseline"
    out.mkdir()
    job = Job(scenario="baseline", flight="f", truth="t", out=str(out), frames=80)
    (out / run.JOB).write_bytes(run._encoded(job))
    assert run._kept(job) is None  # flown, but not to its end
    (out / run.RESULT).write_bytes(msgspec.json.encode(result("baseline", row(Verdict.PASS))))
    kept = run._kept(job)
    assert kept is not None and kept.points[1].error_m == 3.0
    assert run._kept(msgspec.structs.replace(job, frames=81)) is None
    (out / run.RESULT).write_bytes(b'{"torn": ')
    assert run._kept(job) is None


def test_a_crash_is_a_result(tmp_path: Path) -> None:
    scenario = BY_NAME["camera stall"]
    found = run._crashed(scenario, tmp_path, "Traceback ...\nRuntimeError: indeterminate\n")
    assert {r.verdict for r in found.rows} == {Verdict.BELOW} and len(found.rows) == len(scenario.criteria)
    assert "indeterminate" in found.rows[0].why and (tmp_path / "crash.txt").is_file()


def test_rows_of_a_scenario_that_was_not_flown_are_there() -> None:
    rows = unmeasured("x", EVERYWHERE, "no wings")
    assert len(rows) == len(EVERYWHERE) and {(r.verdict, r.why) for r in rows} == {(Verdict.NOT_MEASURABLE, "no wings")}


def test_mistakes_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="'moon': not a scenario; known: baseline, foreign frame"):
        accept(Wanted(out=tmp_path, scenarios=("moon",)))
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        accept(Wanted(out=tmp_path / "file", scenarios=("baseline",)))


def test_a_flight_needs_map_and_truth(tmp_path: Path) -> None:
    flight = tmp_path / "flight"
    flight_folder(flight, with_map=False)
    with pytest.raises(MapError, match="names no map"):
        accept(Wanted(out=tmp_path / "out", flight=str(flight)))
    flight_folder(flight, with_map=True)
    with pytest.raises(UsageError, match=r"no truth\.csv or coordinates\.csv there; give one with --truth"):
        accept(Wanted(out=tmp_path / "out", flight=str(flight)))
    (flight / "coordinates.csv").write_text("image,lat,lon\n")
    assert truth_of(str(flight), None) == flight / "coordinates.csv"
    assert truth_of("", None) is None


def flight_folder(folder: Path, *, with_map: bool) -> None:
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / "frames" / "1.jpg"), np.zeros((48, 64, 3), np.uint8))
    (folder / "frames.csv").write_text("file,t_s\n1.jpg,0\n")
    named = 'map = "map.tif"\n' if with_map else ""
    (folder / "flight.toml").write_text(
        f"{named}[camera]\nwidth = 64\nheight = 48\nfx = 50.0\nfy = 50.0\ncx = 31.5\ncy = 23.5\n"
        "[start]\nlat_deg = 48.0\nlon_deg = 11.0\n"
    )


def test_every_scenario_of_the_requirements_is_there() -> None:
    wanted = (
        "baseline", "foreign frame", "350 m frame", "350 m outlier fix", "sharp turn", "three fragments",
        "20 % unmatchable", "long route", "60 s blackout", "GNSS jam", "slow spoof", "season change", "low texture",
        "water", "hill country",
        "height wrong by 10 %", "compass wrong by 15 degrees", "heading unknown",
        "kidnapped", "hot day", "camera stall",
    )  # fmt: skip
    assert tuple(s.name for s in SCENARIOS) == wanted
    page = (Path(__file__).resolve().parents[3] / "docs" / "acceptance.md").read_text(encoding="utf-8")
    for name in wanted:
        assert name in page, f"docs/acceptance.md does not explain '{name}'"
