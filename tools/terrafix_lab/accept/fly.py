"""One scenario in a separate process, so that its memory can be measured: python -m terrafix_lab.accept.fly JOB.json.

Writes the replay, then result.json beside it, which exists only for scenarios that were judged."""

import json
import sys
import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import typer

from terrafix.core.config import Config, load
from terrafix.core.errors import MapError, TerrafixError
from terrafix.core.node import Node, NodeContext
from terrafix.map.format import CE90_SIGMAS
from terrafix.messages import Frame, Message
from terrafix.vision.sources import Source
from terrafix_lab.accept.false_inputs.integrity import claim_width, in_lie
from terrafix_lab.accept.flight import AcceptFlight, open_flight
from terrafix_lab.accept.long_route import ThereAndBack
from terrafix_lab.accept.measuring.criteria import judge, unmeasured
from terrafix_lab.accept.measuring.evidence import Evidence, gather
from terrafix_lab.accept.measuring.results import JudgedRow
from terrafix_lab.accept.plan import CLOSED_LOOP, Plan, Scenario
from terrafix_lab.accept.scenarios import BY_NAME, LONG_FRAMES
from terrafix_lab.bench.flights import program_age_s
from terrafix_lab.faults.edits import Span, unchanged_origin
from terrafix_lab.faults.source import AlteredSource
from terrafix_tools.flight_map import map_cache_dir
from terrafix_tools.mapping.build import build, ensure_package
from terrafix_tools.replay import replay
from terrafix_tools.report.data import radius95_m

RESULT = "result.json"


class Job(msgspec.Struct, frozen=True, kw_only=True):
    """Input of the process."""

    scenario: str
    flight: str  # argument of open_source
    truth: str
    map: str = ""
    dem: str = ""
    out: str
    frames: int | None = None  # limit of the frames of the flight
    models: list[str] = []
    configs: list[str] = []
    threads: int = 1
    seed: int = 0
    other_map: str = ""  # GeoTIFF of another place, for the scenarios with a wrong map
    generated: bool = False  # a perfect map: its error is drawn with the configured CE90


class Point(msgspec.Struct, frozen=True):
    """One frame in the chart."""

    t_s: float
    error_m: float | None
    radius_m: float | None  # longer half axis of the claimed 95 % ellipse
    label: str


class Result(msgspec.Struct, frozen=True, kw_only=True):
    """Content of result.json: one scenario."""

    scenario: str
    promise: str
    rows: list[JudgedRow]
    points: list[Point] = []
    spans: list[Span] = []
    nees: list[float] = []  # squared Mahalanobis distance of every frame with truth and true inputs
    claim_width: float | None = None  # claimed 1-sigma over that of the error, of the same frames
    frames: int = 0
    wall_s: float = 0.0


class StartupTimer:
    """A vision node that records the time of the first frame, when map and models are open."""

    def __init__(self, vision: Node, began_s: float) -> None:
        """``began_s``: start of the construction of the nodes."""
        self._vision, self._began_s = vision, began_s
        self.start_up_s: float | None = None

    def on(self, message: Message) -> Iterable[Message]:
        if isinstance(message, Frame) and self.start_up_s is None:
            self.start_up_s = time.perf_counter() - self._began_s
        return self._vision.on(message)

    def tick(self, now_ns: int) -> Iterable[Message]:
        return self._vision.tick(now_ns)


def fly(job: Job, imports_s: float = 0.0) -> Result:
    """Flies and judges. ``imports_s``: age of the process at its start. Raises TerrafixError."""
    scenario, out = BY_NAME[job.scenario], Path(job.out)
    if scenario.ground == CLOSED_LOOP:
        from terrafix_lab.accept.closed import fly_closed  # here, because it loads the whole simulator

        evidence = fly_closed(
            job.scenario,
            Path(job.map).with_suffix(".gpkg"),
            out,
            seed=job.seed,
            frames=job.frames or scenario.frames,
            truth_offset_m=_map_error_m(job, load([])),
        )
        return _result(scenario, evidence)
    flight = open_flight(
        job.flight, Path(job.map) if job.map else None, Path(job.dem) if job.dem else None, Path(job.truth), job.frames
    )
    flight = replace(flight, other_map=Path(job.other_map) if job.other_map else None)
    plan = scenario.plan(flight)
    if isinstance(plan, str):
        return _not_flown(scenario, plan)
    package, reason = _package(flight, plan, out)
    if reason:
        return _not_flown(scenario, reason)
    config = load([Path(path) for path in job.configs])
    watch: list[StartupTimer] = []

    def nodes(ctx: NodeContext) -> Mapping[str, Node]:
        began_s = time.perf_counter()
        made = dict(plan.nodes(ctx))
        made["vision"] = watched = StartupTimer(made["vision"], began_s)
        watch.append(watched)
        return made

    try:
        replay(
            job.flight,
            package,
            out,
            models=job.models,
            configs=[Path(path) for path in job.configs],
            nodes=nodes,
            wrap_source=lambda source: _altered(source, flight, plan, job.frames),
        )
    except MapError as error:
        if plan.origin is unchanged_origin:
            raise
        return _not_flown(scenario, f"the map does not reach the wrong start: {error}")
    evidence = gather(
        out,
        flight.truth,
        plan.marks,
        start_up_s=imports_s + (watch[0].start_up_s or 0.0),
        truth_offset_m=_map_error_m(job, config),
    )
    return _result(scenario, evidence)


def _result(scenario: Scenario, evidence: Evidence) -> Result:
    return Result(
        scenario=scenario.name,
        promise=scenario.promise,
        rows=judge(scenario.name, scenario.criteria, evidence),
        points=[_point(evidence, i) for i in range(len(evidence.frames))],
        spans=list(evidence.marks.spans),
        nees=[
            f.compared.mahalanobis2
            for f in evidence.frames
            if f.compared and f.compared.mahalanobis2 is not None and not in_lie(evidence, f)
        ],
        claim_width=claim_width(evidence).value,
        frames=len(evidence.frames),
        wall_s=evidence.summary["wall_s"],
    )


def _not_flown(scenario: Scenario, why: str) -> Result:
    rows = unmeasured(scenario.name, scenario.criteria, why)
    return Result(scenario=scenario.name, promise=scenario.promise, rows=rows)


def _altered(source: Source, flight: AcceptFlight, plan: Plan, frames: int | None) -> Source:
    if plan.long_route and len(flight.frame_refs) < LONG_FRAMES:
        source, frames = ThereAndBack(source, flight.frame_refs, LONG_FRAMES), None
    return AlteredSource(source, plan.edit, frames=frames, origin=plan.origin)


def _package(flight: AcceptFlight, plan: Plan, out: Path) -> tuple[Path | None, str]:
    """-> the map to fly with (None: that of the flight), or the reason why it cannot be made."""
    if plan.other_map is None:
        if flight.map_path is None:
            return None, ""
        beside = flight.map_path.with_suffix(".gpkg")  # of a generated place: the package with its DEM
        return (beside if beside.is_file() else ensure_package(flight.map_path, map_cache_dir())), ""
    assert flight.map_path is not None
    changed = out / "map.tif"
    if why_not := plan.other_map(flight.map_path, changed):
        return None, why_not
    package = build(changed, out / "map.gpkg", dem=flight.dem)
    changed.unlink()
    return package, ""


def _map_error_m(job: Job, config: Config) -> tuple[float, float]:
    """Error of the map, east and north. A generated map has none, but the published covariance includes the CE90 of a
    real map. One draw per scenario makes the covariance testable."""
    if not job.generated:
        return 0.0, 0.0
    east_m, north_m = np.random.default_rng([job.seed, *job.scenario.encode()]).normal(
        0.0, config.map.ce90_m / CE90_SIGMAS, 2
    )
    return float(east_m), float(north_m)


def _point(evidence: Evidence, number: int) -> Point:
    frame = evidence.frames[number]
    return Point(frame.t_s, frame.error_m, radius95_m(frame.row), frame.row.source_label)


def main() -> None:
    imports_s = program_age_s()
    job = msgspec.json.decode(Path(sys.argv[1]).read_bytes(), type=Job)
    cv2.setNumThreads(job.threads)
    try:
        result = fly(job, imports_s)
    except TerrafixError as error:
        typer.echo(str(error), err=True)
        sys.exit(error.exit_code)
    part = Path(job.out) / (RESULT + ".partial")
    part.write_text(json.dumps(msgspec.to_builtins(result)), encoding="utf-8")
    part.replace(Path(job.out) / RESULT)


if __name__ == "__main__":
    main()
