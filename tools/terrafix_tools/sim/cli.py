"""`terrafix sim`: the world to fly in. Every command imports what it needs when it is called."""

from pathlib import Path
from typing import Annotated

import typer

from terrafix.core.errors import UsageError
from terrafix_tools.sim.autopilot.parameters import Gps, Kind

# What `make` and `fly` have in common.
Seed = Annotated[int, typer.Option(help="Of the generated place, of the course and of all errors.")]
SizeKm = Annotated[float | None, typer.Option(help="Side of the generated place; default: 3 by 2 km.")]
Image = Annotated[Path | None, typer.Option(help="GeoTIFF that the camera sees; default: a generated place.")]
Map = Annotated[
    Path | None,
    typer.Option("--map", help="GeoTIFF or map package of the same place, of another date; default: --image."),
]
Dem = Annotated[Path | None, typer.Option(help="Elevation GeoTIFF under --image; default: flat at 0 m.")]
Vehicle = Annotated[Kind, typer.Option(help="Who flies.")]
MissionFile = Annotated[
    Path | None, typer.Option(help="QGroundControl .plan or waypoint file; default: a closed course.")
]
Agl = Annotated[float, typer.Option(help="Height of that course above ground, metres.")]
Duration = Annotated[float | None, typer.Option(help="Seconds; default: until the mission is flown.")]
Events = Annotated[Path | None, typer.Option(help="TOML with [[gnss]] tables: outage, jam, jump, drag.")]

app = typer.Typer(
    no_args_is_help=True, help="Simulated flights: generated or real ground, vehicle, sensors, autopilot."
)


@app.command()
def ardupilot(
    binary: Annotated[
        Path | None,
        typer.Option(help="arduplane or arducopter for SITL; default: what TERRAFIX_ARDUPILOT_SITL names."),
    ] = None,
    vehicle: Annotated[Kind | None, typer.Option(help="Default: by the binary's name.")] = None,
    out: Annotated[Path, typer.Option(help="Output folder.")] = Path("out/ardupilot"),
    length: Annotated[float, typer.Option(help="Kilometres to fly on GPS_INPUT alone.")] = 5.0,
    seed: Annotated[int, typer.Option(help="Seed of the generated world.")] = 1,
    port: Annotated[int, typer.Option(help="First of four UDP ports; 0: free ones.")] = 0,
    parameters: Annotated[
        list[Path] | None, typer.Option(help="Parameter file of the vehicle; default: second-gps.param.")
    ] = None,
    kills: Annotated[int, typer.Option(min=0, help="Kill Terrafix so often without GNSS, and start it again.")] = 0,
    gnss_start: Annotated[
        bool, typer.Option("--gnss-start", help="Nobody says where it begins but the autopilot's GNSS, on the ground.")
    ] = False,
) -> None:
    """ArduPilot's own firmware flies a mission on Terrafix' GPS_INPUT, in real time."""
    try:
        from terrafix_tools.sim.sitl.fly import fly as fly_firmware
    except ModuleNotFoundError as error:
        if error.name != "mavsdk":
            raise
        raise UsageError("this command needs mavsdk; install it: pip install 'terrafix[sim]'") from None

    code = fly_firmware(
        out,
        binary=binary,
        vehicle=vehicle,
        seed=seed,
        length_m=length * 1e3,
        port=port,
        parameters=parameters,
        kills=kills,
        gnss_start=gnss_start,
    )
    raise typer.Exit(code)


@app.command()
def fly(
    out: Annotated[Path, typer.Option(help="Folder for everything that the flight makes.")] = Path("out/fly"),
    seed: Seed = 1,
    size_km: SizeKm = None,
    image: Image = None,
    map_path: Map = None,
    dem: Dem = None,
    vehicle: Vehicle = Kind.PLANE,
    gps: Annotated[Gps, typer.Option(help="Terrafix beside a real receiver, or as the only GPS.")] = Gps.SECOND,
    mission: MissionFile = None,
    length_km: Annotated[float | None, typer.Option(help="Length of that course; default 10.")] = None,
    agl: Agl = 130.0,
    duration: Duration = None,
    frame_hz: Annotated[float, typer.Option(help="Frames a second.")] = 1.5,
    jam_after: Annotated[
        float | None, typer.Option(help="Seconds until GNSS is jammed; default 60 without --spoof-after or --events.")
    ] = None,
    spoof_after: Annotated[float | None, typer.Option(help="Seconds until a spoofer drags GNSS off.")] = None,
    spoof_mps: Annotated[float, typer.Option(help="... so fast, to the east.")] = 2.0,
    events: Events = None,
) -> None:
    """Fly in closed loop: the vehicle steers by what the autopilot believes, the autopilot by GPS_INPUT."""
    from terrafix_tools.sim.closed_loop.command import Request, run
    from terrafix_tools.sim.flights.make import Wanted

    wanted = Wanted(
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
    length_km: Annotated[float | None, typer.Option(help="Length of that course.")] = None,
    from_ground: Annotated[bool, typer.Option("--from-ground", help="That course has take-off and landing.")] = False,
    duration: Duration = None,
    agl: Agl = 130.0,
    events: Events = None,
    jam_after: Annotated[float | None, typer.Option(help="GNSS is jammed from this second on.")] = None,
    quiet: Annotated[bool, typer.Option(help="No progress bar.")] = False,
) -> None:
    """Make a flight folder: pictures, telemetry.tlog, truth.csv and the map, of a simulated vehicle."""
    from terrafix_tools.sim.flights import make as making

    wanted = making.Wanted(
        seed=seed,
        size_km=size_km,
        image=image,
        map_path=map_path,
        dem=dem,
        vehicle=vehicle,
        mission=mission,
        length_km=length_km,
        from_ground=from_ground,
        duration_s=duration,
        agl_m=agl,
        events=events,
        jam_after_s=jam_after,
    )
    flight = making.make(out, wanted, progress=not quiet)
    length_m = flight.path.length_m(flight.duration_s)
    typer.echo(f"{out}: {len(flight.frame_times_s())} frames, {flight.duration_s:.0f} s, {length_m / 1e3:.1f} km")


@app.command()
def telemetry(
    flight: Annotated[Path, typer.Argument(help="Flight folder with frames.csv and truth.csv.")],
    out: Annotated[Path, typer.Option(help="Flight folder to write; new or empty.")],
    seed: Annotated[int, typer.Option(help="Decides about the errors of the sensors.")] = 1,
) -> None:
    """Give real frames the telemetry.tlog that an autopilot would have kept, with IMU, from their truth."""
    from terrafix_tools.sim.flights.recorded import write_recorded

    way = write_recorded(flight, out, seed=seed)
    typer.echo(f"{out}: telemetry.tlog along a smooth way, {way.level.off:.1f} m off the truth in the mean (rms)")
