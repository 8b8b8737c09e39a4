"""What a person sees while something is fetched: a bar, tiles, megabytes, rate and the time that is left."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


@dataclass
class Progressed:
    """Counts of one download so far."""

    total: int
    tiles: int = 0  # that came
    absent: int = 0  # that the server does not have
    failed: int = 0
    size_bytes: int = 0

    @property
    def done(self) -> int:
        return self.tiles + self.absent + self.failed


OnProgress = Callable[[Progressed], None]


@contextmanager
def shown(say: Console, title: str) -> Iterator[OnProgress]:
    """Gives a function that draws the state of a download."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[size]}"),
        TimeRemainingColumn(elapsed_when_finished=True),
    )
    with Progress(*columns, console=say, disable=not say.is_terminal) as progress:
        task = progress.add_task(title, total=None, size="")

        def draw(state: Progressed) -> None:
            speed = progress.tasks[0].finished_speed or progress.tasks[0].speed
            size = f"{state.size_bytes / 1e6:.1f} MB" + (f", {speed:.1f}/s" if speed else "")
            progress.update(task, completed=state.done, total=state.total, size=size)

        yield draw


@contextmanager
def steps_shown(say: Console) -> Iterator[Callable[[str, int | None], Callable[[], None]]]:
    """Gives a function (name, steps or None) -> step(), as the search for a collar wants it."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=say, disable=not say.is_terminal) as progress:

        def start(name: str, total: int | None) -> Callable[[], None]:
            task = progress.add_task(name, total=total)
            return lambda: progress.advance(task)

        yield start
