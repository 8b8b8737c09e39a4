"""`terrafix accept` without a flight: stored results, conclusions over all scenarios, usage errors."""

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from rich.console import Console

from accept_case import FrameCase, evidence
from terrafix.core.errors import MapError, OutputError, UsageError
from terrafix_lab.accept import fly, run, table
from terrafix_lab.accept.false_inputs.scenarios import LIES
from terrafix_lab.accept.fly import Job, Point, Result
from terrafix_lab.accept.known_shortfalls import KNOWN_SHORTFALLS
from terrafix_lab.accept.measuring.criteria import CRITERIA, EVERYWHERE, unmeasured
from terrafix_lab.accept.measuring.results import JudgedRow, Marks, Verdict
from terrafix_lab.accept.page import write
from terrafix_lab.accept.run import AcceptOptions, accept, truth_of
from terrafix_lab.accept.scenarios import BY_NAME, SCENARIOS
from terrafix_lab.accept.table import Acceptance, conclude, headline, markdown
from terrafix_lab.faults.edits import Span
from terrafix_lab.faults.table import FAULTS


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


def concluded(results: list[Result], *, whole: bool = False) -> Acceptance:
    return conclude(results, flight="a <flight>", map_path="", quick=False, seed=1, whole=whole)


def flights(nees: list[float]) -> list[Result]:
    return [result(f"s{i}", row(Verdict.PASS), nees=(value,) * 50) for i, value in enumerate(nees)]


def nees_row(nees: list[float], seed: int | None = 1) -> JudgedRow:
    """``seed`` None: scenarios of one given flight."""
    found = conclude(flights(nees), flight="", map_path="", quick=False, seed=seed, whole=False)
    return next(r for r in found.rows if r.scenario == "all scenarios")


def test_the_nees_is_not_judged_for_too_few_flights() -> None:
    assert nees_row([2.0, 1.0]).verdict is Verdict.NOT_MEASURABLE


def test_flights_that_are_inside_altogether_are_decidable_once_there_are_enough_of_them() -> None:
    some, many = nees_row([2.0] * 71), nees_row([2.0] * 72)  # 0.95^72 = 2.5 %
    assert some.verdict is Verdict.NOT_MEASURABLE and "not decidable in 71 flights" in some.why
    assert many.verdict is Verdict.BELOW and many.why.endswith("too wide")


def test_claims_ten_times_wider_break_the_floor_of_the_run() -> None:
    quantiles = [-2.0 * np.log(1.0 - (i + 0.5) / 20) for i in range(20)]  # of chi-square, 2 degrees of freedom
    assert nees_row(quantiles).verdict is Verdict.PASS
    for consistent in ([2.0], [2.0, 4.0], [0.5, 1.0, 2.0, 4.0], quantiles):
        assert nees_row(consistent).verdict is not Verdict.BELOW
        wide = nees_row([value / 100.0 for value in consistent])
        assert wide.verdict is Verdict.BELOW and wide.why.endswith("too wide"), consistent


def test_scenarios_over_one_given_map_are_one_draw_of_its_error() -> None:
    assert nees_row([0.2] * 20).verdict is Verdict.BELOW
    given = nees_row([0.2] * 20, seed=None)
    assert (
        given.verdict is Verdict.NOT_MEASURABLE and "not decidable in one flight, or several over one map" in given.why
    )
    wide = nees_row([0.002] * 20, seed=None)
    assert wide.verdict is Verdict.BELOW and wide.why.endswith("too wide")


def test_a_covariance_five_times_too_wide_breaks_the_floor() -> None:
    wide = nees_row([0.08] * 20)  # 2 / 25
    assert wide.verdict is Verdict.BELOW and wide.why.endswith("too wide")


def test_a_covariance_that_is_too_narrow_breaks_the_floor() -> None:
    narrow = nees_row([2.0] * 14 + [9.0] * 6)
    assert (
        narrow.verdict is Verdict.BELOW and narrow.why.endswith("too narrow") and narrow.measured == pytest.approx(0.7)
    )


def test_a_consistent_covariance_passes() -> None:
    consistent = nees_row([2.0] * 19 + [6.5])  # 95 % inside, mean NEES 2.2
    assert consistent.verdict is Verdict.PASS and consistent.measured == pytest.approx(0.95)


KNOWN = {("baseline", "frames within 50 m"): "the ground is too flat"}


@pytest.mark.parametrize(
    ("rows", "seed", "broken", "verdicts"),
    [
        ([row(Verdict.PASS)], 1, 0, [Verdict.PASS]),
        ([row(Verdict.BELOW)], 1, 0, [Verdict.KNOWN]),
        ([row(Verdict.BELOW), row(Verdict.BELOW, what="another")], 1, 1, [Verdict.KNOWN, Verdict.BELOW]),
        ([row(Verdict.BELOW, scenario="water")], 1, 1, [Verdict.BELOW]),
        ([row(Verdict.BELOW)], None, 1, [Verdict.BELOW]),  # the table is of the generated world
    ],
)
def test_a_floor_that_is_not_a_known_shortfall_breaks_the_run(
    rows: list[JudgedRow], seed: int | None, broken: int, verdicts: list[Verdict], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(table, "KNOWN_SHORTFALLS", KNOWN)
    found = conclude([result("baseline", *rows)], flight="", map_path="", quick=True, seed=seed, whole=True)
    assert found.broken == broken and [r.verdict for r in found.rows[: len(rows)]] == verdicts
    assert [r.verdict for r in found.results[0].rows] == verdicts
    assert all(r.why == "the ground is too flat" for r in found.rows if r.verdict is Verdict.KNOWN)


def test_a_known_shortfall_that_holds_again_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "KNOWN_SHORTFALLS", KNOWN)
    assert "again" not in headline(concluded([result("baseline", row(Verdict.BELOW))]))
    assert "hold again" in headline(concluded([result("baseline", row(Verdict.PASS))]))
    assert "baseline, frames within 50 m" in headline(concluded([result("baseline", row(Verdict.PASS))]))


def test_a_known_shortfall_is_a_floor_of_a_scenario() -> None:
    whats = {(s.name, CRITERIA[name].what) for s in SCENARIOS for name in s.criteria}
    assert set(KNOWN_SHORTFALLS) <= whats and all(KNOWN_SHORTFALLS.values())


def test_object_positions_are_measured_by_a_command_of_their_own() -> None:
    whole = concluded([result("baseline", row(Verdict.PASS))], whole=True)
    (objects,) = (r for r in whole.rows if r.ac == "AC-17")
    assert objects.verdict is Verdict.NOT_MEASURABLE and "bench.locate" in objects.why


def test_the_three_files_agree(tmp_path: Path) -> None:
    rows = (
        row(Verdict.PASS, goal_met=True),
        row(Verdict.BELOW, what="a|b"),
        row(Verdict.NOT_MEASURABLE, measured=None),
    )
    acceptance = conclude([result("baseline", *rows)], flight="a <flight>", map_path="", quick=True, seed=1, whole=True)
    write(acceptance, tmp_path)
    written = json.loads((tmp_path / "acceptance.json").read_text())
    assert [r["verdict"] for r in written["rows"]][:3] == ["pass", "below floor", "not measurable here"]
    lines = [line for line in markdown(acceptance).splitlines() if line.startswith("| ")]
    assert len(lines) == 1 + len(written["rows"]) and len({line.count("|") for line in lines}) == 1
    page = (tmp_path / "acceptance.html").read_text()
    assert page.count("<figure") == 1 and "a &lt;flight&gt;" in page and "dark &amp; cold" in page
    assert not re.search(r'(src|href)="', page)  # self-contained
    assert headline(acceptance).startswith("1 scenarios flown: 1 pass, 1 below floor")


def test_false_inputs_replace_the_ordinary_scenarios_and_names_select_any() -> None:
    out = Path("out")
    assert run._chosen(AcceptOptions(out=out)) == list(SCENARIOS)
    assert run._chosen(AcceptOptions(out=out, lies=True)) == list(LIES)
    named = AcceptOptions(out=out, scenarios=("ten foreign frames", "baseline"))
    assert [s.name for s in run._chosen(named)] == ["baseline", "ten foreign frames"]


def test_a_job_has_the_other_map_and_quick_limits_its_frames(tmp_path: Path) -> None:
    options = AcceptOptions(out=tmp_path, flight="f", truth=Path("t"), other_map=Path("town.tif"), quick=True)
    jobs = run._jobs(options, [BY_NAME["start 300 m off"], BY_NAME["photos every 155 m"]], Console())
    assert {job.other_map for job in jobs.values()} == {"town.tif"}
    assert [jobs[name].frames for name in ("start 300 m off", "photos every 155 m")] == [90, run.QUICK_FRAMES]
    whole = run._jobs(replace(options, quick=False), [BY_NAME["start 300 m off"]], Console())
    assert whole["start 300 m off"].frames is None


def test_frames_in_a_false_input_are_excluded_from_nees_and_claim_width(tmp_path: Path) -> None:
    lie = Span(5.0, 10.0, "lie")
    frames = [FrameCase(error_m=3.0)] * 10 + [FrameCase(error_m=90.0)] * 11 + [FrameCase(error_m=3.0)] * 9
    found = evidence(tmp_path, frames, Marks(spans=(lie,), lie=lie))
    found.summary["wall_s"] = 1.0
    judged = fly._result(BY_NAME["ten foreign frames"], found)
    assert len(judged.nees) == 19 and max(judged.nees) < 1.0
    assert judged.claim_width == pytest.approx(5.0 * 1.1774 / 3.0, rel=0.01)


def test_a_stored_result_is_used_for_an_identical_job_only(tmp_path: Path) -> None:
    out = tmp_path / "baseline"
    out.mkdir()
    job = Job(scenario="baseline", flight="f", truth="t", out=str(out), frames=80)
    (out / run.JOB).write_bytes(run._encoded(job))
    assert run._stored_result(job) is None  # started and not finished
    (out / run.RESULT).write_bytes(msgspec.json.encode(result("baseline", row(Verdict.PASS))))
    kept = run._stored_result(job)
    assert kept is not None and kept.points[1].error_m == 3.0
    assert run._stored_result(msgspec.structs.replace(job, frames=81)) is None
    (out / run.RESULT).write_bytes(b'{"torn": ')
    assert run._stored_result(job) is None


def test_a_crash_gives_a_failed_result(tmp_path: Path) -> None:
    scenario = BY_NAME["camera stall"]
    found = run._crashed(scenario, tmp_path, "Traceback ...\nRuntimeError: indeterminate\n")
    assert {r.verdict for r in found.rows} == {Verdict.BELOW} and len(found.rows) == len(scenario.criteria)
    assert "indeterminate" in found.rows[0].why and (tmp_path / "crash.txt").is_file()


def test_a_scenario_that_was_not_flown_has_unmeasured_rows() -> None:
    rows = unmeasured("x", EVERYWHERE, "no wings")
    assert len(rows) == len(EVERYWHERE) and {(r.verdict, r.why) for r in rows} == {(Verdict.NOT_MEASURABLE, "no wings")}


def test_usage_errors_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="'moon': not a scenario; known: baseline, foreign frame"):
        accept(AcceptOptions(out=tmp_path, scenarios=("moon",)))
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        accept(AcceptOptions(out=tmp_path / "file", scenarios=("baseline",)))


def test_a_flight_needs_map_and_truth(tmp_path: Path) -> None:
    flight = tmp_path / "flight"
    flight_folder(flight, with_map=False)
    with pytest.raises(MapError, match="names no map"):
        accept(AcceptOptions(out=tmp_path / "out", flight=str(flight)))
    flight_folder(flight, with_map=True)
    with pytest.raises(UsageError, match=r"no truth\.csv or coordinates\.csv there; give one with --truth"):
        accept(AcceptOptions(out=tmp_path / "out", flight=str(flight)))
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


def test_every_required_scenario_exists_and_is_documented() -> None:
    names = (
        "baseline", "foreign frame", "350 m frame", "350 m outlier fix", "sharp turn", "three fragments",
        "20 % unmatchable", "long route", "60 s blackout", "GNSS jam", "slow spoof", "season change", "low texture",
        "water", "hill country",
        "height wrong by 10 %", "compass wrong by 15 degrees", "heading unknown",
        "kidnapped", "hot day", "camera stall",
    )  # fmt: skip
    assert tuple(s.name for s in SCENARIOS) == names
    page = (Path(__file__).resolve().parents[3] / "docs" / "acceptance.md").read_text(encoding="utf-8")
    for name in names:
        words = FAULTS[name].words if name in FAULTS else ""
        assert words or name in page, f"neither docs/acceptance.md nor the table of faults explains '{name}'"
