"""Configuration: strict keys, bounded values, read once at start.

The defaults here and in config/default.toml are equal (tested). An unknown key is an error that proposes the nearest
known key. Values that a user cannot sensibly choose are constants in the code."""

import difflib
import re
import tomllib
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from terrafix.core.errors import ConfigError
from terrafix.core.passwords import without_password
from terrafix.core.toml_file import read_toml

OutputName = Literal["gps_input", "odometry", "vision_position", "external_position", "global_position"]
GnssMode = Literal["off", "advise", "act"]
RecordedFrames = Literal["none", "thumbnails", "keyframes", "all"]
PlaceSearch = Literal["auto", "exact", "faiss"]
Baud = Annotated[int, Meta(ge=9600, le=3_000_000)]


class Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base class of all sections."""


class Map(Section, frozen=True, kw_only=True):
    path: str = ""  # map package or GeoTIFF; the command line overrides it
    ce90_m: Annotated[float, Meta(ge=0, le=200)] = 10.0  # default for layers without a stated or estimated CE90
    require_signature: bool = False  # reject a package that no key of trusted_keys has signed
    trusted_keys: list[str] = []  # public key files (.pub of `terrafix map keygen`), or folders of them


class Models(Section, frozen=True, kw_only=True):
    xfeat: str = ""  # name of a fetched model, or path of an ONNX file; empty: matching without a learned model
    correlation: Literal["cpu", "gpu"] = "cpu"  # where descriptors are correlated with the map
    folder: str = ""  # folder of fetched models; empty: TERRAFIX_MODELS, or the user's data folder


class Places(Section, frozen=True, kw_only=True):
    index: str = ""  # folder of a place index (`terrafix map index`); empty: the whole map is correlated
    search: PlaceSearch = "auto"  # auto: exact up to 200 000 vectors, FAISS beyond


class Vision(Section, frozen=True, kw_only=True):
    features: str = "sift"  # of frames that KLT does not track: sift, or the name of a fetched model


class LinkSection(Section, frozen=True, kw_only=True):
    device: str = "udpout:127.0.0.1:14550"
    baud: Baud = 921_600
    ground_devices: list[str] = []  # direct links to ground stations; no packet is forwarded between them
    ground_baud: Baud = 57_600
    view_sysid: Annotated[int, Meta(ge=0, le=255)] = 0  # ghost vehicle at our position on ground_devices; 0: none
    sysid: Annotated[int, Meta(ge=1, le=255)] = 1
    compid: Annotated[int, Meta(ge=1, le=255)] = 197  # MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
    autopilot_sysid: Annotated[int, Meta(ge=0, le=255)] = 0  # 0: the only one, or that of the camera
    signing_key: str = ""  # file with the MAVLink 2 signing key; empty: packets are neither signed nor checked
    gps_id: Annotated[int, Meta(ge=0, le=3)] = 0
    rate_hz: Annotated[float, Meta(ge=5, le=15)] = 10.0  # the autopilot drops messages at shorter intervals
    outputs: list[OutputName] = []  # empty: chosen by autopilot, gps_input for ArduPilot, global_position for PX4
    gnss: GnssMode = "advise"  # reaction when a GNSS receiver disagrees with the map
    gnss_start: bool = True  # initial position from a GNSS receiver, if no other source gives one
    ground_fix: bool = False  # a fix from the stated start before any map match: the disarmed vehicle stands on ground
    map_offset: bool = True  # subtract the map error that a trusted GNSS receiver shows from the output
    nmea_device: str = ""  # additional output: NMEA 0183 to this device
    nmea_baud: Baud = 115_200
    msp_device: str = ""  # additional output: MSP2_SENSOR_GPS to this device
    msp_baud: Baud = 115_200


class RecorderSection(Section, frozen=True, kw_only=True):
    frames: RecordedFrames = "thumbnails"
    frame_format: Literal["jpeg", "png"] = "jpeg"  # of frames at full size; png: without loss
    thumbnail_width_px: Annotated[int, Meta(ge=64, le=1920)] = 320
    budget_mb: Annotated[int, Meta(ge=64)] = 64_000


class HealthSection(Section, frozen=True, kw_only=True):
    sysfs_root: str = "/sys"
    zones: list[str] = []  # names of the zones that decide the thermal band; empty: all that measure something
    hot_c: Annotated[float, Meta(ge=30, le=120)] = 80.0
    critical_c: Annotated[float, Meta(ge=30, le=120)] = 95.0
    hysteresis_c: Annotated[float, Meta(ge=0, le=30)] = 5.0
    hot_match_every: Annotated[int, Meta(ge=1, le=60)] = 2
    critical_match_every: Annotated[int, Meta(ge=1, le=60)] = 4
    hot_rate_hz: Annotated[float, Meta(gt=0, le=120)] = 5.0
    critical_rate_hz: Annotated[float, Meta(gt=0, le=120)] = 2.0


class SourceSection(Section, frozen=True, kw_only=True):
    path: str = ""  # flight folder, photo folder, video file, or a camera (vision/sources/stream_address.py)
    realtime: bool = True  # play a recorded source in real time (live shell only)
    start: str = ""  # "LAT,LON" in degrees, overrides the source; the command line overrides it
    camera: str = ""  # camera description (config/cameras); required for cameras, optional for photos and videos
    rate_hz: Annotated[float, Meta(gt=0, le=120)] = 2.0  # frames per second taken from a video or a camera
    topics: dict[str, str] = {}  # of a ROS bag, by kind (vision/sources/bag_topics.py)
    latency_ms: Annotated[float, Meta(ge=0, le=2000)] = 0.0  # of a camera, from exposure to time stamp
    latency_sigma_ms: Annotated[float, Meta(ge=0, le=2000)] = 0.0  # its 1-sigma; 0: as usual for the kind of camera
    sender_clock: bool = False  # the clock of an RTSP camera is synchronised: its sender reports give the exposure


class RuntimeSection(Section, frozen=True, kw_only=True):
    cores: Annotated[int, Meta(ge=0, le=256)] = 0


class SmootherSection(Section, frozen=True, kw_only=True):
    enabled: bool = True


class LogSection(Section, frozen=True, kw_only=True):
    level: Literal["DEBUG", "INFO", "WARN", "ERROR"] = "INFO"


class Config(Section, frozen=True, kw_only=True):
    map: Map = Map()
    models: Models = Models()
    places: Places = Places()
    vision: Vision = Vision()
    source: SourceSection = SourceSection()
    link: LinkSection = LinkSection()
    recorder: RecorderSection = RecorderSection()
    health: HealthSection = HealthSection()
    runtime: RuntimeSection = RuntimeSection()
    smoother: SmootherSection = SmootherSection()
    log: LogSection = LogSection()


def without_passwords(config: Config) -> Config:
    """For logs and records."""
    source = msgspec.structs.replace(config.source, path=without_password(config.source.path))
    return msgspec.structs.replace(config, source=source)


def load(paths: list[Path]) -> Config:
    """Defaults, overridden key by key by each file in turn. Raises ConfigError with file, key and what to do."""
    merged: dict[str, dict[str, object]] = {}
    for path in paths:
        for name, table in _read(path).items():
            if not isinstance(table, dict):
                raise ConfigError(f"{path}: '{name}' stands outside any section; write it under a [section]")
            merged.setdefault(name, {}).update(table)
        try:
            msgspec.convert(merged, Config)
        except msgspec.ValidationError as error:
            raise ConfigError(f"{path}: {_explain(str(error))}") from None
    return msgspec.convert(merged, Config)


def _read(path: Path) -> dict[str, object]:
    try:
        return read_toml(path)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such configuration file; check the path given to --config") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML ({error})") from None


def _explain(text: str) -> str:
    """Replaces msgspec's message about an unknown key by one with the nearest known key."""
    unknown = re.search(r"unknown field `(.+?)`(?: - at `\$\.?(.*?)`)?", text)
    if not unknown:
        return text.replace("`$.", "`")
    key, where = unknown.group(1), unknown.group(2) or ""
    section = getattr(Config(), where, None) if where else Config()
    known = [f.name for f in msgspec.structs.fields(type(section))] if isinstance(section, Section) else []
    near = difflib.get_close_matches(key, known, 1, cutoff=0.5)
    place = f"in [{where}]" if where else "as a section"
    hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(known)}"
    return f"unknown key '{key}' {place}; {hint}"
