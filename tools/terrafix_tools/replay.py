"""`terrafix replay`: a recorded flight through the nodes that run in flight, as fast as this machine can."""

import importlib
import json
import math
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

from terrafix.core.config import Config, load
from terrafix.core.errors import MapError, ModelError, UsageError
from terrafix.core.flight_id import recorded_flight_id
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.geodesy import LocalFrame
from terrafix.core.initial_position import start_is_unknown, with_map_center
from terrafix.core.node import Node, NodeContext
from terrafix.core.passwords import without_password
from terrafix.map.package import MapPackage
from terrafix.messages import Message, Origin, SourceEnded, SourceFacts
from terrafix.processes import PROCESSES
from terrafix.recorder.provenance import header, versions
from terrafix.vision.sources import Shot, Source, open_configured
from terrafix.vision.sources.facts import facts_of
from terrafix.vision.sources.stream_address import is_live
from terrafix_engines.runtime import ModelFileError
from terrafix_engines.store import StoredModel, models_folder, resolve_model
from terrafix_tools.flight_map import package_of
from terrafix_tools.in_process import InProcessShell
from terrafix_tools.likely_cause import UNMEASURED
from terrafix_tools.live import swapped_hint
from terrafix_tools.map_probe import likely_factor
from terrafix_tools.progress import LineProgress
from terrafix_tools.replay_output import ReplayOutput
from terrafix_tools.rerun.earlier import REBUILT, EarlierPart, begin_with
from terrafix_tools.rerun.frames import RecordedFrames
from terrafix_tools.source.text import fact_lines

# processes that compute the estimate; link, health and recorder need a live system
REPLAYED_PROCESSES = ("vision", "anchor", "estimator", "smoother")
NOT_MODELS = ("folder", "correlation")  # keys of [models] that are no models
FRAMES_KEPT = 32  # frames that a node may still request; the size of the live frame ring

MakeNodes = Callable[[NodeContext], Mapping[str, Node]]
MakeSource = Callable[[Source], Source]
Watch = Callable[[list[Message]], None]


def make_nodes(ctx: NodeContext) -> dict[str, Node]:
    """Creates the nodes of the process table that compute the estimate."""
    made = {}
    for process in PROCESSES:
        if process.name in REPLAYED_PROCESSES:
            rebuilt = replace(ctx, epoch_ns=None) if process.name in REBUILT else ctx  # not as after a restart
            made[process.name] = importlib.import_module(process.module).make_node(rebuilt)
    return made


def replay(
    flight: Path | str | Source,
    map_path: Path | None,
    out: Path,
    *,
    models: list[str] | None = None,
    configs: list[Path] | None = None,
    progress: bool = False,
    start: tuple[float, float] | None = None,
    topics: Mapping[str, str] | None = None,
    nodes: MakeNodes = make_nodes,
    wrap_source: MakeSource = lambda source: source,
    watch: Watch = lambda messages: None,
    earlier: EarlierPart | None = None,
) -> dict[str, Any]:
    """Writes estimates.csv, flight.mcap and summary.json into ``out`` and returns the summary.

    ``flight``: a source, or its name. ``models``: NAME=PATH. ``start``: (lat_deg, lon_deg), overrides the source's.
    ``topics``: of a bag, by kind.
    ``nodes`` and ``wrap_source`` wrap the nodes and the source (to measure time, to inject faults). ``watch`` gets the
    messages of the origin, of each frame and of the end, when they are on disk. ``earlier``: what an ended replay has
    computed; the source begins after it. Raises subclasses of TerrafixError.
    """
    began_s = time.perf_counter()
    config = _with_models(load(configs or []), models or [])
    if isinstance(flight, (str, Path)):
        name = re.sub(r"^([a-z]+):/(?!/)", r"\1://", str(flight))  # a Path has made one slash of two
        if is_live(name) and not Path(flight).exists():
            shown = without_password(name)
            raise UsageError(f"{shown}: a live camera cannot be replayed; fly it with 'terrafix run --source {shown}'")
        flight = open_configured(config.source, str(flight), start, topics)
    opened, source = flight, wrap_source(flight)
    package = package_of(_map_of(map_path, config, source), progress=progress)
    origin, map_summary = _check_map(package, source.origin())
    shots: Iterator[Shot] | None = None
    if not origin.flight_id:
        first = next(decoded := opened.shots(), None)
        if source is opened and first is not None:  # the first image is not decoded again
            shots = chain((first,), decoded)
        flight_id = recorded_flight_id(origin, None if first is None else first.image)
        origin = msgspec.structs.replace(origin, flight_id=flight_id)
    facts = facts_of(opened)
    if progress:
        for line in fact_lines(source.name(), facts):
            Console(stderr=True).print(line, markup=False, highlight=False, soft_wrap=True)
    with ReplayOutput(out, header(config, package.resolve()), config.recorder) as output:
        frames = MemoryFrameStore(FRAMES_KEPT)
        ctx = NodeContext(
            config=config,
            frames=frames,
            map_path=package.resolve(),
            out_dir=out.resolve(),
            epoch_ns=None if earlier is None else origin.t_ns,
        )
        published: list[Message] = []
        made = nodes(ctx)
        shell = InProcessShell(made, lambda _who, message: published.append(message))

        def step_done() -> None:
            output.take(published)
            watch(published)
            published.clear()

        if earlier is None:
            begun = 0, origin.t_ns
            shell.feed(origin)
            shell.feed(SourceFacts(t_ns=origin.t_ns, facts=tuple(facts)))
            step_done()
        else:
            begun = earlier.frames, begin_with(earlier, made, published, step_done)
            output.copy_images(earlier.record)
            earlier.record.unlink()
        _feed_flight(shots or source.shots(), source.length(), begun, shell, frames, published, output, watch, progress)
        counts = output.counts()
        if UNMEASURED in counts["verdict"]["cause"] and not isinstance(opened, RecordedFrames):
            counts = output.counts(likely_factor(opened.shots(), origin, package))
        source.close()
        summary = {
            "flight": source.name(),
            "source": str(flight.record) if isinstance(flight, RecordedFrames) else _name_of(flight),
            "source_facts": [fact._asdict() for fact in facts],
            "map": map_summary,
            "models": {k: v for k, v in msgspec.to_builtins(config.models).items() if v and k not in NOT_MODELS},
            "config": msgspec.to_builtins(config),
            "versions": versions(),
            **counts,
            "peak_memory_mb": peak_memory_mb(),
            "wall_s": round(time.perf_counter() - began_s, 2),
        }
        output.finish(summary)
    if progress:
        Console(stderr=True).print(_result_line(summary, out))
        if summary["lens"] is not None:
            Console(stderr=True).print(summary["lens"], markup=False)
        Console(stderr=True).print(summary["verdict"]["text"], markup=False, highlight=False)
    return summary


def peak_memory_mb() -> float:
    """Peak resident memory of this program, MB. Not getrusage, whose value includes the parent before execve(2)."""
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmHWM:"):
            return round(int(line.split()[1]) / 1024, 1)
    raise RuntimeError("/proc/self/status has no VmHWM")


def _feed_flight(
    shots: Iterator[Shot],
    length: int | None,
    begun: tuple[int, int],
    shell: InProcessShell,
    frames: MemoryFrameStore,
    published: list[Message],
    output: ReplayOutput,
    watch: Watch,
    progress: bool,
) -> None:
    """Feeds the frames one after the other. ``begun``: number of frames before them, and time of the last [ns].
    Recording is outside the measured time: in flight it is another process."""
    count, last_ns = begun
    with _bar(progress, length) as step:
        while True:
            began_s = time.perf_counter()
            shot = next(shots, None)  # reads and decodes the image
            if shot is None:
                break
            if shot.image is not None:
                frames.put(shot.frame.frame_id, shot.image)
            for message in (*shot.imu, *shot.states, *shot.others):
                shell.feed(message)
            shell.feed(shot.frame)
            process_ms = (time.perf_counter() - began_s) * 1e3
            output.take(published)
            output.frame_done(shot.frame, shot.image, process_ms)
            watch(published)
            published.clear()
            count, last_ns = count + 1, shot.frame.t_ns
            step()
    shell.feed(SourceEnded(t_ns=last_ns, frames=count))
    output.take(published)
    watch(published)


def _name_of(flight: Path | str | Source) -> str:
    return str(flight) if isinstance(flight, (str, Path)) else flight.name()


def _with_models(config: Config, models: list[str]) -> Config:
    """Returns the configuration with the command line's models in its [models]: NAME=PATH, or NAME alone for a fetched
    model. Every file must exist.
    """
    known = [f.name for f in msgspec.structs.fields(type(config.models)) if f.name not in NOT_MODELS]
    models_by_name: dict[str, str] = {}
    for text in models:
        name, equals, path = text.partition("=")
        if equals and not path:
            raise UsageError(f"--model '{text}': write NAME=PATH, or NAME alone for a model that was fetched")
        if name not in known:
            raise UsageError(f"--model '{text}': unknown model '{name}'; known: {', '.join(known)}")
        models_by_name[name] = path or name
    chosen = msgspec.structs.replace(config.models, **models_by_name)
    for name in known:
        if wanted := getattr(chosen, name):
            _check_model(wanted, name, models_folder(chosen.folder))
    return msgspec.structs.replace(config, models=chosen)


def _check_model(wanted: str, name: str, folder: Path) -> None:
    try:
        found = resolve_model(wanted, name, folder)
        exists = found.exists() if isinstance(found, StoredModel) else os.path.isfile(found)
    except ModelFileError as error:
        raise ModelError(str(error)) from None
    if not exists:
        path, todo = (
            (found.path, f"terrafix models fetch {found.manifest.name}")
            if isinstance(found, StoredModel)
            else (found, "check the path")
        )
        raise ModelError(f"{path}: no such model file ({name}); {todo}, or omit it to fly without weights")


def _map_of(map_path: Path | None, config: Config, source: Source) -> Path:
    chosen = map_path or (Path(config.map.path) if config.map.path else None) or source.map_hint()
    if chosen is None:
        raise MapError(f"{source.name()}: the flight names no map; give one with --map (GeoTIFF or map package)")
    return chosen


def _check_map(package: Path, origin: Origin) -> tuple[Origin, dict[str, Any]]:
    """Returns the origin, with its ground height where the map has it, and the map section of the summary."""
    opened = MapPackage.open(package)
    try:
        unknown = start_is_unknown(origin)
        origin = with_map_center(origin, opened.manifest.bounds_wgs84)
        frame = LocalFrame(origin.lat_deg, origin.lon_deg)
        local = opened.bind(frame)
        if not unknown and not opened.covers_start(origin.lat_deg, origin.lon_deg, origin.start_sigma_m):
            todo = swapped_hint(opened, origin.lat_deg, origin.lon_deg, origin.start_sigma_m)
            todo = todo or "use another --map or check the start"
            raise MapError(f"{package}: {_not_covered(origin, local.bounds_m)}; {todo}")
        if origin.ground_amsl_m is None:
            ground_m = opened.ground_amsl_m(origin.lat_deg, origin.lon_deg)
            origin = msgspec.structs.replace(origin, ground_amsl_m=ground_m)
        manifest = opened.manifest
        return origin, {
            "path": str(package.absolute()),
            "source": manifest.source,
            "checksum": manifest.checksum,
            "gsd_m": manifest.gsd_m,
            "date": manifest.date,
            "has_dem": manifest.has_dem,
            "inputs": [statement.text() for statement in manifest.inputs],
        }
    finally:
        opened.close()


def _not_covered(origin: Origin, bounds_m: tuple[float, float, float, float]) -> str:
    e_min, n_min, e_max, n_max = bounds_m
    away_m = math.hypot(max(e_min, -e_max, 0.0), max(n_min, -n_max, 0.0))
    place = f"start {origin.lat_deg:.6f}, {origin.lon_deg:.6f}"
    if away_m == 0.0:
        return f"has no imagery at the {place}"
    distance = f"{away_m / 1000:.1f} km" if away_m >= 1000 else f"{away_m:.0f} m"
    return f"does not cover the {place}; its nearest edge is {distance} away"


@contextmanager
def _bar(shown: bool, total: int | None) -> Iterator[Callable[[], None]]:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with LineProgress(*columns, console=Console(stderr=True), shown=shown) as progress:
        task = progress.add_task("replay", total=total)
        yield lambda: progress.advance(task)


def _result_line(summary: dict[str, Any], out: Path) -> str:
    timing = json.dumps(summary["frame_ms_median"])
    return (
        f"{summary['localised']} of {summary['frames']} frames localised, median {timing} ms a frame; written to {out}"
    )
