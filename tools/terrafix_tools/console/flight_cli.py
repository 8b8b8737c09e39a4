"""The commands `terrafix flight ...`."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from terrafix.core.errors import UsageError

if TYPE_CHECKING:
    from terrafix_tools.console.client import ConsoleClient

app = typer.Typer(no_args_is_help=True, help="Flights of a console ('terrafix serve'), also on another computer.")

FlightId = Annotated[str, typer.Argument(help="Id of the flight.")]
UrlOption = Annotated[str, typer.Option("--url", envvar="TERRAFIX_CONSOLE", help="Address of the console.")]
URL = "http://127.0.0.1:8700"
TOKEN = "TERRAFIX_TOKEN"  # environment variable: arguments are visible to others
FrameOption = Annotated[int, typer.Option(help="Number of the frame.")]
PixelOption = Annotated[str, typer.Option(help="U,V in the uploaded image: to the right and down, from 0.")]


def client_of(url: str) -> "ConsoleClient":
    from terrafix_tools.console.client import ConsoleClient

    return ConsoleClient(url, os.environ.get(TOKEN, ""))


@app.command("list")
def list_flights(url: UrlOption = URL) -> None:
    """All flights: id, state, images, name."""
    for flight in client_of(url).flights():
        images = f"{flight.images.processed}/{flight.images.uploaded}"
        typer.echo(f"{flight.flight_id}  {flight.state.value:<10}  {images:>11}  {flight.name}")


@app.command()
def create(
    description: Annotated[Path, typer.Argument(help="flight.toml with camera, mount, start, telemetry.")],
    map_name: Annotated[str, typer.Option("--map", help="Name of a map of the console.")] = "",
    mission: Annotated[
        Path | None, typer.Option(help="QGroundControl .plan or ArduPilot .waypoints, whose corridor is fetched.")
    ] = None,
    corridor: Annotated[float, typer.Option(help="Metres to either side of the mission.")] = 1000.0,
    height: Annotated[float | None, typer.Option(help="Metres above ground, for images that state none.")] = None,
    name: Annotated[str, typer.Option(help="Name of the flight.")] = "",
    url: UrlOption = URL,
) -> None:
    """Create a flight and print its id."""
    from terrafix_tools.console.new_flight import new_flight

    new = new_flight(description, map_name, mission, corridor, height, name)
    typer.echo(client_of(url).create(new).flight_id)


@app.command()
def upload(
    flight_id: FlightId,
    folder: Annotated[Path, typer.Argument(help="Folder of images, in the order of their names.")],
    telemetry: Annotated[Path | None, typer.Option(help="frames.csv with a row for each image.")] = None,
    url: UrlOption = URL,
) -> None:
    """Upload the images of a folder, in batches."""
    from terrafix_tools.console.new_flight import images_of, telemetry_of

    client = client_of(url)
    images = images_of(folder)
    rows = None if telemetry is None else telemetry_of(telemetry, images)
    done = 0
    for accepted in client.upload(flight_id, images, rows):
        done += len(accepted.frames)
        typer.echo(f"{done} of {len(images)} images{' (were there already)' if accepted.repeated else ''}", err=True)


@app.command()
def watch(
    flight_id: FlightId,
    after: Annotated[int, typer.Option(help="Id of the last event that is known.")] = 0,
    url: UrlOption = URL,
) -> None:
    """Print the events of a flight, one a line: id, name, JSON. Ends when the flight is completed."""
    import contextlib
    import json

    with contextlib.suppress(KeyboardInterrupt):
        for event in client_of(url).events(flight_id, after):
            typer.echo(f"{event.event_id} {event.name} {json.dumps(event.data)}")


@app.command()
def fix(
    flight_id: FlightId,
    frame: FrameOption,
    pixel: PixelOption,
    at: Annotated[str, typer.Option(help="LAT,LON in degrees of what the pixel shows.")],
    url: UrlOption = URL,
) -> None:
    """Say where lies what a pixel shows; used as a prior, the map decides."""
    from terrafix_tools.console.payloads import PixelPoint, UserFix

    (u, v), (lat, lon) = _pair("--pixel", pixel), _pair("--at", at)
    given = UserFix(frame_id=frame, pixel=PixelPoint(u=u, v=v), lat=lat, lon=lon)
    typer.echo(client_of(url).user_fix(flight_id, given).detail)


@app.command()
def hint(
    flight_id: FlightId,
    at: Annotated[str, typer.Option(help="LAT,LON in degrees.")],
    radius: Annotated[float, typer.Option(help="Radius in metres that contains the vehicle.")] = 5000.0,
    url: UrlOption = URL,
) -> None:
    """Give an approximate position; used as a prior, the map decides."""
    from terrafix_tools.console.payloads import Hint

    lat, lon = _pair("--at", at)
    typer.echo(client_of(url).hint(flight_id, Hint(lat=lat, lon=lon, radius_m=radius)).detail)


@app.command()
def locate(flight_id: FlightId, frame: FrameOption, pixel: PixelOption, url: UrlOption = URL) -> None:
    """The position of what a pixel shows, with its accuracy."""
    from terrafix_tools.console.payloads import ObjectPixel

    u, v = _pair("--pixel", pixel)
    found = client_of(url).locate(flight_id, frame, ObjectPixel(pixel_x=u, pixel_y=v))
    typer.echo(
        f"{found.gps.lat:.7f}, {found.gps.lon:.7f} within {found.accuracy_meters:.1f} m (95 %), by {found.surface}"
    )


@app.command()
def complete(flight_id: FlightId, url: UrlOption = URL) -> None:
    """No more images follow: refine the flight as a whole. Returns at once; `watch` shows the end."""
    typer.echo(f"{client_of(url).complete(flight_id).images.uploaded} images")


def _pair(option: str, text: str) -> tuple[float, float]:
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"{option} {text}: not two numbers separated by a comma") from None
    return first, second
