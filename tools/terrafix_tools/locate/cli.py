"""The command `terrafix locate`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from terrafix.core.errors import UsageError

if TYPE_CHECKING:
    from terrafix_tools.locate.locator import FlightLocator
    from terrafix_tools.locate.position import ObjectPosition

INCONSISTENT = 1  # exit code
Sightings = list[tuple[str, tuple[float, float]]]


def locate(
    record: Annotated[Path, typer.Argument(help="Record, or folder of replay or run.")],
    frame: Annotated[list[str], typer.Option(help="Number or file of a frame; several times: one object.")],
    pixel: Annotated[list[str], typer.Option(help="U,V in that frame: to the right and down, from 0.")],
    map_path: Annotated[Path | None, typer.Option("--map", help="Map package; default: the flight's.")] = None,
    json_only: Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")] = False,
) -> None:
    """The position of what a pixel shows, with its accuracy. Exit code 1: the frames show different objects."""
    from terrafix_tools.locate.locator import FlightLocator

    sightings = paired(frame, pixel)
    locator = FlightLocator.open(record, map_path)
    found = locator.locate(sightings)
    if json_only:
        typer.echo(json.dumps(as_json(found, locator, sightings), indent=2))
    else:
        for line in text(found, locator, sightings):
            typer.echo(line)
    if not found.consistent:
        raise typer.Exit(INCONSISTENT)


def paired(frames: list[str], pixels: list[str]) -> Sightings:
    """Raises UsageError: numbers of frames and pixels differ, or a pixel is not two numbers."""
    if len(frames) != len(pixels):
        raise UsageError(f"{len(frames)} --frame and {len(pixels)} --pixel; give one --pixel U,V for each --frame")
    return [(frame, _pixel(pixel)) for frame, pixel in zip(frames, pixels, strict=True)]


def as_json(found: "ObjectPosition", locator: "FlightLocator", sightings: Sightings) -> dict[str, Any]:
    lat_deg, lon_deg = locator.flight.frame.to_wgs84(float(found.p_m[0]), float(found.p_m[1]))
    sigma_e_m, sigma_n_m, sigma_u_m = (round(float(v) ** 0.5, 3) for v in found.cov.diagonal())
    return {
        "lat_deg": round(lat_deg, 8),
        "lon_deg": round(lon_deg, 8),
        "alt_amsl_m": round(float(found.p_m[2]), 3) if locator.amsl_known else None,
        "radius95_m": round(found.radius95_m, 3),
        "sigma_e_m": sigma_e_m,
        "sigma_n_m": sigma_n_m,
        "cov_en_m2": round(float(found.cov[0, 1]), 5),
        "sigma_u_m": sigma_u_m,
        "surface": str(found.surface),
        "consistent": found.consistent,
        "sightings": [
            {"frame": frame, "pixel": list(pixel), "test_ratio": round(ratio, 3)}
            for (frame, pixel), ratio in zip(sightings, found.test_ratios, strict=True)
        ],
    }


def text(found: "ObjectPosition", locator: "FlightLocator", sightings: Sightings) -> list[str]:
    values = as_json(found, locator, sightings)
    level = "above sea level" if locator.amsl_known else "above the ground at the start"
    lines = [
        f"{values['lat_deg']:.7f}, {values['lon_deg']:.7f}, {found.p_m[2]:.1f} m {level}",
        f"within {values['radius95_m']:.1f} m (95 %), by the {found.surface}; 1-sigma of the height "
        f"{values['sigma_u_m']:.1f} m",
    ]
    lines += [
        f"frame {sighting['frame']} shows something else (test ratio {sighting['test_ratio']:.1f})"
        for sighting in values["sightings"]
        if sighting["test_ratio"] > 1.0
    ]
    return lines


def _pixel(given: str) -> tuple[float, float]:
    try:
        u, v = (float(part) for part in given.split(","))
    except ValueError:
        raise UsageError(f"--pixel {given}: not two numbers; give U,V, for example 412,300.5") from None
    return u, v
