"""The processes that compute flights: as many at once as allowed, those that wait for images make room for others."""

import asyncio
import logging
import os
import signal
import sys
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from terrafix_tools.console.settings import Settings

STOP_S = 5.0  # longest wait for a process that was asked to end
MAX_DEATHS = 5  # in a row without a result, after which a flight is given up [spec: docs/console.md]
RESTART_S = 1.0  # between a death and the next process of this flight
LINE_BYTES = 64 * 1024

log = logging.getLogger("terrafix.console")


@dataclass
class _Running:
    process: asyncio.subprocess.Process
    frame_id: int = -1  # that it computes
    waiting: bool = False  # for images
    ending: bool = False  # was asked to end
    result: str = ""  # "done", or why it failed
    stored: int = 0  # results of this process
    task: "asyncio.Task[None] | None" = field(default=None, repr=False)


@dataclass(frozen=True)
class Reports:
    """Calls to the owner. ``stored``: something of a flight was committed; ``died``: a process of a flight died at
    a frame, not by SIGKILL; ``failed``: a flight cannot be computed, and why."""

    stored: Callable[[str], Awaitable[None]]
    died: Callable[[str, int], Awaitable[None]]
    failed: Callable[[str, str], Awaitable[None]]


class Workers:
    """All methods run in the event loop."""

    def __init__(self, settings: Settings, reports: Reports) -> None:
        self._settings, self._reports = settings, reports
        self._running: dict[str, _Running] = {}
        self._queue: OrderedDict[str, Path] = OrderedDict()  # flights that wait for a process, with their maps
        self._deaths: dict[str, int] = {}
        self._stopping = False

    @property
    def count(self) -> int:
        return len(self._running)

    @property
    def waiting(self) -> int:
        return len(self._queue)

    async def wake(self, flight_id: str, map_path: Path) -> None:
        """There is something to compute, now or as soon as a process is free."""
        running = self._running.get(flight_id)
        if running is not None and not running.ending:
            running.waiting = False
            assert running.process.stdin is not None
            running.process.stdin.write(b"\n")
            return
        self._queue[flight_id] = map_path
        await self._start_next()

    def forgive(self, flight_id: str) -> None:
        """The deaths of its processes do not count any more."""
        self._deaths.pop(flight_id, None)

    async def end(self, flight_id: str) -> None:
        """The flight is deleted."""
        self._queue.pop(flight_id, None)
        running = self._running.get(flight_id)
        if running is not None:
            await self._end(running)

    async def stop(self) -> None:
        """Ends all. What they have stored stays; the rest is computed after the next start."""
        self._stopping = True
        self._queue.clear()
        await asyncio.gather(*(self._end(running) for running in list(self._running.values())))

    async def _end(self, running: _Running) -> None:
        running.ending = True
        if running.process.returncode is None:
            running.process.terminate()
        if running.task is not None:
            try:
                await asyncio.wait_for(asyncio.shield(running.task), STOP_S)
            except TimeoutError:
                running.process.kill()
                await running.task

    async def _start_next(self) -> None:
        while self._queue and not self._stopping:
            if len(self._running) >= self._settings.workers:
                idle = next((r for r in self._running.values() if r.waiting and not r.ending), None)
                if idle is not None:  # it begins anew when its next images come
                    idle.ending = True
                    idle.process.terminate()
                return
            flight_id = next((key for key in self._queue if key not in self._running), None)
            if flight_id is None:
                return  # its process is ending
            await self._start(flight_id, self._queue.pop(flight_id))

    async def _start(self, flight_id: str, map_path: Path) -> None:
        settings = self._settings
        options = [("--config", str(path)) for path in settings.configs] + [("--model", m) for m in settings.models]
        options += [("--scheduler", settings.scheduler)] if settings.scheduler else []
        running = _Running(
            await asyncio.create_subprocess_exec(
                sys.executable,
                "-m",
                "terrafix_tools.console.compute",
                *("--data", str(settings.data), "--flight", flight_id, "--map", str(map_path)),
                *("--parent", str(os.getpid()), "--nice", str(settings.nice)),
                *(word for option in options for word in option),
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                limit=LINE_BYTES,
                env={"OMP_NUM_THREADS": "1", **os.environ},
            )
        )
        self._running[flight_id] = running
        running.task = asyncio.create_task(self._follow(flight_id, map_path, running))

    async def _follow(self, flight_id: str, map_path: Path, running: _Running) -> None:
        """Until the process has ended."""
        assert running.process.stdout is not None
        async for line in running.process.stdout:
            word, _, rest = line.decode(errors="replace").strip().partition(" ")
            match word:
                case "frame":
                    running.frame_id, running.waiting = int(rest), False
                case "stored":
                    running.stored += 1
                    await self._reports.stored(flight_id)
                case "waiting":
                    running.waiting = True
                    await self._start_next()
                case "done":
                    running.result = word
                case "failed":
                    running.result = str(msgspec.json.decode(rest))
                    await self._reports.failed(flight_id, running.result)
                case _:
                    log.error("unknown report of a flight: %s", line)
        code = await running.process.wait()
        del self._running[flight_id]
        if not running.ending and not running.result:
            await self._died(flight_id, map_path, running, code)
        await self._start_next()

    async def _died(self, flight_id: str, map_path: Path, running: _Running, code: int) -> None:
        deaths = 1 if running.stored else self._deaths.get(flight_id, 0) + 1
        self._deaths[flight_id] = deaths
        log.error("the process of flight %s died at frame %d (exit code %d)", flight_id, running.frame_id, code)
        if code != -signal.SIGKILL and running.frame_id >= 0:  # a kill is not the fault of the image
            await self._reports.died(flight_id, running.frame_id)
        if deaths >= MAX_DEATHS:
            await self._reports.failed(flight_id, f"its process died {deaths} times in a row (exit code {code})")
            return
        await asyncio.sleep(RESTART_S)
        if not self._stopping:
            self._queue.setdefault(flight_id, map_path)
