"""What a layer of roads, water and buildings finds, alone and beside imagery of several kinds, frame by frame.

python -m terrafix_tools.bench.search.drawn_map OUT [--seeds 3] [--places 40] [--agl 130 300]

Frames at random places of generated worlds in autumn, heading and height known to a few degrees and per cent. Each
frame is correlated with each map within 300 m, and its likelihoods are multiplied with an even prior, as in flight. The
vectors have the errors of ``sim/world/mapped_features.py``. There are no vectors of the real places of two dates."""

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import typer

from terrafix.anchor.matching.frame_matcher import CorrelationResult, FrameMatcher, View
from terrafix.anchor.matching.point_mass_filter import Belief, belief_cell_m
from terrafix.core.camera import CameraCalibration
from terrafix.core.geodesy import LocalFrame, local_rotation_up
from terrafix.map.package import LocalMap, MapPackage
from terrafix.messages import Verdict
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_tools.mapping.build import build_package, layer_of
from terrafix_tools.mapping.package.descriptor_kinds import Descriptors
from terrafix_tools.sim.camera.render import Film, Renderer
from terrafix_tools.sim.flights.folder import CAMERA
from terrafix_tools.sim.flights.scene import Scene, scene_of_place
from terrafix_tools.sim.world.map_content import MapContent
from terrafix_tools.sim.world.mapped import CAMERA_SEASON, write_map
from terrafix_tools.sim.world.place import World, generate, write_image

HALF_M = 300.0  # half of the side of the searched square
RIM_M = 450.0  # least distance of a place from the edge of the world
NEAR_PER_AGL = 0.1  # a mode as near as this to the truth is the right one: 13 m at 130 m
YAW_SIGMA_RAD, SCALE_SIGMA = math.radians(2.0), 0.02  # 1-sigma errors of heading and height
FIRST_SEED = 201
COARSE_M = 10.0  # pixels of free satellite imagery
CHANGED_BLOCK_M, CHANGED_SHARE = 250.0, 0.67  # ground that is another one on outdated imagery
DOWN = np.diag([1.0, -1.0, -1.0])
VECTORS = "vectors"


@dataclass(frozen=True)
class Square:
    """``SearchWindow`` of the matcher."""

    centre: tuple[float, float]
    half_m: float = HALF_M


def imageries(place: World) -> dict[str, np.ndarray]:
    """-> pictures of the place (H, W, 3) by kind, all on its own grid."""
    summer, elsewhere = place.render("summer"), generate(place.seed + 5000, gsd_m=place.gsd_m).render("summer")
    height, width = summer.shape[:2]
    factor = place.gsd_m / COARSE_M
    small = cv2.resize(summer, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    block = round(CHANGED_BLOCK_M / place.gsd_m)
    rng = np.random.default_rng(place.seed)
    blocks = rng.random((math.ceil(height / block), math.ceil(width / block))) < CHANGED_SHARE
    changed = np.kron(blocks, np.ones((block, block), bool))[:height, :width, None]
    return {
        "imagery of summer, 0.5 m": summer,
        "imagery of winter, 0.5 m": place.render("winter"),
        "imagery, 10 m": cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC),
        "imagery, two thirds of the ground changed": np.where(changed, elsewhere, summer),
    }


def maps_of(place: World, out: Path) -> dict[str, Path]:
    """-> map packages of the place by kind."""
    vectors = out / f"{place.seed}-vectors.gpkg"
    write_map(place, vectors, content=MapContent.VECTORS)
    packages = {VECTORS: vectors}
    for i, (name, picture) in enumerate(imageries(place).items()):
        tif = out / f"{place.seed}-{i}.tif"
        write_image(tif, place, picture)
        packages[name] = build_package([layer_of(tif)], tif.with_suffix(".gpkg"), descriptors=Descriptors.NONE)
    return packages


class Frames:
    """Random frames over one place."""

    def __init__(self, scene: Scene, seed: int, agl_m: float) -> None:
        self._scene, self._agl_m = scene, agl_m
        self._renderer = Renderer(scene.ground, CAMERA, film=Film(), seed=seed)
        self._rng = np.random.default_rng([seed, round(agl_m)])
        self._count = 0

    def next(self) -> tuple[np.ndarray, View]:
        """-> image, and the camera above its true place with errors of heading and height."""
        box, rng = self._scene.box.shrunk(RIM_M), self._rng
        e_m, n_m = rng.uniform(box.west_m, box.east_m), rng.uniform(box.south_m, box.north_m)
        yaw_rad, ground_m = rng.uniform(0.0, 2 * math.pi), self._scene.height()(e_m, n_m)
        p_m = np.array([e_m, n_m, ground_m + self._agl_m])
        image = self._renderer.frame(p_m, local_rotation_up(yaw_rad) @ DOWN, self._count)
        self._count += 1
        r_w_c = local_rotation_up(yaw_rad + rng.normal(0.0, YAW_SIGMA_RAD)) @ DOWN
        agl_m = self._agl_m * (1.0 + rng.normal(0.0, SCALE_SIGMA))
        return image, View(e_m, n_m, r_w_c, agl_m, ground_m, YAW_SIGMA_RAD, SCALE_SIGMA, 0.01)


def ranks(results: list[CorrelationResult], view: View, cell_m: float) -> int:
    """-> rank of the right place among the five heaviest modes of an even prior times the likelihoods; 0: none."""
    belief = Belief(view.e_m, view.n_m, HALF_M, cell_m, uniform_share=1.0)
    for result in results:
        if result.verdict is Verdict.ACCEPTED:
            belief.update(result.surfaces, 1.0)
    near_m = NEAR_PER_AGL * view.agl_m
    off_m = [math.hypot(mode.e_m - view.e_m, mode.n_m - view.n_m) for mode in belief.modes(5)]
    return next((i + 1 for i, one in enumerate(off_m) if one <= near_m), 0)


def measure(place: World, out: Path, agl_m: float, count: int) -> dict[str, list[int]]:
    """-> ranks of the right place by map."""
    scene = scene_of_place(place, CAMERA_SEASON)
    frames = Frames(scene, place.seed, agl_m)
    matchers, opened = {}, []
    for name, path in maps_of(place, out).items():
        package = MapPackage.open(path)
        opened.append(package)
        local: LocalMap = package.bind(LocalFrame(scene.frame.lat_deg, scene.frame.lon_deg))
        camera, drawn = CameraCalibration.of(CAMERA), package.layer().is_drawn
        matchers[name] = FrameMatcher(camera, local, GradientDescriber(), drawn=drawn)
    cell_m = belief_cell_m(agl_m, matchers[VECTORS].correlation_cell_m(agl_m))
    found: dict[str, list[int]] = {}
    for _ in range(count):
        image, view = frames.next()
        results = {name: one.correlate(image, view, Square((view.e_m, view.n_m))) for name, one in matchers.items()}
        for name, result in results.items():
            found.setdefault(name, []).append(ranks([result], view, cell_m))
            if name != VECTORS:
                both = ranks([result, results[VECTORS]], view, cell_m)
                found.setdefault(f"{name}, and vectors", []).append(both)
    for package in opened:
        package.close()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--places", type=int, default=40)
    parser.add_argument("--agl", type=float, nargs="+", default=[130.0, 300.0])
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    typer.echo(f"{'map':60} {'m':>4} places  best  among five")
    for agl_m in given.agl:
        found: dict[str, list[int]] = {}
        for seed in range(FIRST_SEED, FIRST_SEED + given.seeds):
            for name, one in measure(generate(seed), given.out, agl_m, given.places).items():
                found.setdefault(name, []).extend(one)
        for name, all_ranks in sorted(found.items()):
            rank = np.array(all_ranks)
            best, five = 100 * np.mean(rank == 1), 100 * np.mean(rank > 0)
            typer.echo(f"{name:60} {agl_m:4.0f} {len(rank):6} {best:4.0f} % {five:9.0f} %")


if __name__ == "__main__":
    main()
