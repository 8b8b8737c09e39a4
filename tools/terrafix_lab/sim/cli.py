"""`terrafix sim`: simulated flights. Each command imports its modules when it is called."""

from pathlib import Path
from typing import Annotated

import typer

from terrafix_lab.sim.autopilot.parameters import Gps, Kind
from terrafix_lab.sim.world.map_content import MapContent

# Options of both `make` and `fly`.
Seed = Annotated[int, typer.Option(help="Seed of the generated place, the course and all errors.")]
SizeKm = Annotated[float | None, typer.Option(help="Side of the generated place; default: 3 by 2 km.")]
Image = Annotated[Path | None, typer.Option(help="GeoTIFF that the camera sees; default: a generated place.")]
Map = Annotated[
    Path | None,
    typer.Option("--map", help="GeoTIFF or map package of the same place, of another date; default: --image."),
]
Dem = Annotated[Path | None, typer.Option(help="Elevation GeoTIFF under --image; default: flat at 0 m.")]
Vehicle = Annotated[Kind, typer.Option(help="Vehicle type.")]
MissionFile = Annotated[
    Path | None, typer.Option(help="QGroundControl .plan or waypoint file; default: a closed course.")
]
Agl = Annotated[float, typer.Option(help="Height of the closed course above ground, metres.")]
Duration = Annotated[float | None, typer.Option(help="Seconds; default: until the end of the mission.")]
Events = Annotated[Path | None, typer.Option(help="TOML with [[gnss]] tables: outage, jam, jump, drag.")]

app = typer.Typer(
    no_args_is_help=True, help="Simulated flights: generated or real ground, vehicle, sensors, autopilot."
)


@app.command()
def ardupilot(
    binary: Annotated[
        Path | None,
        typer.Option(help="arduplane or arducopter for SITL; default: TERRAFIX_ARDUPILOT_SITL."),
    ] = None,
    vehicle: Annotated[Kind | None, typer.Option(help="Default: by the binary's name.")] = None,
    out: Annotated[Path, typer.Option(help="Output folder.")] = Path("out/ardupilot"),
    length: Annotated[float, typer.Option(help="Kilometres to fly on GPS_INPUT alone.")] = 5.0,
    seed: Annotated[int, typer.Option(help="Seed of the generated world.")] = 1,
    port: Annotated[int, typer.Option(help="First of four UDP ports; 0: free ones.")] = 0,
    parameters: Annotated[
        list[Path] | None, typer.Option(help="Parameter file of the vehicle; default: second-gps.param.")
    ] = None,
    disturb: Annotated[
        list[str] | None,
        typer.Option(help="In flight, as often as given: kill (all of Terrafix), camera:SECONDS (no image), spoof."),
    ] = None,
    gnss_start: Annotated[
        bool,
        typer.Option("--gnss-start", help="No configured start: take the autopilot's GNSS position on the ground."),
    ] = False,
) -> None:
    """Fly a mission with ArduPilot SITL on Terrafix' GPS_INPUT, in real time."""
    from terrafix_lab.sim.sitl.fly import Disturbance
    from terrafix_lab.sim.sitl.fly import fly as fly_firmware

    code = fly_firmware(
        out,
        binary=binary,
        vehicle=vehicle,
        seed=seed,
        length_m=length * 1e3,
        port=port,
        parameters=parameters,
        disturbances=[Disturbance.parsed(text) for text in disturb or []],
        gnss_start=gnss_start,
    )
    raise typer.Exit(code)


@app.command()
def fly(
    out: Annotated[Path, typer.Option(help="Folder for all output of the flight.")] = Path("out/fly"),
    seed: Seed = 1,
    size_km: SizeKm = None,
    image: Image = None,
    map_path: Map = None,
    dem: Dem = None,
    vehicle: Vehicle = Kind.PLANE,
    gps: Annotated[
        Gps, typer.Option(help="Terrafix as second GPS of a real receiver, or as the only GPS.")
    ] = Gps.SECOND,
    mission: MissionFile = None,
    length_km: Annotated[float | None, typer.Option(help="Length of the closed course; default 10.")] = None,
    agl: Agl = 130.0,
    duration: Duration = None,
    frame_hz: Annotated[float, typer.Option(help="Frames a second.")] = 1.5,
    jam_after: Annotated[
        float | None, typer.Option(help="Seconds until GNSS is jammed; default 60 without --spoof-after or --events.")
    ] = None,
    spoof_after: Annotated[float | None, typer.Option(help="Seconds until a spoofer drags GNSS off.")] = None,
    spoof_mps: Annotated[float, typer.Option(help="Speed of the spoofing drag to the east, m/s.")] = 2.0,
    events: Events = None,
) -> None:
    """Fly in closed loop: the vehicle steers by the autopilot's position, which depends on GPS_INPUT."""
    from terrafix_lab.sim.closed_loop.command import Request, run
    from terrafix_lab.sim.flights.make import FlightOptions

    wanted = FlightOptions(
        seed=seed,
        size_km=size_km,
        image=image,
        map_path=map_path,
        dem=dem,
        vehicle=vehicle,
        mission=mission,
        length_km=length_km,
        duration_s=duration,
        agl_m=agl,
        events=events,
        jam_after_s=jam_after,
    )
    raise typer.Exit(run(Request(wanted, gps, frame_hz, spoof_after, spoof_mps), out))


@app.command()
def make(
    out: Annotated[Path, typer.Option(help="Flight folder to write; new or empty.")],
    seed: Seed = 1,
    size_km: SizeKm = None,
    image: Image = None,
    map_path: Map = None,
    dem: Dem = None,
    vehicle: Vehicle = Kind.PLANE,
    mission: MissionFile = None,
    length_km: Annotated[float | None, typer.Option(help="Length of the closed course.")] = None,
    from_ground: Annotated[
        bool, typer.Option("--from-ground", help="Closed course with take-off and landing.")
    ] = False,
    duration: Duration = None,
    agl: Agl = 130.0,
    events: Events = None,
    jam_after: Annotated[float | None, typer.Option(help="GNSS is jammed from this second on.")] = None,
    map_content: Annotated[
        MapContent, typer.Option(help="Map of a generated place: imagery, roads and buildings as vectors, or both.")
    ] = MapContent.IMAGERY,
    camera: Annotated[
        Path | None, typer.Option(help="Camera description (any lens, any mount); default: 960x540, 81 degrees wide.")
    ] = None,
    quiet: Annotated[bool, typer.Option(help="No progress bar.")] = False,
) -> None:
    """Write a flight folder of a simulated vehicle: images, telemetry.tlog, truth.csv and the map."""
    from terrafix.vision.sources.description import camera_of, read_description
    from terrafix_lab.sim.flights import make as making
    from terrafix_lab.sim.flights.folder import CAMERA

    wanted = making.FlightOptions(
        seed=seed,
        size_km=size_km,
        image=image,
        map_path=map_path,
        map_content=map_content,
        dem=dem,
        vehicle=vehicle,
        mission=mission,
        length_km=length_km,
        from_ground=from_ground,
        duration_s=duration,
        agl_m=agl,
        events=events,
        jam_after_s=jam_after,
        camera=CAMERA if camera is None else camera_of(camera, read_description(camera)),
    )
    flight = making.make(out, wanted, progress=not quiet)
    length_m = flight.path.length_m(flight.duration_s)
    typer.echo(f"{out}: {len(flight.frame_times_s())} frames, {flight.duration_s:.0f} s, {length_m / 1e3:.1f} km")


@app.command()
def telemetry(
    flight: Annotated[Path, typer.Argument(help="Flight folder with frames.csv and truth.csv.")],
    out: Annotated[Path, typer.Option(help="Flight folder to write; new or empty.")],
    seed: Annotated[int, typer.Option(help="Seed of the sensor errors.")] = 1,
) -> None:
    """Add to real frames the telemetry.tlog of a simulated autopilot with IMU, computed from their ground truth."""
    from terrafix_lab.sim.flights.recorded import write_recorded

    path = write_recorded(flight, out, seed=seed)
    typer.echo(f"{out}: telemetry.tlog along a smooth path, {path.level.rms:.1f} m rms from the truth")
