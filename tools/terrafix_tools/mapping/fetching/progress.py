"""Progress display of downloads: bar, tiles, megabytes, rate and remaining time."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

from terrafix_tools.progress import LineProgress


@dataclass
class DownloadProgress:
    """Counters of one download."""

    total: int
    tiles: int = 0  # received
    absent: int = 0  # that the server does not have
    failed: int = 0
    size_bytes: int = 0

    @property
    def done(self) -> int:
        return self.tiles + self.absent + self.failed


OnProgress = Callable[[DownloadProgress], None]


@contextmanager
def shown(say: Console, title: str) -> Iterator[OnProgress]:
    """Yields a function that displays the state of a download."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[size]}"),
        TimeRemainingColumn(elapsed_when_finished=True),
    )
    with LineProgress(*columns, console=say) as progress:
        task = progress.add_task(title, total=None, size="")

        def draw(state: DownloadProgress) -> None:
            speed = progress.tasks[0].finished_speed or progress.tasks[0].speed
            size = f"{state.size_bytes / 1e6:.1f} MB" + (f", {speed:.1f}/s" if speed else "")
            progress.update(task, completed=state.done, total=state.total, size=size)

        yield draw


@contextmanager
def steps_display(say: Console) -> Iterator[Callable[[str, int | None], Callable[[], None]]]:
    """Yields a function (name, steps or None) -> step(), for the collar search."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with LineProgress(*columns, console=say) as progress:

        def start(name: str, total: int | None) -> Callable[[], None]:
            task = progress.add_task(name, total=total)
            return lambda: progress.advance(task)

        yield start
