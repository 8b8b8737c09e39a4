"""Preparation of `terrafix run` before the supervisor starts: map package and check that it covers the start."""

import json
import os
import signal
import sys
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from terrafix.core.errors import ERROR_OF_EXIT_CODE, MapError, TerrafixError
from terrafix.runtime.fork_server import set_parent_death_signal

if TYPE_CHECKING:
    from terrafix.map.package import MapPackage


def package_for(source: str, start: str, map_path: Path | None, configs: list[Path]) -> tuple[Path, float | None]:
    """Returns the map package to fly with, and the ground height at the start (m AMSL; None: unknown).

    The map is ``map_path``, else the one of the configuration, else the one that the source names. A GeoTIFF is
    converted to a package, which stays in the cache folder. A recorded source is opened once to check that the map
    covers its start; a live camera is not opened, since only one process can hold it.
    Raises ConfigError, SourceError, UsageError, MapError.
    """
    # Imported here: `package_for_in_child` is called in a process that shall not load these.
    from terrafix.core.config import load
    from terrafix.core.initial_position import map_center, start_is_unknown
    from terrafix.core.signature import trusted_keys
    from terrafix.map.package import MapPackage
    from terrafix.vision.sources import open_configured, parse_start
    from terrafix.vision.sources.description import START_SIGMA_M
    from terrafix_tools.flight_map import package_of

    config = load(configs)
    spec = source or config.source.path
    map_file = map_path or (Path(config.map.path) if config.map.path else None)
    unknown = False
    start_lat_lon: tuple[float, float] | None = parse_start(start or config.source.start)
    sigma_m = START_SIGMA_M
    if not spec or (os.path.exists(os.path.expanduser(spec)) and not spec.startswith("/dev/")):
        opened = open_configured(config.source, spec, start_lat_lon)
        map_file = map_file or opened.map_hint()
        origin = opened.origin()
        unknown = start_is_unknown(origin)
        start_lat_lon, sigma_m = None if unknown else (origin.lat_deg, origin.lon_deg), origin.start_sigma_m
        opened.close()
    if map_file is None:
        raise MapError("no map: give one with --map (GeoTIFF or map package) or [map] path")
    package = package_of(map_file, progress=True)
    # If signatures are required, all tiles are verified here, before the flight; in flight each tile is verified at
    # first use.
    trusted = trusted_keys(config.map.trusted_keys, required=config.map.require_signature)
    opened_map = MapPackage.open(package, verify=trusted is not None, trusted=trusted)
    ground_amsl_m = None
    try:
        if start_lat_lon is not None and not opened_map.covers_start(*start_lat_lon, sigma_m):
            todo = swapped_hint(opened_map, *start_lat_lon, sigma_m) or "use another --map or check it"
            raise MapError(
                f"{package}: has no imagery at the start {start_lat_lon[0]:.6f}, {start_lat_lon[1]:.6f}; {todo}"
            )
        if start_lat_lon is not None:
            ground_amsl_m = opened_map.ground_amsl_m(*start_lat_lon)
        elif unknown:
            ground_amsl_m = opened_map.ground_amsl_m(*map_center(opened_map.manifest.bounds_wgs84))
    finally:
        opened_map.close()
    return package, ground_amsl_m


def package_for_in_child(
    source: str, start: str, map_path: Path | None, configs: list[Path]
) -> tuple[Path, float | None]:
    """``package_for`` in a child process, whose memory is free again before the flight: the libraries that open a map
    and a source take 45 MB, and the supervisor needs none of them. To be called before this process has threads."""
    sys.stdout.flush()
    sys.stderr.flush()
    reading, writing = os.pipe()
    parent_pid, child_pid = os.getpid(), os.fork()
    if child_pid == 0:
        os.close(reading)
        set_parent_death_signal(parent_pid, signal.SIGKILL)
        _answer(writing, source, start, map_path, configs)
    os.close(writing)
    with open(reading, "rb") as answers:
        answer = answers.read()
    code = os.waitstatus_to_exitcode(os.waitpid(child_pid, 0)[1])
    if error := ERROR_OF_EXIT_CODE.get(code):
        raise error(answer.decode())
    if code != 0:
        raise SystemExit(128 - code if code < 0 else code)  # its traceback is written, or a signal has ended both
    package, ground_amsl_m = json.loads(answer)
    return Path(package), ground_amsl_m


def _answer(writing: int, source: str, start: str, map_path: Path | None, configs: list[Path]) -> NoReturn:
    """The child process: writes the result, or the text of the error whose exit code it has."""
    code = 1
    try:
        package, ground_amsl_m = package_for(source, start, map_path, configs)
        os.write(writing, json.dumps([str(package), ground_amsl_m]).encode())
        code = 0
    except TerrafixError as error:
        os.write(writing, str(error).encode())
        code = error.exit_code
    except KeyboardInterrupt:
        code = 128 + signal.SIGINT
    finally:
        if code == 1:
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def swapped_hint(opened: "MapPackage", lat_deg: float, lon_deg: float, sigma_m: float) -> str:
    """Returns a hint if a start outside the map lies on it with latitude and longitude exchanged; else ""."""
    if abs(lon_deg) > 90.0 or not opened.covers_start(lon_deg, lat_deg, sigma_m):
        return ""
    return f"latitude and longitude are swapped: {lon_deg:.6f}, {lat_deg:.6f} lies on the map"
