"""Scenarios with false inputs over several places and seeds: python -m terrafix_lab.accept.adversary --help.

Places: pairs of images of one place at two dates (one for the camera, one for the map), the generated world, recorded
flights. All results are in --out; existing ones are not flown again."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Annotated

import msgspec
import rasterio
import typer
from rasterio.errors import RasterioIOError

from terrafix.core.errors import OutputError, UsageError
from terrafix_lab.accept.cases_table import Case, CaseLine, lines_of, markdown
from terrafix_lab.accept.run import AcceptOptions, accept, truth_of
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.flights import make as making
from terrafix_lab.standalone import run_standalone

DURATION_S = 50.0  # of a simulated flight; 100 frames
# Vehicle and height over an image: the first one whose turns fit into it.
FLOWN_BY = ((Kind.PLANE, 130.0), (Kind.COPTER, 110.0), (Kind.COPTER, 90.0))
MAX_PIXEL_M = 1.0  # of an image: a coarser one lacks the detail of a frame
BROKEN_FLOOR = 1  # exit code
NAME = "adversary"


@dataclass(frozen=True)
class Pair:
    """One place at two dates."""

    name: str
    camera: Path
    map_path: Path


def pairs(imagery: Path) -> list[Pair]:
    """One pair of each folder in ``imagery`` with two or more colour images (the first two by name), then all pairs
    with camera and map exchanged. Raises UsageError: there is none."""
    folders = [sorted(filter(_is_image, folder.glob("*.tif"))) for folder in sorted(imagery.glob("*/"))]
    dates = [images[:2] for images in folders if len(images) >= 2]
    if not dates:
        raise UsageError(
            f"{imagery}: no folder there has two GeoTIFFs in colour with pixels of {MAX_PIXEL_M:g} m or less"
        )
    forward = [Pair(a.parent.name, a, b) for a, b in dates]
    return forward + [Pair(f"{p.name}, reversed", p.map_path, p.camera) for p in forward]


def _is_image(path: Path) -> bool:
    try:
        with rasterio.open(path) as source:
            fine = source.crs.is_projected and abs(source.transform.a) <= MAX_PIXEL_M
            return bool(source.count >= 3 and source.dtypes[0] == "uint8" and fine)
    except RasterioIOError:
        return False


def over_pairs(chosen: list[Pair], seeds: list[int], out: Path, options: AcceptOptions) -> Iterator[Case]:
    """Makes each flight on demand. The map of another town is that of the next place in the list."""
    for seed in seeds:
        for number, pair in enumerate(chosen):
            name = f"{pair.name}, seed {seed}"
            folder = out / "flights" / _folder(name)
            others = [
                p.map_path for p in chosen[number + 1 :] + chosen[:number] if p.map_path.parent != pair.camera.parent
            ]
            _make(folder, pair, seed)
            yield Case(name, _of(options, name, out, folder, pair.map_path, others[0] if others else None))


def _make(folder: Path, pair: Pair, seed: int) -> None:
    """Makes the flight folder if it does not exist. Raises UsageError: no flight fits over the image."""
    if folder.is_dir():
        return
    part = folder.with_suffix(".partial")
    shutil.rmtree(part, ignore_errors=True)
    why = ""
    for kind, agl_m in FLOWN_BY:
        request = making.FlightOptions(
            seed=seed, image=pair.camera, map_path=pair.map_path, vehicle=kind, duration_s=DURATION_S, agl_m=agl_m
        )
        try:
            making.make(part, request, progress=False)
        except UsageError as error:
            why = str(error)
            continue
        part.rename(folder)
        return
    raise UsageError(f"{pair.camera}: no flight has room over it; {why}")


def over_flights(flights: list[str], out: Path, options: AcceptOptions) -> Iterator[Case]:
    """``flights``: FLIGHT,MAP each."""
    for text in flights:
        flight, comma, map_path = text.rpartition(",")
        if not comma:
            raise UsageError(f"--flight '{text}': write FLIGHT,MAP")
        name = f"{Path(flight).name}, {Path(map_path).stem}"
        yield Case(name, _of(options, name, out, Path(flight), Path(map_path), None))


def over_generated(seeds: list[int], out: Path, options: AcceptOptions) -> Iterator[Case]:
    for seed in seeds:
        name = f"generated, seed {seed}"
        yield Case(name, replace(options, out=out / _folder(name), seed=seed))


def _of(
    options: AcceptOptions, name: str, out: Path, flight: Path, map_path: Path, other_map: Path | None
) -> AcceptOptions:
    return replace(
        options,
        out=out / _folder(name),
        flight=str(flight),
        map_path=map_path,
        truth=truth_of(str(flight), None),
        other_map=other_map,
    )


def _folder(name: str) -> str:
    return name.replace(",", "").replace(" ", "-")


def fly(cases: Iterator[Case], out: Path) -> list[CaseLine]:
    """Flies the cases in order and rewrites adversary.json and adversary.md after each. Raises TerrafixError."""
    lines: list[CaseLine] = []
    for case in cases:
        typer.echo(f"== {case.name}", err=True)
        lines += lines_of(case, accept(case.options))
        _write(out, lines)
    return lines


def _write(out: Path, lines: list[CaseLine]) -> None:
    text = {"json": json.dumps([msgspec.to_builtins(line) for line in lines], indent=1), "md": markdown(lines)}
    for suffix, content in text.items():
        target = out / f"{NAME}.{suffix}"
        try:
            target.write_text(content, encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{target}: cannot be written ({error.strerror}); choose another --out") from None


def main(
    out: Annotated[Path, typer.Option(help="Folder for flights, replays and the table.")],
    imagery: Annotated[
        Path | None, typer.Option(help="Folder of folders, each with two GeoTIFFs of one place at two dates.")
    ] = None,
    places: Annotated[int, typer.Option(min=1, help="How many pairs of images; a pair turned round is another.")] = 3,
    seeds: Annotated[str, typer.Option(help="Seeds of flights and generated worlds, for example 1,2.")] = "1",
    generated: Annotated[bool, typer.Option("--generated", help="Also over the generated world.")] = False,
    flight: Annotated[list[str] | None, typer.Option(help="FLIGHT,MAP: also this recorded flight.")] = None,
    scenario: Annotated[list[str] | None, typer.Option(help="Only this scenario; may be given several times.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="120 frames of each flight.")] = False,
    workers: Annotated[int, typer.Option(min=1, help="Scenarios at a time; each keeps a core busy.")] = 1,
) -> None:
    """All scenarios with false inputs over several places and seeds. Exit code 0: all floors hold; 1: one does not."""
    if not (imagery or generated or flight):
        raise UsageError("nowhere to fly; give --imagery, --generated or --flight")
    try:
        numbers = [int(text) for text in seeds.split(",")]
    except ValueError:
        raise UsageError(f"--seeds '{seeds}': write numbers, for example 1,2") from None
    options = AcceptOptions(
        out=out, scenarios=tuple(scenario or ()), quick=quick, resume=True, lies=True, workers=workers
    )
    out.mkdir(parents=True, exist_ok=True)
    chosen = pairs(imagery)[:places] if imagery else []
    cases = chain(
        over_generated(numbers, out, options) if generated else (),
        over_flights(flight or [], out, options),
        over_pairs(chosen, numbers, out, options),
    )
    lines = fly(cases, out)
    typer.echo(f"{sum(line.broken > 0 for line in lines)} of {len(lines)} flights break a floor; {out / NAME}.md")
    raise typer.Exit(BROKEN_FLOOR if any(line.broken for line in lines) else 0)


if __name__ == "__main__":
    run_standalone("adversary", main)
