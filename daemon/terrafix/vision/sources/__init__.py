"""Sources of a flight: the contract (``Source``), six implementations, one factory (``open_source``)."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from terrafix.core.config import SourceSection
from terrafix.core.errors import SourceError, UsageError
from terrafix.vision.sources.bag_topics import is_bag
from terrafix.vision.sources.contract import UNKNOWN_TIMING, Shot, Source, Timing
from terrafix.vision.sources.fisheye import pinhole_source
from terrafix.vision.sources.images import IMAGE_SUFFIXES, is_image_name
from terrafix.vision.sources.stream_address import is_live

__all__ = ["VIDEO_SUFFIXES", "Shot", "Source", "open_configured", "open_source", "parse_start", "parse_topics"]

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".avi", ".mkv", ".m4v", ".ts", ".webm", ".mpg", ".mpeg"})


def open_source(
    spec: str,
    *,
    start: tuple[float, float] | None = None,
    camera: Path | None = None,
    rate_hz: float = 2.0,
    timing: Timing = UNKNOWN_TIMING,
    topics: Mapping[str, str] | None = None,
    wait_for_camera: bool = False,
) -> Source:
    """Opens a flight folder, photos, a video file, a ROS bag, or a camera (``stream_address.is_live``). Of a fisheye
    lens the images are those of a pinhole camera (``fisheye.view_of``).

    ``start`` (lat_deg, lon_deg) overrides the initial position of the source. ``camera``: a camera description; live
    cameras require it, for photos and videos it overrides theirs. ``rate_hz``: frame rate taken from a video or camera.
    ``timing``: of a camera. ``topics``: of a bag, by kind. ``wait_for_camera``: a missing camera is no error;
    ``shots`` waits for it (a restart in flight).
    Raises SourceError: one line with the problem and the remedy."""
    return pinhole_source(_open(spec, start, camera, rate_hz, timing, topics or {}, wait_for_camera=wait_for_camera))


def _open(
    spec: str,
    start: tuple[float, float] | None,
    camera: Path | None,
    rate_hz: float,
    timing: Timing,
    topics: Mapping[str, str],
    *,
    wait_for_camera: bool,
) -> Source:
    """``open_source`` with the images as they are stored. Raises SourceError."""
    if not spec.strip():
        raise SourceError(
            "no source given; name a flight folder, photos, a video, /dev/videoN, csi://0, rtsp://..., "
            "udp://:5600, http://... or a GStreamer pipeline"
        )
    on_disk = os.path.exists(os.path.expanduser(spec)) and not spec.startswith("/dev/")
    if not on_disk and is_live(spec):
        from terrafix.vision.sources.camera import LiveCamera

        return LiveCamera(spec, start, camera, rate_hz, timing=timing, wait=wait_for_camera)
    if not on_disk:
        raise SourceError(f"{spec}: no such flight folder, photo folder, video or camera; check the path")
    path = Path(spec).expanduser()
    if camera is not None and not camera.expanduser().is_file():
        raise SourceError(f"{camera}: no such camera description; check [source] camera")
    if path.name == "flight.toml" and path.is_file():
        path = path.parent
    if is_bag(path):
        from terrafix.vision.sources.rosbag import RosBag

        return RosBag(path, start, camera, rate_hz, topics)
    if path.is_dir():
        return _open_folder(path, start, camera)
    if path.suffix.lower() in VIDEO_SUFFIXES:
        from terrafix.vision.sources.video import Video

        return Video(path, start, camera, rate_hz)
    if path.suffix.lower() in IMAGE_SUFFIXES:
        raise SourceError(f"{spec}: a single image is not a flight; name the folder that it lies in")
    raise SourceError(f"{spec}: not a kind of source that is known; videos end in {', '.join(sorted(VIDEO_SUFFIXES))}")


def open_configured(
    section: SourceSection,
    spec: str = "",
    start: tuple[float, float] | None = None,
    topics: Mapping[str, str] | None = None,
    *,
    wait_for_camera: bool = False,
) -> Source:
    """``open_source`` with the [source] section of the configuration; ``spec``, ``start`` and each of ``topics``
    override it when given."""
    return open_source(
        spec or section.path,
        start=start or parse_start(section.start),
        camera=Path(section.camera).expanduser() if section.camera else None,
        rate_hz=section.rate_hz,
        topics={**section.topics, **(topics or {})},
        timing=Timing(1e-3 * section.latency_ms, 1e-3 * section.latency_sigma_ms, section.sender_clock),
        wait_for_camera=wait_for_camera,
    )


def parse_topics(texts: Sequence[str]) -> dict[str, str]:
    """KIND=TOPIC of a ROS bag, by kind. Raises UsageError."""
    pairs = [text.partition("=") for text in texts]
    for text, (kind, equals, _) in zip(texts, pairs, strict=True):
        if not kind or not equals:
            raise UsageError(f"topic '{text}': write KIND=TOPIC, for example image=/camera/image_raw")
    return {kind: topic for kind, _, topic in pairs}


def parse_start(text: str) -> tuple[float, float] | None:
    """'LAT,LON' in degrees -> (lat_deg, lon_deg); '' -> None. Raises UsageError."""
    if not text.strip():
        return None
    try:
        lat_deg, lon_deg = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"start '{text}': write LAT,LON in degrees, for example 48.8584,2.2945") from None
    if not (abs(lat_deg) <= 90 and abs(lon_deg) <= 180):
        raise UsageError(f"start '{text}': latitude is within +-90 and longitude within +-180 degrees, in this order")
    return lat_deg, lon_deg


def _open_folder(folder: Path, start: tuple[float, float] | None, camera: Path | None) -> Source:
    try:
        names = set(os.listdir(folder))
    except OSError as error:
        raise SourceError(f"{folder}: cannot be read ({error.strerror})") from None
    photos = any(map(is_image_name, names))
    if "frames.csv" in names or "frames" in names or ("flight.toml" in names and not photos):
        from terrafix.vision.sources.flight_folder import FlightFolder

        return FlightFolder(folder, start)
    if photos:
        from terrafix.vision.sources.photos import Photos

        return Photos(folder, start, camera)
    raise SourceError(f"{folder}: neither a flight folder (flight.toml, frames.csv, frames/) nor a folder of photos")
