"""Times that the requirements promise of a search and of the start with models, against their limits.

python -m terrafix_lab.bench.contract OUT [--map MAP.gpkg] [--models FOLDER] [--json FILE]

Exit code 1: a limit does not hold. Seconds of the processor, which other programs change least. The search is that of
the anchor, in its own process, which no frame of odometry or of the estimator waits for. Without ``--map`` a place of
KM2 square kilometres is generated in OUT, unless it is there. Four models: XFeat and LighterGlue of ``--models``, and
the two graphs of `terrafix models export`."""

import gc
import time
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from terrafix.anchor.matching.frame_matcher import FrameMatcher, View
from terrafix.anchor.relocalization.map_search import REGION_BLOCKS, MapSearch
from terrafix.anchor.relocalization.mosaic import MAX_MOSAIC_FRAMES
from terrafix.core.node import Image
from terrafix.map.null_model import DEFAULT_NULL, FalseAlarmBudget
from terrafix.map.package import LocalMap, MapPackage
from terrafix_engines.correlation import export, open_correlator
from terrafix_engines.features import open_describer, open_point_features
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_engines.providers import CPU
from terrafix_lab.bench.growth import map_size
from terrafix_lab.bench.result_file import write_result
from terrafix_lab.standalone import run_standalone

KM2 = 16.0  # more than 25 tiles at the height of the frames
COMPASS_SIGMA_RAD, UNKNOWN_RAD = np.radians(11.0), np.pi  # 1-sigma of the heading
# s [spec: SV-3, SV-4, RS-12 of the requirements; the sweep has 12 headings there, here all that the search draws]
LIMITS_S = {
    "sweep of all headings, one tile": 1.2,
    "25 tiles, heading by compass": 1.5,
    "joint match of 8 frames, heading by compass": 3.0,
    "start with four models": 30.0,
}


class SearchRig:
    """Frames of a straight flight over the middle of a map, and a search for them that begins there."""

    def __init__(self, local: LocalMap, heading_sigma_rad: float, around_m: tuple[float, float] | None) -> None:
        matcher = FrameMatcher(map_size.CAMERA, local, GradientDescriber())
        agl_m = map_size.AGL_M
        self._local, self._at_m = local, 0.0
        self._view = View(0.0, 0.0, map_size.DOWN, agl_m, 0.0, heading_sigma_rad, 0.02, 0.02)
        self.search = MapSearch(local, matcher, agl_m, around_m, DEFAULT_NULL, FalseAlarmBudget())

    def _frame(self) -> Image:
        return map_size.frame_at(self._local, self._at_m)

    def correlate(self, step: float) -> float:
        """A frame ``step`` heights further east. -> s of its joint correlation."""
        self._at_m += step * map_size.AGL_M
        self.search.predict(step * map_size.AGL_M, 0.0, 0.1)
        image = self._frame()
        return _seconds(lambda: self.search.correlate_region(image, self._view))


def searched(package: Path) -> dict[str, float]:
    """-> seconds of the second correlation of each kind: the first one reads the map."""
    opened = MapPackage.open(package)
    local = opened.bind(map_size.centre(opened))
    sweep = SearchRig(local, UNKNOWN_RAD, (0.0, 0.0))
    sweep.correlate(0.0)
    tiles = SearchRig(local, COMPASS_SIGMA_RAD, (0.0, 0.0))
    while tiles.search.tiles != REGION_BLOCKS[-1]:
        tiles.correlate(0.0 if tiles.search.tiles is None else 0.6)
    tiles.correlate(0.6)
    joint = SearchRig(local, COMPASS_SIGMA_RAD, None)
    for _ in range(MAX_MOSAIC_FRAMES):
        joint.correlate(0.15)
    found = (sweep.correlate(0.01), tiles.correlate(0.01), joint.correlate(0.15))
    opened.close()
    return dict(zip(LIMITS_S, found, strict=False))


def started(models: Path, work: Path) -> tuple[float, bool]:
    """-> seconds in which four models are opened, and whether all are unloaded when they are given up."""
    work.mkdir(parents=True, exist_ok=True)
    for path in models.glob("*.onnx"):
        (work / path.name).unlink(missing_ok=True)
        (work / path.name).symlink_to(path.resolve())
    export(work, False)
    opened: list[Any] = []

    def open_all() -> None:
        opened.append(open_describer("xfeat", str(work)))
        opened.extend(open_point_features("lighterglue-l3", str(work)))
        opened.append(open_correlator(str(work), (CPU,)))

    taken_s = _seconds(open_all)
    known = [weakref.ref(model) for model in opened]
    opened.clear()
    gc.collect()
    return taken_s, all(model() is None for model in known)


def _seconds(work: Callable[[], object]) -> float:
    began_s = time.process_time()
    work()
    return time.process_time() - began_s


def bench(
    out: Annotated[Path, typer.Argument(help="Folder for the generated map and the models.")],
    package: Annotated[Path | None, typer.Option("--map", help="Map package instead of the generated one.")] = None,
    models: Annotated[Path | None, typer.Option(help="Folder with the files of XFeat and LighterGlue.")] = None,
    json_path: Annotated[Path | None, typer.Option("--json", help="File for the numbers.")] = None,
) -> None:
    """Compare times of a search and of the start with models with the limits of the requirements."""
    out.mkdir(parents=True, exist_ok=True)
    path = package or out / "map.gpkg"
    if not path.is_file():
        map_size.measure(KM2, out)
    found, unloaded = searched(path), True
    if models is None:
        typer.echo("NOT MEASURED: start with four models; give --models FOLDER")
    else:
        found["start with four models"], unloaded = started(models, out / "models")
        typer.echo(f"models after the end: {'unloaded' if unloaded else 'STILL LOADED'}")
    for name, taken_s in found.items():
        holds = "holds" if taken_s <= LIMITS_S[name] else "BROKEN"
        typer.echo(f"{name:45}{taken_s:7.2f} s, at most {LIMITS_S[name]:4.1f} s  {holds}")
    write_result(json_path, {"seconds": found, "unloaded": unloaded})
    if not unloaded or any(taken_s > LIMITS_S[name] for name, taken_s in found.items()):
        raise typer.Exit(1)


if __name__ == "__main__":
    run_standalone("contract", bench)
