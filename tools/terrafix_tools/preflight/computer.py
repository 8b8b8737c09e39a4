"""Checks of this computer: map, camera, models, clock, disk, temperature."""

import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from terrafix.core.config import Config
from terrafix.core.errors import TerrafixError
from terrafix.core.geodesy import LocalFrame
from terrafix.core.signature import trusted_keys
from terrafix.health.sysfs import read_disk_free_mb, read_throttling, read_zones
from terrafix.health.zones import deciding_zones
from terrafix.link.output import gps_time
from terrafix.map.package import MapPackage
from terrafix.vision.sources import open_configured, parse_start
from terrafix.vision.sources.description import read_description
from terrafix.vision.sources.stream_address import is_live
from terrafix_engines.correlation import open_correlator
from terrafix_engines.features import open_describer
from terrafix_engines.features.xfeat import XFeatDescriber
from terrafix_engines.manifest import ManifestError
from terrafix_engines.providers import short_name
from terrafix_engines.runtime import ModelFileError
from terrafix_tools.live import swapped_hint
from terrafix_tools.mapping.check.mission import mission_route, uncovered
from terrafix_tools.mapping.check.text import where
from terrafix_tools.mapping.statements import way_here
from terrafix_tools.mission.file import read_mission
from terrafix_tools.preflight.lines import Line, fail, ok, warn

FRAMES = 3
MIN_FREE_MB = 2000  # space for a flight of an hour with thumbnails
MIN_MEAN, MAX_MEAN = 15.0, 240.0  # limits of the mean grey value, of 255
MIN_CONTRAST = 6.0  # least standard deviation of an image; below: lens cap, a wall, fog
MIN_FINE_SHARE = 0.08  # share of the contrast within two pixels; sharp images of ground have 0.2 and more


def check_lines(config: Config, mission: Path | None, out: Path) -> Iterator[Line]:
    yield from _map(config, mission)
    yield from _camera(config)
    yield _models(config)
    if config.models.correlation == "gpu":
        yield _correlation(config)
    yield _clock()
    yield _disk(config, out)
    yield temperature_line(config)


def _map(config: Config, mission: Path | None) -> Iterator[Line]:
    if not config.map.path:
        yield fail("map", "the configuration has none", "set [map] path, or give --map")
        return
    required = config.map.require_signature
    try:
        trusted = trusted_keys(config.map.trusted_keys, required=required)
        package = MapPackage.open(Path(config.map.path), verify=True, trusted=trusted)
    except TerrafixError as error:
        yield fail("map", *_text_and_fix(error))
        return
    try:
        yield from _guarded("map", _integrity(package))
        yield from _guarded("start", _start(package, config))
        if mission is not None:
            yield from _guarded("mission", _cover(package, mission))
    finally:
        package.close()


def _guarded(check: str, lines: Iterator[Line]) -> Iterator[Line]:
    """Turns an exception into a failure of its own check, so that the other checks run."""
    try:
        yield from lines
    except TerrafixError as error:
        yield fail(check, *_text_and_fix(error))


def _integrity(package: MapPackage) -> Iterator[Line]:
    newest = package.layer(None)
    signed = f"signed by {', '.join(package.signed_by)}" if package.signed_by else "not signed"
    shows = "roads, water and buildings, no imagery" if newest.is_drawn else "imagery"
    yield ok("map", f"{package.path.name}: all tiles valid; {signed}; {shows} of {newest.date or 'unknown date'}")
    here = way_here(package)
    if here is not None:
        yield fail("map", here, "install the grid on this computer, too: pyproj sync --file GRID")


def _start(package: MapPackage, config: Config) -> Iterator[Line]:
    """The start that the flight will use: from the configuration, else from the camera description."""
    start_lat_lon = parse_start(config.source.start)
    if start_lat_lon is None and config.source.camera:
        described = read_description(Path(config.source.camera).expanduser()).start
        start_lat_lon = None if described is None else (described.lat_deg, described.lon_deg)
    if start_lat_lon is None:
        receiver = "the autopilot's GNSS position before arming is used, or else " if config.link.gnss_start else ""
        text = f"not configured: {receiver}the whole map is searched for the first position"
        yield warn("start", text, "set [source] start, or [start] in the description of the camera")
        return
    start_text = f"{start_lat_lon[0]:.6f}, {start_lat_lon[1]:.6f}"
    if package.covers(*start_lat_lon):
        yield ok("start", f"{start_text} lies on the map")
    else:
        todo = swapped_hint(package, *start_lat_lon, 0.0) or "correct the start, or take another map"
        yield fail("start", f"{start_text} does not lie on the map", todo)


def _cover(package: MapPackage, mission: Path) -> Iterator[Line]:
    plan = read_mission(mission, course_only=True)
    west, south, east, north = package.manifest.bounds_wgs84
    course = mission_route(plan, LocalFrame((south + north) / 2, (west + east) / 2))
    outside = course.stretches(uncovered(course, package, package.layer(None).table))
    if outside:
        yield fail("mission", f"leaves the map for {where(outside[0])}", "move the mission, or build a larger map")
    else:
        yield ok("mission", f"its {course.along_m[-1] / 1000:.1f} km lie on the map")
    for note in plan.notes:
        yield warn("mission", note, "if the vehicle flies to it, put a waypoint there")


def _camera(config: Config) -> Iterator[Line]:
    spec = config.source.path
    if not spec:
        yield fail("camera", "the configuration has no source", "set [source] path")
        return
    if not is_live(spec):
        yield warn("camera", f"{spec} is a recording, not a camera", "for a flight set [source] path to the camera")
        return
    try:
        source = open_configured(config.source)
        try:
            images = []
            for shot in source.shots():
                if shot.image is None:
                    yield fail("camera", f"a frame cannot be used: {shot.frame.error}", "check cable and driver")
                    return
                images.append(shot.image)
                if len(images) == FRAMES:
                    break
        finally:
            source.close()
    except TerrafixError as error:
        yield fail("camera", *_text_and_fix(error))
        return
    yield check_images(images)


def check_images(images: list[np.ndarray]) -> Line:
    """Checks a few successive frames (H, W, 3)."""
    if len(images) < FRAMES:
        return fail("camera", f"only {len(images)} frames received", "check cable and driver")
    if all(np.array_equal(images[0], image) for image in images[1:]):
        return fail("camera", "repeats the same picture", "start the camera again")
    grey = cv2.cvtColor(images[-1], cv2.COLOR_BGR2GRAY).astype(np.float32)
    size = f"{grey.shape[1]} x {grey.shape[0]} px"
    mean, spread = float(grey.mean()), float(grey.std())
    if not MIN_MEAN <= mean <= MAX_MEAN or spread < MIN_CONTRAST:
        return warn("camera", f"{size}, but the picture is empty (mean {mean:.0f}, spread {spread:.0f})", "lens cap?")
    fine = float((grey - cv2.GaussianBlur(grey, (0, 0), 2.0)).std()) / spread
    if fine < MIN_FINE_SHARE:
        return warn("camera", f"{size}, but it looks blurred", "point it at something 10 m away or more, and focus")
    return ok("camera", f"{size}, sharp, new images")


def _models(config: Config) -> Line:
    if not config.models.xfeat:
        return ok("models", "none: matching without weights")
    try:
        describer = open_describer(config.models.xfeat, config.models.folder)
    except ModelFileError as error:
        return fail("models", str(error), "correct [models] xfeat, or empty it")
    by = f" by {short_name(describer.model.provider)}" if isinstance(describer, XFeatDescriber) else ""
    return ok("models", f"{config.models.xfeat} can be run{by}")


def _correlation(config: Config) -> Line:
    try:
        providers = open_correlator(config.models.folder).providers
    except (ManifestError, ModelFileError) as error:
        return fail("correlation", str(error), 'terrafix models export and build, or set [models] correlation = "cpu"')
    return ok("correlation", f"on the GPU by {', '.join(dict.fromkeys(map(short_name, providers)))}")


def _clock() -> Line:
    if gps_time.is_plausible(time.time_ns()):
        return ok("clock", time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()))
    text = f"year {time.strftime('%Y', time.gmtime())}: GPS_INPUT will have no GPS week"
    return warn("clock", text, "set it (timedatectl set-time), or give the board a battery")


def _disk(config: Config, out: Path) -> Line:
    folder = next(p for p in (out.absolute(), *out.absolute().parents) if p.exists())
    free_mb = read_disk_free_mb(folder)
    if free_mb is None:
        return warn("disk", f"{folder}: free space cannot be read", "check the file system")
    if free_mb < MIN_FREE_MB:
        return fail("disk", f"{free_mb} MB free in {folder}, a flight may need {MIN_FREE_MB}", "delete old records")
    if free_mb < config.recorder.budget_mb:
        text = f"{free_mb} MB free in {folder}, below [recorder] budget_mb = {config.recorder.budget_mb}"
        return warn("disk", text, "delete old records, or lower the budget")
    return ok("disk", f"{free_mb} MB free in {folder}")


def temperature_line(config: Config) -> Line:
    thermal = Path(config.health.sysfs_root) / "class" / "thermal"
    zones, throttling = read_zones(thermal), read_throttling(thermal)
    if throttling:
        return warn("temperature", f"throttled by {', '.join(throttling)}", "let it cool, and check the fan")
    if not zones:
        return warn(
            "temperature", f"no zone can be read in {thermal}", "heat will not be noticed; set [health] sysfs_root"
        )
    deciding, left_out = deciding_zones(zones, config.health.zones)
    if not deciding:
        names = ", ".join(zone.name for zone in zones)
        return warn("temperature", f"none of [health] zones is readable in {thermal}", f"choose among: {names}")
    hottest = max(deciding, key=lambda zone: zone.temperature_c)
    text = "; ".join([f"{hottest.temperature_c:.0f} C ({hottest.name})", *left_out])
    if hottest.temperature_c >= config.health.hot_c:
        return warn("temperature", f"{text}, on the ground already", "let it cool, and check the fan")
    return ok("temperature", text)


def _text_and_fix(error: TerrafixError) -> tuple[str, str]:
    """Splits an error text into text and fix: the part behind the last semicolon is the remedy."""
    text, _, todo = str(error).rpartition("; ")
    return (text, todo) if text else (str(error), "")
