"""The commands `terrafix map info`, `check` and `preview`."""

import sys
from pathlib import Path

import cv2
import msgspec
import numpy as np
import typer

from terrafix.core.errors import MapError, OutputError
from terrafix.core.geodesy import LocalFrame
from terrafix.map.package import MapPackage
from terrafix_tools.mapping.check.preview_page import write_page
from terrafix_tools.mapping.check.suitability import check
from terrafix_tools.mapping.check.text import lines_of, where


def info(package: Path) -> None:
    """Verifies every tile and prints the manifest as JSON. Raises MapError."""
    opened = MapPackage.open(package, verify=True)
    report = msgspec.to_builtins(opened.manifest) | {"signed_by": opened.signed_by, "bytes": package.stat().st_size}
    opened.close()
    _print_json(report)


def print_check(
    package: Path,
    mission: Path | None,
    camera: Path | None,
    agl_m: float | None,
    layer: str | None,
    picture: Path | None,
    *,
    as_json: bool,
) -> None:
    """Prints the check, and writes its picture; raises MapError when the mission leaves the map, and as ``check`` and
    ``write_page`` do."""
    opened = MapPackage.open(package, verify=True)
    try:
        checked = check(opened, mission=mission, camera=camera, agl_m=agl_m, layer=layer, progress=sys.stderr.isatty())
        if picture is not None:
            write_page(checked, picture)
    finally:
        opened.close()
    report = checked.report
    if as_json:
        _print_json(msgspec.to_builtins(report))
    else:
        for what, text in lines_of(report):
            typer.echo(f"{what:>8}  {text}")
    if report.mission is not None and report.mission.outside:
        first = report.mission.outside[0]
        raise MapError(f"{mission}: leaves the map for {where(first)}; move the mission, or build a larger map")


def preview(package: Path, out: Path, size_px: int, layer: str | None = None) -> None:
    """Writes a whole layer, north up, as a PNG with transparent voids. Raises MapError, OutputError."""
    opened = MapPackage.open(package)
    west, south, east, north = opened.manifest.bounds_wgs84
    local = opened.bind(LocalFrame((south + north) / 2, (west + east) / 2), layer)
    e_min, n_min, e_max, n_max = local.bounds_m
    gsd_m = max(e_max - e_min, n_max - n_min) / size_px
    shape = max(1, round((e_max - e_min) / gsd_m)), max(1, round((n_max - n_min) / gsd_m))
    image, valid = local.window(e_min, n_max, *shape, gsd_m)
    opened.close()
    png = cv2.imencode(".png", np.dstack([image, np.where(valid, 255, 0).astype(np.uint8)]))[1]
    try:
        out.write_bytes(png.tobytes())
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror})") from None


def _print_json(report: object) -> None:
    typer.echo(msgspec.json.format(msgspec.json.encode(report), indent=2).decode())
