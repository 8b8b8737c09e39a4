"""`terrafix accept`: flies the scenarios, stores each result, and writes the table."""

import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path

import msgspec
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from terrafix.core.errors import ERROR_OF_EXIT_CODE, MapError, OutputError, UsageError
from terrafix.vision.sources import open_source
from terrafix_lab.accept import fly
from terrafix_lab.accept.false_inputs.scenarios import LIES, LIES_IN_THE_LOOP
from terrafix_lab.accept.fly import RESULT, Job, Result
from terrafix_lab.accept.measuring.criteria import failed, unmeasured
from terrafix_lab.accept.measuring.results import BELOW_FLOOR, with_unit
from terrafix_lab.accept.page import write
from terrafix_lab.accept.plan import CLOSED_LOOP, Scenario
from terrafix_lab.accept.scenarios import BY_NAME, COMMAND, SCENARIOS
from terrafix_lab.accept.table import Acceptance, conclude
from terrafix_lab.faults.fault import check_flown_by
from terrafix_lab.faults.table import FAULTS
from terrafix_tools.progress import LineProgress, waiting

JOB, GROUND_JOB, CRASH = "job.json", "ground.json", "crash.txt"
QUICK_FRAMES = 120
QUICK_LEAVES_OUT = (
    "long route",
    "60 s blackout",
    "slow spoof",
    *LIES_IN_THE_LOOP,
)  # too long to be shortened
DEFAULT_WORKERS = 2  # scenarios at a time; each uses about one core
POLL_S = 2.0  # period of the update of the progress line


class GroundJob(msgspec.Struct, frozen=True):
    """Parameters of a stored piece of generated ground."""

    kind: str
    seed: int
    frames: int


@dataclass(frozen=True)
class AcceptOptions:
    """Options of the command line."""

    out: Path
    flight: str = ""  # "": the generated world
    map_path: Path | None = None
    truth: Path | None = None
    scenarios: tuple[str, ...] = ()  # (): all
    quick: bool = False
    resume: bool = False
    seed: int = 1
    models: tuple[str, ...] = ()
    configs: tuple[Path, ...] = ()
    lies: bool = False  # the scenarios of false_inputs/, instead of the ordinary ones
    other_map: Path | None = None  # GeoTIFF of another place
    workers: int = DEFAULT_WORKERS  # scenarios at a time


def accept(options: AcceptOptions) -> Acceptance:
    """Writes acceptance.json, .md and .html into ``options.out`` after every scenario. Raises TerrafixError."""
    chosen = _chosen(options)
    console = Console(stderr=True)
    _check_paths(options)
    jobs = _jobs(options, chosen, console)
    results: dict[str, Result] = {s.name: _skipped_result(s, why) for s, why in _not_flown(options, chosen)}
    for scenario, job in list(jobs.items()):
        if options.resume and (done := _stored_result(job)) is not None:
            results[scenario] = done
            del jobs[scenario]
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with LineProgress(*columns, console=console) as progress:
        task = progress.add_task("scenarios", total=len(chosen), completed=len(results))
        for result in _fly_all(jobs, options.workers, progress, task):
            results[result.scenario] = result
            acceptance = _concluded(options, chosen, results)
            write(acceptance, options.out)
            shown = next(r for r in acceptance.results if r.scenario == result.scenario)
            progress.console.print(_line(shown), highlight=False)
            progress.advance(task)
    acceptance = _concluded(options, chosen, results)
    write(acceptance, options.out)
    return acceptance


def _concluded(options: AcceptOptions, chosen: list[Scenario], results: dict[str, Result]) -> Acceptance:
    return conclude(
        [results[s.name] for s in chosen if s.name in results],
        flight=options.flight or "generated world",
        map_path=str(options.map_path or ""),
        quick=options.quick,
        seed=None if options.flight else options.seed,
        whole=not options.scenarios and not options.lies,
    )


def _line(result: Result) -> str:
    """Line on the console for a finished scenario."""
    broken = [row for row in result.rows if row.verdict in BELOW_FLOOR]
    if not result.points:
        return f"  {result.scenario}: not flown, {result.rows[0].why}"
    words = "; ".join(f"{row.ac} {row.what}: {with_unit(row.measured, row.unit)} ({row.verdict})" for row in broken)
    return f"  {result.scenario}: {result.frames} frames in {result.wall_s:.0f} s; {words or 'all floors hold'}"


def truth_of(flight: str, given: Path | None) -> Path | None:
    """The given table, or one in the flight folder."""
    beside = (Path(flight) / name for name in ("truth.csv", "coordinates.csv")) if flight else ()
    return given or next((path for path in beside if path.is_file()), None)


def _chosen(options: AcceptOptions) -> list[Scenario]:
    unknown = [name for name in options.scenarios if name not in BY_NAME]
    if unknown:
        if unknown[0] in FAULTS:
            check_flown_by(COMMAND, FAULTS[unknown[0]])
        raise UsageError(f"--scenario '{unknown[0]}': not a scenario; known: {', '.join(BY_NAME)}")
    if options.scenarios:
        return [scenario for name, scenario in BY_NAME.items() if name in options.scenarios]
    return list(LIES if options.lies else SCENARIOS)


def _not_flown(options: AcceptOptions, chosen: list[Scenario]) -> Iterator[tuple[Scenario, str]]:
    for scenario in chosen:
        if options.flight and scenario.ground != "base":
            closed = scenario.ground == CLOSED_LOOP
            yield scenario, "needs an aircraft that flies" if closed else "needs other ground than that of this flight"
        elif options.quick and scenario.name in QUICK_LEAVES_OUT:
            yield scenario, "left out by --quick"


def _skipped_result(scenario: Scenario, why: str) -> Result:
    return Result(
        scenario=scenario.name,
        promise=scenario.promise,
        rows=unmeasured(scenario.name, scenario.criteria, why),
    )


def _jobs(options: AcceptOptions, chosen: list[Scenario], console: Console) -> dict[str, Job]:
    """Jobs by scenario, longest first for an even load; makes the ground that they need."""
    skipped = {scenario.name for scenario, _ in _not_flown(options, chosen)}
    flown = sorted((s for s in chosen if s.name not in skipped), key=lambda s: -s.frames)
    threads = max(1, (os.cpu_count() or 1) // options.workers)
    jobs: dict[str, Job] = {}
    for scenario in flown:
        out = str(options.out / scenario.name.replace(" ", "-").replace("%", "percent"))
        frames = _frames(options, scenario) if options.quick else None
        place = Job(
            scenario=scenario.name,
            flight=options.flight,
            map=str(options.map_path or ""),
            truth=str(options.truth),
            out=out,
            frames=frames,
            models=list(options.models),
            configs=[str(path.resolve()) for path in options.configs],
            threads=threads,
            seed=options.seed,
            other_map=str(options.other_map or ""),
        )
        jobs[scenario.name] = place if options.flight else _over_generated(place, scenario, flown, options, console)
    return jobs


def _over_generated(
    job: Job, scenario: Scenario, flown: list[Scenario], options: AcceptOptions, console: Console
) -> Job:
    frames = {s.name: _frames(options, s) for s in flown}
    kind = _kind(scenario)
    longest = max(frames[s.name] for s in flown if _kind(s) == kind)
    ground = _ground(options, kind, longest, console)
    flight = ground / "flight"
    return msgspec.structs.replace(
        job,
        flight=str(flight),
        map=str(ground / "map.tif"),
        dem=str(ground / "dem.tif"),
        truth=str(flight / "truth.csv"),
        frames=frames[scenario.name],
        generated=True,
    )


def _frames(options: AcceptOptions, scenario: Scenario) -> int:
    """Number of frames of a generated flight."""
    return min(QUICK_FRAMES, scenario.frames) if options.quick else scenario.frames


def _kind(scenario: Scenario) -> str:
    return "base" if scenario.ground == CLOSED_LOOP else scenario.ground


def _ground(options: AcceptOptions, kind: str, frames: int, console: Console) -> Path:
    """Folder of a piece of generated ground; made if it does not exist or its flight is too short."""
    folder = options.out / "ground" / kind.replace(" ", "-")
    mark = folder / GROUND_JOB
    if mark.is_file():
        there = msgspec.json.decode(mark.read_bytes(), type=GroundJob)
        # The base flight may be flown in part; on other ground the features are placed along the whole flight.
        enough = there.frames >= frames if kind == "base" else there.frames == frames
        if there.kind == kind and there.seed == options.seed and enough:
            return folder
        mark.unlink()
    from terrafix_lab.accept.generated import make  # not needed for a given flight

    with waiting(console, f"ground and flight: {kind}, {frames} frames"):
        make(kind, folder, seed=options.seed, frames=frames)
    mark.write_bytes(msgspec.json.encode(GroundJob(kind, options.seed, frames)))
    return folder


def _check_paths(options: AcceptOptions) -> None:
    """Checks that the output folder is writable and that the flight has a map and truth."""
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        probe = options.out / "acceptance.partial"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise OutputError(f"{options.out}: cannot be written ({error.strerror}); choose another --out") from None
    if options.flight:
        source = open_source(options.flight)
        missing = options.map_path is None and source.map_hint() is None
        source.close()
        if missing:
            raise MapError(f"{options.flight}: the flight names no map; give one with --map (GeoTIFF or map package)")
        if options.truth is None or not options.truth.is_file():
            raise UsageError(f"{options.flight}: no truth.csv or coordinates.csv there; give one with --truth")


def _stored_result(job: Job) -> Result | None:
    """Result of an earlier run of the same job; None: there is none."""
    out = Path(job.out)
    try:
        if (out / JOB).read_bytes() == _encoded(job):
            return msgspec.json.decode((out / RESULT).read_bytes(), type=Result)
    except (OSError, msgspec.DecodeError):
        pass
    return None


def _encoded(job: Job) -> bytes:
    return msgspec.json.format(msgspec.json.encode(job))


def _fly_all(jobs: dict[str, Job], workers: int, progress: Progress, task: TaskID) -> Iterator[Result]:
    with ThreadPoolExecutor(workers) as pool:
        running: dict[Future[Result], str] = {pool.submit(_fly, job): name for name, job in jobs.items()}
        while running:
            active = [name for future, name in running.items() if future.running()]
            progress.update(task, description=f"scenarios ({', '.join(active)})")
            done, _ = wait(running, timeout=POLL_S, return_when=FIRST_COMPLETED)
            for future in done:
                del running[future]
                try:
                    yield future.result()
                except BaseException:
                    pool.shutdown(wait=False, cancel_futures=True)
                    raise


def _crashed(scenario: Scenario, out: Path, traceback: str) -> Result:
    """Result of a scenario that crashed, so that the others are still reported."""
    (out / CRASH).write_text(traceback, encoding="utf-8")
    last = traceback.strip().splitlines()[-1] if traceback.strip() else "killed"
    rows = failed(scenario.name, scenario.criteria, f"the flight crashed: {last}; see {out / CRASH}")
    return Result(scenario=scenario.name, promise=scenario.promise, rows=rows)


def _fly(job: Job) -> Result:
    out = Path(job.out)
    out.mkdir(parents=True, exist_ok=True)
    (out / RESULT).unlink(missing_ok=True)
    (out / JOB).write_bytes(_encoded(job))
    # Few threads per library: the cores are used by parallel scenarios.
    environment = os.environ | {"OMP_NUM_THREADS": str(job.threads)}
    done = subprocess.run(
        [sys.executable, "-m", fly.__name__, str(out / JOB)], stderr=subprocess.PIPE, text=True, env=environment
    )
    # With generated inputs an error is no user error; it is reported as a crash.
    if (kind := ERROR_OF_EXIT_CODE.get(done.returncode)) and not job.generated:
        raise kind(f"scenario '{job.scenario}': {done.stderr.strip()}")
    if done.returncode != 0:
        return _crashed(BY_NAME[job.scenario], out, done.stderr)
    return msgspec.json.decode((out / RESULT).read_bytes(), type=Result)
