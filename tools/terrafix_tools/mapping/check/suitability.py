"""`terrafix map check`: suitability of a map for a camera, a height and a mission."""

import datetime
import math
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from terrafix.anchor.matching.frame_matcher import MIN_SIDE_CELLS, FrameMatcher
from terrafix.anchor.relocalization.coarse_descriptors import has_stored_scale
from terrafix.anchor.relocalization.map_search import POOLED_CELL_PER_AGL
from terrafix.core.camera import CameraCalibration
from terrafix.core.config import Map
from terrafix.core.errors import UsageError
from terrafix.core.geodesy import LocalFrame
from terrafix.core.limits import MIN_MATCHING_AGL_M
from terrafix.map.format import Ce90Origin, Layer, accuracy_of
from terrafix.map.package import LocalMap, MapPackage
from terrafix.vision.sources.description import camera_of, read_description
from terrafix.vision.sources.fisheye import view_of
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_engines.retrieval.pooled import PooledGradientDescriber
from terrafix_tools.mapping.check.mission import (
    MissionRoute,
    Stretch,
    blind,
    height_of,
    mission_route,
    sight_along,
    uncovered,
)
from terrafix_tools.mapping.check.sight import MatchabilityProbe, Sight, SightGrid, sight_grid
from terrafix_tools.mission.file import read_mission
from terrafix_tools.mission.items import Mission
from terrafix_tools.progress import progress_bar

DEFAULT_AGL_M = 100.0
DEFAULT_CAMERA = CameraCalibration(1280, 720, 914.0, 914.0, 640.0, 360.0)  # a common lens, 70 degrees wide
MAX_GRID_CELLS = 300  # of the check grid: about half a minute
OLD_YEARS = 5.0
SAME_GROUND_YEARS = 0.05  # age of imagery within which crops and leaves look the same
MATCH_CELLS = 1.0  # expected error of a match in cells: 1.0 m at cells of 1 m over the generated world of the demo
MEDIAN_SIGMAS = 1.1774  # median of a circular normal error in its sigmas: sqrt(2 ln 2)
DESCRIBE_S_PER_PX, SEARCH_WARNING_S = 2e-7, 2.0  # 100 km2 at 2 m/px: 5 s of one core
FRAME_WARNING_CELLS = 48  # of the frame's shorter side, for a warning; the matcher rejects below MIN_SIDE_CELLS


class MissionCheck(msgspec.Struct, frozen=True, kw_only=True):
    file: str
    length_m: float
    outside: list[Stretch]  # outside of the map, longest first
    blind: list[Stretch]  # without expected fixes: not matchable, or less than a frame from the map's edge
    seen_share: float  # fraction of the path: sees or weak


class MapCheck(msgspec.Struct, frozen=True, kw_only=True):
    """Output of `terrafix map check --json`. Fractions are of the ground where a whole frame lies on the map."""

    package: str
    layer: str
    date: str
    age_years: float | None  # None: the package has no date
    licence: str
    signed_by: tuple[str, ...]
    map_gsd_m: float
    frame_gsd_m: float
    cell_m: float  # of the matcher
    agl_m: float
    camera: str
    frame_cells: int  # the frame's shorter side
    has_elevation: bool
    alone: float  # expected share of frames that are placed alone, of imagery of this age
    sees: float
    weak: float
    blind: float
    cell_step_m: float
    expected_error_m: float  # horizontal median where the ground is matchable
    ce90_m: float
    ce90_origin: Ce90Origin
    inputs: list[str]  # unit, datum and accuracy of each input of the package, and what was assumed about it
    warnings: list[str]
    mission: MissionCheck | None


@dataclass(frozen=True)
class CheckResult:
    """The check result and the data for the page."""

    report: MapCheck
    grid: SightGrid
    local: LocalMap
    route: MissionRoute | None


def check(
    package: MapPackage,
    *,
    mission: Path | None = None,
    camera: Path | None = None,
    agl_m: float | None = None,
    layer: str | None = None,
    progress: bool = False,
) -> CheckResult:
    """Checks the whole map and the mission. Raises MapError, SourceError (mission or camera), UsageError."""
    found = package.layer(layer)
    lens, lens_name = _camera(camera)
    plan = read_mission(mission, course_only=True) if mission else None
    agl_m = _flight_height_m(agl_m, plan)
    west, south, east, north = package.manifest.bounds_wgs84
    frame = LocalFrame((south + north) / 2, (west + east) / 2)
    local = package.bind(frame, layer)
    matcher = FrameMatcher(lens, local, GradientDescriber())
    cell_m = matcher.correlation_cell_m(agl_m)
    frame_m = lens.width * agl_m / lens.fx, lens.height * agl_m / lens.fy
    probe = MatchabilityProbe(local, found, lens, agl_m)
    e_min, n_min, e_max, n_max = local.bounds_m
    step_m = max(math.sqrt(frame_m[0] * frame_m[1]) / 2, math.sqrt((e_max - e_min) * (n_max - n_min) / MAX_GRID_CELLS))
    with progress_bar(progress) as bar:
        grid = sight_grid(local, probe, step_m, bar)
    route = mission_route(plan, frame) if plan else None
    route_sight = sight_along(route, probe) if route else None
    mission_check = None
    if route is not None and route_sight is not None:
        mission_check = _mission_check(route, route_sight, str(mission), uncovered(route, package, found.table))
    accuracy, age_years = accuracy_of(found, Map().ce90_m), _age_years(found.date)
    sees, weak = grid.share(Sight.SEES), grid.share(Sight.WEAK)
    report = MapCheck(
        package=str(package.path),
        layer=found.table,
        date=found.date,
        age_years=age_years,
        licence=found.licence,
        signed_by=package.signed_by,
        map_gsd_m=found.gsd_m,
        frame_gsd_m=agl_m / lens.fx,
        cell_m=cell_m,
        agl_m=agl_m,
        camera=lens_name,
        frame_cells=int(min(frame_m) / cell_m),
        has_elevation=package.manifest.has_dem,
        alone=sees + weak if age_years is not None and age_years <= SAME_GROUND_YEARS else sees,
        sees=sees,
        weak=weak,
        blind=grid.share(Sight.BLIND),
        cell_step_m=step_m,
        expected_error_m=MEDIAN_SIGMAS * math.hypot(accuracy.sigma_m, MATCH_CELLS * cell_m / MEDIAN_SIGMAS),
        ce90_m=accuracy.ce90_m,
        ce90_origin=accuracy.origin,
        inputs=[statement.text() for statement in package.manifest.inputs],
        warnings=[
            *_warnings(found, int(min(frame_m) / cell_m), package.manifest.has_dem, cell_m, agl_m),
            *_search_warnings(local, matcher, agl_m),
            *([f"{plan.name}: {note}" for note in plan.notes] if plan else []),
        ],
        mission=mission_check,
    )
    return CheckResult(report, grid, local, route)


def _flight_height_m(agl_m: float | None, plan: Mission | None) -> float:
    """The given height above ground, else that of the mission, else the default. Raises UsageError: too low."""
    if agl_m is None:
        agl_m = (plan and height_of(plan)) or DEFAULT_AGL_M
    if agl_m < MIN_MATCHING_AGL_M:
        raise UsageError(
            f"{agl_m:.0f} m above ground: no fix is tried below {MIN_MATCHING_AGL_M:.0f} m; give another --agl"
        )
    return agl_m


def _mission_check(route: MissionRoute, route_sight: np.ndarray, file: str, outside: np.ndarray) -> MissionCheck:
    """``way_sight`` (N,) uint8 of Sight, ``outside`` (N,) bool: at the points of the path."""
    return MissionCheck(
        file=file,
        length_m=float(route.along_m[-1]),
        outside=route.stretches(outside),
        blind=route.stretches(blind(route_sight)),
        seen_share=float(np.mean(~blind(route_sight))),
    )


def _camera(path: Path | None) -> tuple[CameraCalibration, str]:
    if path is None:
        return DEFAULT_CAMERA, "1280 x 720 px, 70 degrees wide (assumed; give --camera)"
    read = read_description(path)
    return CameraCalibration.of(view_of(camera_of(path, read))), read.name or path.name


def _age_years(date: str) -> float | None:
    try:
        return (datetime.date.today() - datetime.date.fromisoformat(date)).days / 365.25
    except ValueError:  # empty
        return None


def _warnings(layer: Layer, frame_cells: int, has_elevation: bool, cell_m: float, agl_m: float) -> list[str]:
    warnings = []
    age_years = _age_years(layer.date)
    if layer.is_drawn:
        warnings.append(
            "roads, water and buildings instead of imagery: a fix is a position alone, and 'sees' is of the drawing; "
            "a frame also shows what no map has"
        )
    elif age_years is None:
        warnings.append("the package does not say when the imagery was taken; build it with --date")
    elif age_years > OLD_YEARS:
        warnings.append(f"the imagery is {age_years:.0f} years old; new buildings and other crops make fixes fewer")
    if frame_cells < MIN_SIDE_CELLS:
        warnings.append(
            f"no fix will come: at {agl_m:.0f} m a frame spans {frame_cells} cells of {cell_m:.2f} m, and the matcher "
            f"needs {MIN_SIDE_CELLS}; take a finer map, or fly higher"
        )
    elif frame_cells < FRAME_WARNING_CELLS:
        warnings.append(
            f"a frame spans only {frame_cells} cells of {cell_m:.2f} m; a finer map or more height would be better"
        )
    if not has_elevation:
        warnings.append("no elevation: the ground is taken for flat; over hills build the package with --dem")
    if layer.ce90_origin is Ce90Origin.DATUM:
        warnings.append(
            f"the map's own accuracy is not stated; {layer.ce90_m:g} m (CE90) is that of its datum's way to WGS 84"
        )
    if layer.ce90_m is None:
        warnings.append(f"the map's own accuracy is not stated; {Map().ce90_m:.0f} m (CE90) is assumed")
    return warnings


def _search_warnings(local: LocalMap, matcher: FrameMatcher, agl_m: float) -> list[str]:
    """Warnings about the computation that a search of the whole map needs in flight."""
    wanted_m = matcher.cell_m(agl_m, POOLED_CELL_PER_AGL / PooledGradientDescriber.stride)
    if has_stored_scale(local, PooledGradientDescriber.name, wanted_m):
        return []
    e_min, n_min, e_max, n_max = local.bounds_m
    extra_s = (e_max - e_min) * (n_max - n_min) / wanted_m**2 * DESCRIBE_S_PER_PX
    if extra_s < SEARCH_WARNING_S:
        return []
    return [
        f"no descriptors for a search at {agl_m:.0f} m: the first look of a vehicle that is lost takes about "
        f"{extra_s:.0f} s longer; build the map with --descriptors weights-free"
    ]
