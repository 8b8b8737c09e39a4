"""Progress of the commands: bars in a terminal, a line every 15 s where the output is piped."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

Step = Callable[[], None]
Bar = Callable[[str, int | None], Step]
LINE_INTERVAL_S = 15.0


class LineProgress(Progress):
    """Rich's bars in a terminal; else a line every LINE_INTERVAL_S with what is done, also while a step takes long."""

    def __init__(self, *columns: Any, console: Console, shown: bool = True, transient: bool = False) -> None:
        super().__init__(*columns, console=console, transient=transient, disable=not (shown and console.is_terminal))
        self._lines = _Lines(console, self._state) if shown and not console.is_terminal else None

    def start(self) -> None:
        super().start()
        if self._lines is not None:
            self._lines.start()

    def stop(self) -> None:
        super().stop()
        if self._lines is not None:
            self._lines.stop()

    def _state(self) -> str:
        task = next((task for task in reversed(self.tasks) if not task.finished), None)
        if task is None:
            return "working"
        of = "" if task.total is None else f" of {task.total:.0f}"
        return f"{task.description}: {task.completed:.0f}{of}"


class _Lines:
    """Prints ``state()`` every LINE_INTERVAL_S from its start to its stop."""

    def __init__(self, console: Console, state: Callable[[], str]) -> None:
        self._console, self._state, self._stopped = console, state, threading.Event()
        self._thread = threading.Thread(target=self._run, name="progress-lines", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stopped.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stopped.wait(LINE_INTERVAL_S):
            self._console.print(self._state(), highlight=False, markup=False, soft_wrap=True)


@contextlib.contextmanager
def waiting(console: Console, text: str) -> Iterator[None]:
    """A spinner in a terminal; else ``text`` as a line every LINE_INTERVAL_S."""
    if console.is_terminal:
        with console.status(text):
            yield
        return
    lines = _Lines(console, lambda: text)
    lines.start()
    try:
        yield
    finally:
        lines.stop()


@contextlib.contextmanager
def progress_bar(shown: bool) -> Iterator[Bar]:
    """Yields a function (name, steps or None) -> step()."""
    columns = (TextColumn("{task.description:>9}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with LineProgress(*columns, console=Console(stderr=True), shown=shown) as progress:

        def start(name: str, total: int | None) -> Step:
            task = progress.add_task(name, total=total)
            return lambda: progress.advance(task)

        yield start
