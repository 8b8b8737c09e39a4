"""What `terrafix run` does on the ground before the supervisor starts: the map, as a package, and under the start."""

import os
from pathlib import Path

from terrafix.core.config import load
from terrafix.core.errors import MapError
from terrafix.core.initial_position import middle_of, start_is_unknown
from terrafix.core.signature import trusted_keys
from terrafix.map.package import MapPackage
from terrafix.vision.sources import open_configured, parse_start
from terrafix.vision.sources.description import START_SIGMA_M


def package_for(source: str, start: str, map_path: Path | None, configs: list[Path]) -> tuple[Path, float | None]:
    """The map package to fly with, and the height of its ground at the start (AMSL; None: not known).

    It is ``map_path``, or the one of the configuration, or the one that the source names.

    A GeoTIFF is made into a package (kept in the cache folder). A recorded source is opened once, to see that the map
    covers its start; a live camera is not, since only one process can hold it.
    Raises ConfigError, SourceError, UsageError, MapError."""
    config = load(configs)
    spec = source or config.source.path
    given = map_path or (Path(config.map.path) if config.map.path else None)
    unknown = False
    place: tuple[float, float] | None = parse_start(start or config.source.start)
    sigma_m = START_SIGMA_M
    if not spec or (os.path.exists(os.path.expanduser(spec)) and not spec.startswith("/dev/")):
        opened = open_configured(config.source, spec, place)
        given = given or opened.map_hint()
        origin = opened.origin()
        unknown = start_is_unknown(origin)
        place, sigma_m = None if unknown else (origin.lat_deg, origin.lon_deg), origin.start_sigma_m
        opened.close()
    if given is None:
        raise MapError("no map: give one with --map (GeoTIFF or map package) or [map] path")
    package = given if given.suffix.lower() == ".gpkg" else _built(given)
    # Where signatures are required every tile is read now, on the ground: in flight each is checked when it is used.
    trusted = trusted_keys(config.map.trusted_keys, required=config.map.require_signature)
    with_map = MapPackage.open(package, verify=trusted is not None, trusted=trusted)
    ground_amsl_m = None
    try:
        if place is not None and not with_map.covers_start(*place, sigma_m):
            todo = swapped(with_map, *place, sigma_m) or "use another --map or check it"
            raise MapError(f"{package}: has no imagery at the start {place[0]:.6f}, {place[1]:.6f}; {todo}")
        if place is not None:
            ground_amsl_m = with_map.ground_amsl_m(*place)
        elif unknown:
            ground_amsl_m = with_map.ground_amsl_m(*middle_of(with_map.manifest.bounds_wgs84))
    finally:
        with_map.close()
    return package, ground_amsl_m


def swapped(opened: MapPackage, lat_deg: float, lon_deg: float, sigma_m: float) -> str:
    """What to say of a start outside the map that lies on it with latitude and longitude exchanged; else empty."""
    if abs(lon_deg) > 90.0 or not opened.covers_start(lon_deg, lat_deg, sigma_m):
        return ""
    return f"latitude and longitude are swapped: {lon_deg:.6f}, {lat_deg:.6f} lies on the map"


def _built(geotiff: Path) -> Path:
    # Only here: on the vehicle there is a package, and the libraries that read GeoTIFFs are not installed.
    from terrafix_tools.mapping.build import ensure_package
    from terrafix_tools.replay import map_cache_dir

    return ensure_package(geotiff, map_cache_dir(), progress=True)
