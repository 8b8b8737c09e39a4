"""From an area and its sources to the layers of a map: estimate, confirmation, download, assembly."""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

from rich.console import Console

from terrafix_tools.mapping.area.polygons import Area
from terrafix_tools.mapping.fetching.plan import (
    PACKAGE_BYTES_PER_PX,
    FetchEstimate,
    check_consent,
    check_room,
    describe,
)
from terrafix_tools.mapping.fetching.progress import OnProgress, shown, steps_display
from terrafix_tools.mapping.layers import LayerInput
from terrafix_tools.mapping.mosaic.compositing import Mosaic, MosaicPlan, Opener
from terrafix_tools.mapping.mosaic.grid import grid_for
from terrafix_tools.mapping.sources.collared import raster_opener
from terrafix_tools.mapping.sources.copernicus.sentinel import SentinelJob
from terrafix_tools.mapping.sources.spec import SourceSpec
from terrafix_tools.mapping.sources.tiles.job import TileJob, tile_file_opener


@dataclass(frozen=True)
class Request:
    """The options of a build. ``gsd_m`` None: the resolution of the first source."""

    area: Area
    specs: Sequence[SourceSpec]
    cache: Path
    out: Path
    gsd_m: float | None = None


class Job(Protocol):
    """One network source for one area."""

    spec: SourceSpec

    @property
    def date(self) -> str: ...
    @property
    def licence(self) -> str: ...
    def estimate(self) -> FetchEstimate: ...
    def fetch(self, on_progress: OnProgress) -> None: ...
    def openers(self) -> list[Opener]: ...


class Preparation:
    """The jobs of one request, in three steps: estimate, fetch, layers."""

    def __init__(self, request: Request, say: Console) -> None:
        """Raises UsageError, MapError (a source that cannot be opened), FetchError (capabilities)."""
        self._request, self._say = request, say
        self._jobs: dict[int, Job] = {}
        for i, spec in enumerate(request.specs):
            if spec.service:
                self._jobs[i] = SentinelJob(spec, request.area, request.cache)
            elif spec.from_network:
                self._jobs[i] = TileJob(spec, request.area, request.gsd_m, request.cache)

    def estimate(self) -> list[FetchEstimate]:
        """Prints and returns the remaining download of each source. Raises as the jobs do.

        The gaps of a better network source are unknown until it is downloaded."""
        made = []
        for i, job in self._jobs.items():
            if isinstance(job, TileJob):
                job.drop_covered(self._better_sources(i, fetched=False))
            made.append(job.estimate())
            self._say.print(describe(made[-1]), highlight=False)
        return made

    def fetch(self, estimates: Sequence[FetchEstimate], *, agreed: bool) -> None:
        """Raises UsageError when the download is large and not confirmed, OutputError when it does not fit."""
        check_consent(estimates, agreed)
        check_room(estimates, self._request.cache, 0.0, self._request.out)
        for i, job in self._jobs.items():
            if isinstance(job, TileJob) and any(j < i for j in self._jobs):
                job.drop_covered(self._better_sources(i, fetched=True))
            try:
                with shown(self._say, job.spec.title) as on_progress:
                    job.fetch(on_progress)
            except KeyboardInterrupt:
                self._say.print("stopped; what came is kept, the same command goes on from here")
                raise

    def _better_sources(self, i: int, *, fetched: bool) -> tuple[Opener, ...]:
        """Sources of the same layer with higher priority; network sources only when they are ``fetched``."""
        specs = self._request.specs
        chosen = [j for j in range(i) if specs[j].layer == specs[i].layer and (fetched or j not in self._jobs)]
        return tuple(opener for j in chosen for opener in self._openers(j))

    def layers(self) -> list[LayerInput]:
        """One per `layer` of the sources, in order of first appearance. Raises MapError, OutputError."""
        made = []
        for layer in dict.fromkeys(spec.layer for spec in self._request.specs):
            chosen = [i for i, spec in enumerate(self._request.specs) if spec.layer == layer]
            made.append(self._layer(layer, chosen))
        return made

    def _layer(self, layer: str, chosen: list[int]) -> LayerInput:
        request = self._request
        openers = [opener for i in chosen for opener in self._openers(i)]
        # The resolution of tiles is already determined by their zoom level.
        first = request.specs[chosen[0]]
        gsd_m = None if first.of_tiles else request.gsd_m
        with contextlib.ExitStack() as stack:
            grid = grid_for(request.area, [stack.enter_context(opener()) for opener in openers], gsd_m)
        check_room([], request.cache, grid.width_px * grid.height_px * PACKAGE_BYTES_PER_PX, request.out)
        specs = [request.specs[i] for i in chosen]
        jobs = [self._jobs.get(i) for i in chosen]
        dates = [job.date if job else spec.date for spec, job in zip(specs, jobs, strict=True)]
        licences = [job.licence if job else spec.licence for spec, job in zip(specs, jobs, strict=True)]
        stated = [spec.ce90_m for spec in specs]
        return LayerInput(
            open=partial(Mosaic, MosaicPlan(request.area, grid, tuple(openers))),
            source=layer or ", ".join(dict.fromkeys(spec.title for spec in specs)),
            date=min((d for d in dates if d), default=""),  # the date of a mosaic is that of its oldest part
            licence="; ".join(dict.fromkeys(text for text in licences if text)),
            ce90_m=None if None in stated else max(v for v in stated if v is not None),
        )

    def _openers(self, i: int) -> list[Opener]:
        spec, request = self._request.specs[i], self._request
        if i in self._jobs:
            return self._jobs[i].openers()
        if spec.of_tiles:
            return [tile_file_opener(spec, request.area, request.gsd_m)]
        with steps_display(self._say) as bar:
            return [raster_opener(Path(spec.path), request.cache, bar)]
