"""`terrafix accept`: flies the scenarios, keeps every result as it comes, and writes the table."""

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

from terrafix.core.errors import MapError, OutputError, TerrafixError, UsageError
from terrafix.vision.sources import open_source
from terrafix_tools.accept import fly
from terrafix_tools.accept.closed_lies import LIES_IN_THE_LOOP
from terrafix_tools.accept.criteria import failed, unmeasured
from terrafix_tools.accept.fly import RESULT, Job, Result
from terrafix_tools.accept.judged import BROKEN, shown
from terrafix_tools.accept.lies import LIES
from terrafix_tools.accept.plan import CLOSED_LOOP, Scenario
from terrafix_tools.accept.scenarios import BY_NAME, SCENARIOS
from terrafix_tools.accept.table import Acceptance, conclude, write

JOB, GROUND_JOB, CRASH = "job.json", "ground.json", "crash.txt"
QUICK_FRAMES = 120
QUICK_LEAVES_OUT = (
    "long route",
    "60 s blackout",
    "slow spoof",
    *LIES_IN_THE_LOOP,
)  # they are long, or they are nothing
AT_ONCE = 2  # scenarios, when nobody says how many: each keeps about one core busy
LOOK_S = 2.0  # how often the line that names the running ones is looked after
_MISTAKES = {kind.exit_code: kind for kind in TerrafixError.__subclasses__()}


class GroundJob(msgspec.Struct, frozen=True):
    """What a piece of generated ground was made for."""

    kind: str
    seed: int
    frames: int


@dataclass(frozen=True)
class Wanted:
    """The command line."""

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
    lies: bool = False  # the scenarios of lies.py, instead of the ordinary ones
    other_map: Path | None = None  # GeoTIFF of another place
    workers: int = AT_ONCE  # scenarios at a time


def accept(wanted: Wanted) -> Acceptance:
    """Writes acceptance.json, .md and .html into ``wanted.out``, anew after every scenario.

    Raises the TerrafixError family."""
    chosen = _chosen(wanted)
    console = Console(stderr=True)
    _make_room(wanted)
    jobs = _jobs(wanted, chosen, console)
    results: dict[str, Result] = {s.name: _left_out(s, why) for s, why in _not_flown(wanted, chosen)}
    for scenario, job in list(jobs.items()):
        if wanted.resume and (done := _kept(job)) is not None:
            results[scenario] = done
            del jobs[scenario]
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("scenarios", total=len(chosen), completed=len(results))
        for result in _flown(jobs, wanted.workers, progress, task):
            results[result.scenario] = result
            write(_concluded(wanted, chosen, results), wanted.out)
            progress.console.print(_line(result), highlight=False)
            progress.advance(task)
    acceptance = _concluded(wanted, chosen, results)
    write(acceptance, wanted.out)
    return acceptance


def _concluded(wanted: Wanted, chosen: list[Scenario], results: dict[str, Result]) -> Acceptance:
    return conclude(
        [results[s.name] for s in chosen if s.name in results],
        flight=wanted.flight or "generated world",
        map_path=str(wanted.map_path or ""),
        quick=wanted.quick,
        seed=None if wanted.flight else wanted.seed,
        whole=not wanted.scenarios and not wanted.lies,
    )


def _line(result: Result) -> str:
    """What a person sees when a scenario has ended."""
    broken = [row for row in result.rows if row.verdict in BROKEN]
    if not result.points:
        return f"  {result.scenario}: not flown, {result.rows[0].why}"
    words = "; ".join(f"{row.ac} {row.what}: {shown(row.measured, row.unit)} ({row.verdict})" for row in broken)
    return f"  {result.scenario}: {result.frames} frames in {result.wall_s:.0f} s; {words or 'all floors hold'}"


def truth_of(flight: str, given: Path | None) -> Path | None:
    """The table that is given, or one that lies in the flight folder."""
    beside = (Path(flight) / name for name in ("truth.csv", "coordinates.csv")) if flight else ()
    return given or next((path for path in beside if path.is_file()), None)


def _chosen(wanted: Wanted) -> list[Scenario]:
    unknown = [name for name in wanted.scenarios if name not in BY_NAME]
    if unknown:
        raise UsageError(f"--scenario '{unknown[0]}': not a scenario; known: {', '.join(BY_NAME)}")
    if wanted.scenarios:
        return [scenario for name, scenario in BY_NAME.items() if name in wanted.scenarios]
    return list(LIES if wanted.lies else SCENARIOS)


def _not_flown(wanted: Wanted, chosen: list[Scenario]) -> Iterator[tuple[Scenario, str]]:
    for scenario in chosen:
        if wanted.flight and scenario.ground != "base":
            closed = scenario.ground == CLOSED_LOOP
            yield scenario, "needs an aircraft that flies" if closed else "needs other ground than that of this flight"
        elif wanted.quick and scenario.name in QUICK_LEAVES_OUT:
            yield scenario, "left out by --quick"


def _left_out(scenario: Scenario, why: str) -> Result:
    return Result(
        scenario=scenario.name,
        promise=scenario.promise,
        rows=unmeasured(scenario.name, scenario.criteria, why),
    )


def _jobs(wanted: Wanted, chosen: list[Scenario], console: Console) -> dict[str, Job]:
    """By scenario; the ground that they need is there afterwards. Longest first, or the end is one long wait."""
    skipped = {scenario.name for scenario, _ in _not_flown(wanted, chosen)}
    flown = sorted((s for s in chosen if s.name not in skipped), key=lambda s: -s.frames)
    threads = max(1, (os.cpu_count() or 1) // wanted.workers)
    jobs: dict[str, Job] = {}
    for scenario in flown:
        out = str(wanted.out / scenario.name.replace(" ", "-").replace("%", "percent"))
        frames = _frames(wanted, scenario) if wanted.quick else None
        place = Job(
            scenario=scenario.name,
            flight=wanted.flight,
            map=str(wanted.map_path or ""),
            truth=str(wanted.truth),
            out=out,
            frames=frames,
            models=list(wanted.models),
            configs=[str(path.resolve()) for path in wanted.configs],
            threads=threads,
            seed=wanted.seed,
            other_map=str(wanted.other_map or ""),
        )
        jobs[scenario.name] = place if wanted.flight else _over_generated(place, scenario, flown, wanted, console)
    return jobs


def _over_generated(job: Job, scenario: Scenario, flown: list[Scenario], wanted: Wanted, console: Console) -> Job:
    frames = {s.name: _frames(wanted, s) for s in flown}
    kind = _kind(scenario)
    longest = max(frames[s.name] for s in flown if _kind(s) == kind)
    ground = _ground(wanted, kind, longest, console)
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


def _frames(wanted: Wanted, scenario: Scenario) -> int:
    """Of a generated flight."""
    return min(QUICK_FRAMES, scenario.frames) if wanted.quick else scenario.frames


def _kind(scenario: Scenario) -> str:
    return "base" if scenario.ground == CLOSED_LOOP else scenario.ground


def _ground(wanted: Wanted, kind: str, frames: int, console: Console) -> Path:
    """The folder of a piece of generated ground; made when it is not there, or its flight is too short."""
    folder = wanted.out / "ground" / kind.replace(" ", "-")
    mark = folder / GROUND_JOB
    if mark.is_file():
        there = msgspec.json.decode(mark.read_bytes(), type=GroundJob)
        # The base flight is flown in parts, too; of the others the parts are laid out on the ground itself.
        enough = there.frames >= frames if kind == "base" else there.frames == frames
        if there.kind == kind and there.seed == wanted.seed and enough:
            return folder
        mark.unlink()
    from terrafix_tools.accept.generated import make  # a flight that is given needs no world

    with console.status(f"ground and flight: {kind}, {frames} frames"):
        make(kind, folder, seed=wanted.seed, frames=frames)
    mark.write_bytes(msgspec.json.encode(GroundJob(kind, wanted.seed, frames)))
    return folder


def _make_room(wanted: Wanted) -> None:
    """An output folder that can be written, and a flight that has a map and a truth."""
    try:
        wanted.out.mkdir(parents=True, exist_ok=True)
        probe = wanted.out / "acceptance.partial"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise OutputError(f"{wanted.out}: cannot be written ({error.strerror}); choose another --out") from None
    if wanted.flight:
        source = open_source(wanted.flight)
        missing = wanted.map_path is None and source.map_hint() is None
        source.close()
        if missing:
            raise MapError(f"{wanted.flight}: the flight names no map; give one with --map (GeoTIFF or map package)")
        if wanted.truth is None or not wanted.truth.is_file():
            raise UsageError(f"{wanted.flight}: no truth.csv or coordinates.csv there; give one with --truth")


def _kept(job: Job) -> Result | None:
    """The result of an earlier run of the very same job."""
    out = Path(job.out)
    try:
        if (out / JOB).read_bytes() == _encoded(job):
            return msgspec.json.decode((out / RESULT).read_bytes(), type=Result)
    except (OSError, msgspec.DecodeError):
        pass
    return None


def _encoded(job: Job) -> bytes:
    return msgspec.json.format(msgspec.json.encode(job))


def _flown(jobs: dict[str, Job], workers: int, progress: Progress, task: TaskID) -> Iterator[Result]:
    with ThreadPoolExecutor(workers) as pool:
        running: dict[Future[Result], str] = {pool.submit(_fly, job): name for name, job in jobs.items()}
        while running:
            active = [name for future, name in running.items() if future.running()]
            progress.update(task, description=f"scenarios ({', '.join(active)})")
            done, _ = wait(running, timeout=LOOK_S, return_when=FIRST_COMPLETED)
            for future in done:
                del running[future]
                try:
                    yield future.result()
                except BaseException:
                    pool.shutdown(wait=False, cancel_futures=True)
                    raise


def _crashed(scenario: Scenario, out: Path, traceback: str) -> Result:
    """A bug in one scenario is a result, too: it must not hide the others."""
    (out / CRASH).write_text(traceback, encoding="utf-8")
    last = traceback.strip().splitlines()[-1] if traceback.strip() else "killed"
    rows = failed(scenario.name, scenario.criteria, f"the flight crashed: {last}; see {out / CRASH}")
    return Result(scenario=scenario.name, promise=scenario.promise, rows=rows)


def _fly(job: Job) -> Result:
    out = Path(job.out)
    out.mkdir(parents=True, exist_ok=True)
    (out / RESULT).unlink(missing_ok=True)
    (out / JOB).write_bytes(_encoded(job))
    # One thread for each library: scenarios, not threads, are what fills the cores.
    environment = os.environ | {"OMP_NUM_THREADS": str(job.threads)}
    done = subprocess.run(
        [sys.executable, "-m", fly.__name__, str(out / JOB)], stderr=subprocess.PIPE, text=True, env=environment
    )
    # Over a generated place a mistake is nobody's but ours.
    if (kind := _MISTAKES.get(done.returncode)) and not job.generated:
        raise kind(f"scenario '{job.scenario}': {done.stderr.strip()}")
    if done.returncode != 0:
        return _crashed(BY_NAME[job.scenario], out, done.stderr)
    return msgspec.json.decode((out / RESULT).read_bytes(), type=Result)
