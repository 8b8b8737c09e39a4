"""Progress bars of the commands, on stderr."""

import contextlib
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

Step = Callable[[], None]
Bar = Callable[[str, int | None], Step]


@contextlib.contextmanager
def progress_bar(shown: bool) -> Iterator[Bar]:
    """Yields a function (name, steps or None) -> step()."""
    columns = (TextColumn("{task.description:>9}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), disable=not shown) as progress:

        def start(name: str, total: int | None) -> Step:
            task = progress.add_task(name, total=total)
            return lambda: progress.advance(task)

        yield start
