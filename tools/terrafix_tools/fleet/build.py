"""`terrafix fleet build`: reads the flight records below a folder or in a bucket into the tables of a fleet."""

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from terrafix_tools.fleet.examine import FLEET_BUILD, Examined, Examiner, WorkerDied
from terrafix_tools.fleet.find import Place, Record, find_records, open_place
from terrafix_tools.fleet.store import FleetFolder, open_fleet
from terrafix_tools.parallel.pool import OpenRenderer, PoolProvider, Processes, render_pieces
from terrafix_tools.parallel.scheduler import connect
from terrafix_tools.progress import progress_bar

RECORDS_PER_WORKER = 4  # a process needs about a second to start, which fewer small records do not compensate
# Worker processes that may die without a finished record in between, until the next record is read alone; and the
# number of processes that die while they read it alone, until it is given up.
DEATHS, DEATHS_ALONE = 2, 2
KILLED = "a worker process died at it again and again, perhaps for want of memory"

OpenWorkers = Callable[[bool], AbstractContextManager[PoolProvider]]


@dataclass
class Result:
    """What a build has done. ``errors``: path and reason of each record that could not be read."""

    found: int = 0
    unchanged: int = 0
    new: int = 0
    grown: int = 0
    flights: int = 0  # in the fleet afterwards
    errors: list[tuple[str, str]] = field(default_factory=list)


def build(source: str, out: Path, *, workers: int, scheduler: str = "", progress: bool = False) -> Result:
    """Adds the records below ``source`` (a folder, or an address of a bucket) that are new or have changed to the fleet
    in ``out``. Raises SourceError, UsageError (the scheduler), OutputError."""
    place = open_place(source)
    cluster = connect(scheduler, FLEET_BUILD) if scheduler else None
    with cluster or nullcontext():
        records, unlisted = find_records(place)
        opened: OpenWorkers = (lambda alone: nullcontext(cluster)) if cluster else partial(processes, workers)
        limit = 1 if cluster else DEATHS + DEATHS_ALONE
        with open_fleet(out) as fleet:
            result = _build(fleet, place, records, opened, limit=limit, progress=progress)
            for path, reason in unlisted:
                result.errors.append((path, reason))
                fleet.put(Examined(Record(path, path, (), run=True, size=0, modified_ns=0), error=reason))
            fleet.finish()
            return result


def _build(
    fleet: FleetFolder, place: Place, records: list[Record], opened: OpenWorkers, *, limit: int, progress: bool
) -> Result:
    fleet.forget(place.path, records)
    changed = [record for record in records if not fleet.is_known(record)]
    result = Result(found=len(records), unchanged=len(records) - len(changed))
    with progress_bar(progress) as bar:
        step = bar("records", len(changed))
        for examined in examine_all(partial(Examiner, place), changed, opened, limit):
            new, grown = fleet.put(examined)
            result.new, result.grown = result.new + new, result.grown + grown
            if examined.error is not None:
                result.errors.append((examined.record.path, examined.error))
            step()
    result.flights = len(fleet.flights)
    return result


def processes(workers: int, after_death: bool) -> Processes:
    """After a death even a single record is read by another process, not by this one."""
    return Processes(workers, FLEET_BUILD, least=1 if after_death else 2)


def examine_all(
    open_examiner: OpenRenderer[Record, Examined], records: list[Record], opened: OpenWorkers, limit: int
) -> Iterator[Examined]:
    """Reads all records, in their order. When a worker dies, new ones read what is not finished; a record at which
    ``limit`` of them have died is given up."""
    waiting = deque(records)
    deaths = 0  # since the last record that was finished
    died = False
    while waiting:
        batch = list(waiting) if deaths < DEATHS else [waiting[0]]
        try:
            with opened(died) as workers:
                per_worker = 1 if died else RECORDS_PER_WORKER
                for examined in render_pieces(open_examiner, batch, len(batch), workers, per_worker=per_worker):
                    waiting.popleft()
                    deaths = 0
                    yield examined
        except WorkerDied:
            died, deaths = True, deaths + 1
            if deaths >= limit:
                deaths = 0
                yield Examined(waiting.popleft(), error=KILLED)
