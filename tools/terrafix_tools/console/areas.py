"""Maps of flights that were created with an area: made in the background by `terrafix map build`, one at a time."""

import asyncio
import json
import math
import os
import sys
from collections.abc import Awaitable, Callable
from itertools import pairwise
from pathlib import Path

from terrafix.runtime.run_dir import write_atomic
from terrafix_tools.console.maps import SUFFIX
from terrafix_tools.console.payloads import RouteArea
from terrafix_tools.console.problems import Refusal

MAX_KM2 = 20_000.0  # of a corridor: what `map build` takes, which checks time and disk [spec: RS-2 of the requirements]
BUILD_S = 2 * 3600.0  # longest time of a build [spec: docs/console.md]
EARTH_M_PER_DEG = 111_320.0  # of latitude
NICE = 10  # the service and what flies come first [spec: nice(2)]

Done = Callable[[str, str], Awaitable[None]]


def map_name(flight_id: str) -> str:
    """Of the map of a flight with an area."""
    return f"area-{flight_id}"


def check_area(area: RouteArea) -> None:
    """Raises Refusal: larger than MAX_KM2."""
    points = [(p.lat, p.lon) for p in area.waypoints]
    length_m = sum(
        math.hypot(b_lat - a_lat, (b_lon - a_lon) * math.cos(math.radians(a_lat))) * EARTH_M_PER_DEG
        for (a_lat, a_lon), (b_lat, b_lon) in pairwise(points)
    )
    km2 = (length_m + 2 * area.corridor_m) * 2 * area.corridor_m / 1e6
    if km2 > MAX_KM2:
        raise Refusal(422, f"area: the corridor has {km2:,.0f} km2, at most {MAX_KM2:,.0f} are made; make it narrower")


class AreaMaps:
    """``done(flight_id, error)`` is called when a map is there ("") or could not be made. All methods run in the event
    loop."""

    def __init__(self, maps: Path, sources: Path | None, done: Done) -> None:
        self._maps, self._sources, self._done = maps, sources, done
        self._one = asyncio.Lock()
        self._tasks: dict[str, asyncio.Task[None]] = {}

    @property
    def available(self) -> bool:
        return self._sources is not None

    def begin(self, flight_id: str, area: RouteArea) -> None:
        self._tasks[flight_id] = asyncio.create_task(self._make(flight_id, area))

    async def stop(self) -> None:
        """What was begun is made after the next start."""
        for task in self._tasks.values():
            task.cancel()
        await asyncio.gather(*self._tasks.values(), return_exceptions=True)

    async def remove(self, flight_id: str) -> None:
        """The flight is deleted."""
        task = self._tasks.pop(flight_id, None)
        if task is not None:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        for path in (self._package(flight_id), self._route(flight_id)):
            path.unlink(missing_ok=True)

    def _package(self, flight_id: str) -> Path:
        return self._maps / f"{map_name(flight_id)}{SUFFIX}"

    def _route(self, flight_id: str) -> Path:
        return self._maps / f"{map_name(flight_id)}.geojson"

    async def _make(self, flight_id: str, area: RouteArea) -> None:
        async with self._one:
            error = "" if self._package(flight_id).is_file() else await self._build(flight_id, area)
        await self._done(flight_id, error)

    async def _build(self, flight_id: str, area: RouteArea) -> str:
        """-> "", or why there is no map."""
        if self._sources is None:
            return "the console was started without --sources, which this flight needs for its map"
        self._maps.mkdir(parents=True, exist_ok=True)
        line = {"type": "LineString", "coordinates": [[p.lon, p.lat] for p in area.waypoints]}
        write_atomic(
            self._route(flight_id), json.dumps({"type": "Feature", "properties": {}, "geometry": line}).encode()
        )
        words = ["map", "build", "--area", str(self._route(flight_id)), "--corridor", f"{area.corridor_m / 1000:g}"]
        words += ["--sources", str(self._sources), "--out", str(self._package(flight_id)), "--yes", "--workers", "1"]
        process = await asyncio.create_subprocess_exec(
            *("nice", "-n", str(NICE), sys.executable, "-m", "terrafix_tools.program", *words),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
            env={"OMP_NUM_THREADS": "1", **os.environ},
        )
        try:
            _, text = await asyncio.wait_for(process.communicate(), BUILD_S)
        except TimeoutError:
            return f"the map was not made within {BUILD_S / 3600:.0f} hours"
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
        if process.returncode == 0:
            return ""
        last = text.decode(errors="replace").strip().rpartition("\n")[2]
        return f"the map could not be made: {last.removeprefix('terrafix: ')[:300]}"
