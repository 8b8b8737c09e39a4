"""`terrafix sim make`: a flight folder over generated or real ground, with its map."""

import math
import shutil
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn

from terrafix.core.errors import OutputError, UsageError
from terrafix.map.package import MapPackage
from terrafix.messages import Camera
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.flights.folder import (
    AGL_M,
    CAMERA,
    MAX_DURATION_S,
    Flight,
    flight_over,
    mission_over,
    write_flight,
)
from terrafix_lab.sim.flights.scene import Scene, scene_of_image, scene_of_place
from terrafix_lab.sim.sensors.gnss_events import AnyEvent, Jam, read_events
from terrafix_lab.sim.world import mapped
from terrafix_lab.sim.world import place as world
from terrafix_lab.sim.world.map_content import MapContent
from terrafix_tools.mapping.build import build
from terrafix_tools.mission.file import read_mission, write_mission
from terrafix_tools.progress import LineProgress, waiting

AGL_LIMITS_M = (30.0, 1500.0)
MAP_NAME = "map.gpkg"


@dataclass(frozen=True)
class FlightOptions:
    """Options of the command line; None and 0 where not given."""

    seed: int = 1
    size_km: float | None = None  # side of a generated place
    image: Path | None = None  # image that the camera sees; None: a generated place
    map_path: Path | None = None
    map_content: MapContent = MapContent.IMAGERY  # of a generated place
    dem: Path | None = None
    vehicle: Kind = Kind.PLANE
    mission: Path | None = None
    length_km: float | None = None
    from_ground: bool = False
    duration_s: float | None = None
    agl_m: float = AGL_M
    events: Path | None = None
    jam_after_s: float | None = None
    camera: Camera = CAMERA


def make(out: Path, wanted: FlightOptions, *, progress: bool = True) -> Flight:
    """Writes the folder ``out``, which must be new or empty. Raises subclasses of TerrafixError."""
    check_options(wanted)
    events = gnss_events(wanted)
    mission = None if wanted.mission is None else read_mission(wanted.mission)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise OutputError(f"{out}: exists and is not an empty folder; choose another --out")
    console = Console(stderr=True, quiet=not progress)
    with waiting(console, "generating the ground"):
        scene, place = scene_of(wanted)
    if mission is None:
        length_m = 1e3 * wanted.length_km if wanted.length_km is not None else 30.0 * (wanted.duration_s or 200.0)
        mission = mission_over(
            scene,
            wanted.vehicle,
            seed=wanted.seed,
            length_m=length_m,
            agl_m=wanted.agl_m,
            from_ground=wanted.from_ground,
        )
    with waiting(console, "simulating the flight"):
        flight = flight_over(
            scene,
            wanted.vehicle,
            seed=wanted.seed,
            mission=mission,
            duration_s=wanted.duration_s,
            events=events,
            camera=wanted.camera,
        )
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); choose another --out") from None
    with waiting(console, "writing the map"):
        write_map(out / MAP_NAME, wanted, place)
    write_mission(out / "mission.waypoints", mission)
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed:.0f}/{task.total:.0f}"))
    with LineProgress(*columns, TimeElapsedColumn(), console=console, transient=True) as bar:
        task = bar.add_task("the camera", total=len(flight.frame_times_s()))
        write_flight(out, flight, MAP_NAME, seed=wanted.seed, progress=lambda done, _: bar.update(task, completed=done))
    return flight


def scene_of(wanted: FlightOptions) -> tuple[Scene, world.World | None]:
    """Returns the scene of the camera, and the place if it is a generated one. Raises MapError, UsageError."""
    if wanted.image is not None:
        return scene_of_image(wanted.image, wanted.dem), None
    size = {} if wanted.size_km is None else {"width_m": 1e3 * wanted.size_km, "height_m": 1e3 * wanted.size_km}
    place = world.generate(wanted.seed, **size)
    return scene_of_place(place, mapped.CAMERA_SEASON), place


def write_map(package: Path, wanted: FlightOptions, place: world.World | None) -> None:
    """Writes the map package of another date or season; a given package as it is. Raises MapError, OutputError."""
    if place is None:
        source = wanted.map_path or wanted.image
        assert source is not None  # without a place there is an image
        if source.suffix.lower() != ".gpkg":
            build(source, package, dem=wanted.dem)
            return
        MapPackage.open(source).close()
        try:
            shutil.copyfile(source, package)
        except OSError as error:
            raise OutputError(f"{package}: cannot be written ({error.strerror}); choose another --out") from None
        return
    mapped.write_map(place, package, content=wanted.map_content)


def gnss_events(wanted: FlightOptions) -> tuple[AnyEvent, ...]:
    """Returns the events of the file, and the jammer of --jam-after. Raises SourceError."""
    events = () if wanted.events is None else read_events(wanted.events)
    return events if wanted.jam_after_s is None else (*events, Jam(start_s=wanted.jam_after_s))


def check_options(wanted: FlightOptions) -> None:
    """Raises UsageError for invalid options."""
    if wanted.image is None and (wanted.map_path or wanted.dem):
        raise UsageError("--map and --dem belong to --image; a generated place has its own")
    if wanted.image is not None and wanted.map_content is not MapContent.IMAGERY:
        raise UsageError("--map-content: only the features of a generated place are known; omit it with --image")
    if wanted.image is not None and wanted.size_km is not None:
        raise UsageError("--size-km applies to a generated place; omit it with --image")
    if wanted.mission is not None and (wanted.length_km is not None or wanted.from_ground):
        raise UsageError("--mission defines length and start; omit --length-km and --from-ground")
    if wanted.length_km is not None and not 0.0 < wanted.length_km < math.inf:
        raise UsageError(f"--length-km {wanted.length_km:g}: choose a positive length")
    if wanted.duration_s is not None and not 0.0 < wanted.duration_s <= MAX_DURATION_S:
        raise UsageError(f"--duration {wanted.duration_s:g}: choose more than 0 and at most {MAX_DURATION_S:g} seconds")
    if not AGL_LIMITS_M[0] <= wanted.agl_m <= AGL_LIMITS_M[1]:
        raise UsageError(f"--agl {wanted.agl_m:g}: choose {AGL_LIMITS_M[0]:g} to {AGL_LIMITS_M[1]:g} metres")
    if wanted.jam_after_s is not None and not wanted.jam_after_s >= 0.0:
        raise UsageError(f"--jam-after {wanted.jam_after_s:g}: seconds from the start of the flight cannot be negative")
