"""Parsers of what comes from outside, as functions of bytes. Any input may be refused (TerrafixError, or a result that
says so); any other exception is a bug."""

import io
import sqlite3
import struct
import tempfile
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from terrafix.core.config import Config, LinkSection
from terrafix.core.config import load as load_config
from terrafix.core.errors import TerrafixError
from terrafix.core.geodesy import LocalFrame
from terrafix.core.installed_files import installed_files
from terrafix.core.mavlink.tlog import read_imu, read_tlog, record
from terrafix.link.edge import MavlinkEdge
from terrafix.link.node import LinkNode
from terrafix.map.package import MapPackage
from terrafix.messages import Camera, Frame, Origin, StatusText
from terrafix.recorder.provenance import header
from terrafix.recorder.reader import ReadResult, read_received
from terrafix.recorder.writer import FlightWriter
from terrafix.vision.sources import parse_start
from terrafix.vision.sources.description import read_description
from terrafix.vision.sources.exif import read_info
from terrafix.vision.sources.gpmf import read_gpmf
from terrafix.vision.sources.images import decode_image
from terrafix.vision.sources.mjpeg import MjpegCapture
from terrafix.vision.sources.table import read_table
from terrafix.vision.sources.xmp import read_xmp
from terrafix_lab.sim.autopilot.fuzz_wire import UNIX_NS, FuzzedAutopilot
from terrafix_lab.sim.autopilot.wire import heartbeat
from terrafix_lab.sim.closed_loop.loopback import Loopback
from terrafix_tools.autopilot_log.read import read_autopilot_log
from terrafix_tools.in_process import InProcessShell
from terrafix_tools.mapping.area.files import read_area
from terrafix_tools.mapping.datum import crs_of
from terrafix_tools.mapping.package.height_values import height_statement, heights_of
from terrafix_tools.mapping.source import open_raster
from terrafix_tools.mapping.sources.tiles.files import MbtilesReader
from terrafix_tools.mapping.sources.tiles.grid import Tile
from terrafix_tools.mission.file import read_mission

WIDTH, HEIGHT = 64, 48  # of the images
SIDE_PX = 300  # of the map
COMMANDS = (22, 16, 17, 31, 82, 84, 177, 179, 189, 195, 600, 601, 20, 85, 60_000)  # of a mission
STEPS = 40  # of the telemetry, 0.02 s each


@dataclass(frozen=True)
class Target:
    """``seeds``: valid inputs; ``run`` raises only TerrafixError."""

    name: str
    seeds: Callable[[], list[bytes]]
    run: Callable[[bytes], object]


def _in_file(suffix: str, read: Callable[[Path], object]) -> Callable[[bytes], None]:
    """Runs a reader of files; the file is in memory."""
    folder = Path(tempfile.mkdtemp(prefix="terrafix-fuzz-", dir="/dev/shm"))
    path = folder / f"input{suffix}"

    def run(data: bytes) -> None:
        path.write_bytes(data)
        read(path)

    return run


def _images() -> list[bytes]:
    image = np.random.default_rng(1).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    return [cv2.imencode(suffix, image)[1].tobytes() for suffix in (".jpg", ".png", ".webp", ".tiff", ".bmp")]


def _photos() -> list[bytes]:
    """Photos with the tags of several makers."""
    pixels = np.random.default_rng(1).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    found = []
    for packet in _xmp_packets():
        exif = Image.Exif()
        exif[0x0110] = "L1D-20c"
        tags = {0x9003: "2024:06:01 10:00:00", 0x920A: 10.26, 0xA002: WIDTH, 0xA003: HEIGHT, 0xA404: 2.0, 0xA405: 28}
        exif.get_ifd(0x8769).update({**tags, 0xA20E: 40.0, 0xA210: 4})
        exif.get_ifd(0x8825).update({1: "N", 2: (48.0, 8.0, 1.5), 3: "E", 4: (14.0, 21.0, 3.0)})
        stream = io.BytesIO()
        Image.fromarray(pixels).save(stream, "JPEG", exif=exif, xmp=packet)
        found.append(stream.getvalue())
    return [*found, *_images()]


def _xmp_packets() -> list[bytes]:
    gimbal = 'drone-dji:GimbalYawDegree="+30.0" drone-dji:GimbalPitchDegree="-90.0" drone-dji:RelativeAltitude="+80.5"'
    centre = 'drone-dji:CalibratedOpticalCenterX="32" drone-dji:CalibratedOpticalCenterY="24"'
    lens = f'drone-dji:CalibratedFocalLength="50.0" {centre}'
    bodies = (
        f'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {gimbal} {lens}',
        'xmlns:C="http://pix4d.com/camera/1.0/" C:Yaw="3000/100" C:Pitch="1.5" C:Roll="0" C:AboveGroundAltitude="80"',
        'drone-parrot:CameraYawDegree="30" drone-parrot:CameraPitchDegree="-90" drone-parrot:CameraRollDegree="0"',
    )
    return [f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description {body}/></x:xmpmeta>'.encode() for body in bodies]


def _dataflash_logs() -> list[bytes]:
    """Binary and text, whole and with the first bytes lost."""
    formats = [
        (128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns"),
        (10, 23, "ATT", "Qfff", "TimeUS,Roll,Pitch,Yaw"),
        (12, 14, "MODE", "QMBB", "TimeUS,Mode,ModeNum,Rsn"),
    ]
    binary = b"".join(
        b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, length, *(text.encode() for text in texts))
        for number, length, *texts in formats
    )
    binary += b"\xa3\x95\x0c" + struct.pack("<QBBB", 1_000_000, 5, 5, 1)
    text = "".join(f"FMT, {number}, {length}, {', '.join(texts)}\r\n" for number, length, *texts in formats)
    for k in range(30):
        binary += b"\xa3\x95\x0a" + struct.pack("<Qfff", 1_000_000 + 100_000 * k, 0.1 * k, 0.0, 90.0)
        text += f"ATT, {1_000_000 + 100_000 * k}, {0.1 * k:.2f}, 0.00, 90.00\r\n"
    return [binary, binary[40:], bytes(512) + binary, text.encode(), text.encode()[20:]]


def _logs() -> list[bytes]:
    """Telemetry logs: whole, torn at the front, with a clock that jumps, and of two vehicles."""
    (log,) = _telemetry()[1]
    packets = [
        packet
        for step in range(STEPS)
        for packet in FuzzedAutopilot(signed=False).packets(step, step * 20_000_000, b"")
    ]
    jumping = [
        record(47_000_000 + 20_000 * i + (10**15 if i > len(packets) // 2 else 0), p) for i, p in enumerate(packets)
    ]
    return [log, log[13:], b"".join(jumping), log + log.replace(b"\x01\x01", b"\x02\x01")]


def _configs() -> list[bytes]:
    return [(installed_files() / "config" / "default.toml").read_bytes(), b'[link]\ndevice = "udpin:0.0.0.0:14550"\n']


def _descriptions() -> list[bytes]:
    cameras = installed_files() / "config" / "cameras"
    start = b"\n[start]\nlat_deg = 48.0\nlon_deg = 11.0\nsigma_m = 10.0\n"
    return [path.read_bytes() + start for path in sorted(cameras.glob("*.toml"))]


def _tables() -> list[bytes]:
    rows = "".join(f"{i:04d}.jpg,{0.5 * i},90,0,-1.5,100\n" for i in range(8))
    return [f"file,t_s,yaw_deg,pitch_deg,roll_deg,agl_m\n{rows}".encode(), b"file,t_s\na.jpg,0\nb.jpg,1\n"]


@cache
def _telemetry() -> tuple[list[bytes], list[bytes]]:
    """Packets of a short flight: as they arrive, and as a log."""
    autopilot = FuzzedAutopilot(signed=False)
    packets = [packet for step in range(STEPS) for packet in autopilot.packets(step, step * 20_000_000, b"")]
    log = b"".join(record(1_700_000_000_000_000 + 20_000 * i, packet) for i, packet in enumerate(packets))
    return [b"".join(packets), heartbeat(42)], [log]


@cache
def _records() -> list[bytes]:
    """A small flight record."""
    camera = Camera(width=WIDTH, height=HEIGHT, fx=50.0, fy=50.0, cx=32.0, cy=24.0)
    origin = Origin(
        t_ns=1, camera=camera, lat_deg=48.0, lon_deg=11.0, ground_amsl_m=500.0, start_sigma_m=10.0, yaw_sigma_deg=3.0,
        agl_sigma_m=3.0, attitude_sigma_deg=1.0,
    )  # fmt: skip
    frames = [Frame(t_ns=i, frame_id=i, file="", width=WIDTH, height=HEIGHT) for i in range(30)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.mcap"
        writer = FlightWriter(path, header(Config()))
        for message in (origin, *frames, StatusText(t_ns=40, severity=4, text="no map fix")):
            writer.write(message, message.t_ns)
        writer.close()
        return [path.read_bytes()]


@cache
def _maps() -> list[bytes]:
    """A small map package; needs GDAL."""
    import rasterio
    from rasterio.transform import Affine

    from terrafix_tools.mapping.build import build

    bands = np.random.default_rng(2).integers(1, 255, (3, SIDE_PX, SIDE_PX), np.uint8)
    with tempfile.TemporaryDirectory() as folder:
        tif, package = Path(folder) / "map.tif", Path(folder) / "map.gpkg"
        profile = {"driver": "GTiff", "width": SIDE_PX, "height": SIDE_PX, "count": 3, "dtype": "uint8"}
        transform = Affine(1.0, 0.0, 690_000.0, 0.0, -1.0, 5_330_000.0)
        with rasterio.open(tif, "w", **profile, crs="EPSG:32632", transform=transform) as file:
            file.write(bands)
        build(tif, package, date="2024-01-01")
        return [package.read_bytes()]


def _read_map(path: Path) -> None:
    package = MapPackage.open(path)
    try:
        west, south, east, north = package.manifest.bounds_wgs84
        frame = LocalFrame(0.5 * (south + north), 0.5 * (west + east))
        local = package.bind(frame)
        local.window(-50.0, 50.0, 100, 100, 1.0)
        local.elevation(np.zeros(1), np.zeros(1))
        package.verify()
    finally:
        package.close()


def _read_record(path: Path) -> None:
    for _ in read_received(path, ReadResult()):
        pass


def _read_log(path: Path) -> None:
    read_tlog(path)
    read_imu(path)


def _receive(data: bytes) -> None:
    """MAVLink bytes through the edge and the node of the link."""
    loopback = Loopback()
    edge = MavlinkEdge(LinkSection(), loopback, lambda: UNIX_NS)
    shell = InProcessShell({"link": LinkNode(10.0)}, lambda _, __: None, edges={"link": edge})
    for start in range(0, len(data), 512):
        loopback.to_companion(data[start : start + 512])
        shell.step(20_000_000 * (1 + start // 512))


class _Response(io.BytesIO):
    """What http.client gives for the body of a stream."""


def _stream(data: bytes) -> None:
    capture = MjpegCapture.__new__(MjpegCapture)
    capture.stamp_ns, capture._jpeg, capture._at_part = None, b"", False
    capture._response, capture._boundary = _Response(data), b"--frame"  # type: ignore[assignment]
    while capture.grab():
        capture.retrieve()


def _streams() -> list[bytes]:
    jpeg = _images()[0]
    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\nX-Timestamp-Ns: 12\r\n\r\n".encode()
    return [(head + jpeg + b"\r\n") * 3, (b"--frame\r\n\r\n" + jpeg + b"\r\n") * 3]


def _missions() -> list[bytes]:
    lines = [
        "QGC WPL 110",
        "0\t1\t0\t16\t0\t0\t0\t0\t48.0\t11.0\t500\t1",
        "1\t0\t3\t22\t0\t0\t0\t0\t0\t0\t60\t1",
        "2\t0\t3\t16\t0\t0\t0\t0\t48.001\t11.0\t60\t1",
        "3\t0\t3\t21\t0\t0\t0\t0\t48.001\t11.0\t0\t1",
    ]
    item = '{"type":"SimpleItem","command":16,"frame":3,"params":[0,0,0,0,48.0,11.0,60]}'
    plan = f'{{"fileType":"Plan","mission":{{"plannedHomePosition":[48.0,11.0,500],"items":[{item}]}}}}'
    return ["\n".join(lines).encode(), plan.encode()]


def _courses() -> list[bytes]:
    """Waypoint files of both versions with commands of all kinds, and plans."""
    rows = [f"{i}\t0\t3\t{command}\t1\t0\t0\t0\t48.01\t11.0\t60\t1" for i, command in enumerate(COMMANDS)]
    text = "\n".join(["0\t1\t0\t16\t0\t0\t0\t0\t48.0\t11.0\t500\t1", "# a comment", *rows])
    old = (
        '{"type":"missionItem","command":16,"frame":3,"param1":0,"param2":0,"param3":0,"param4":0,"coordinate":[1,2,3]}'
    )
    mission = f'{{"plannedHomePosition":{{"coordinate":[48.0,11.0,500]}},"items":[{old}]}}'
    return [*(f"QGC WPL {version}\n{text}".encode() for version in (110, 120)), mission.encode(), *_missions()]


def _kml() -> list[bytes]:
    """A KML in two encodings, and as an archive."""
    ring = "<LinearRing><coordinates>14.3,48.1,0 14.4,48.1,0 14.4,48.2,0</coordinates></LinearRing>"
    body = f"<Polygon><outerBoundaryIs>{ring}</outerBoundaryIs></Polygon><Point><coordinates>1,2</coordinates></Point>"
    track = "<gx:Track><gx:coord>14.3 48.1 300</gx:coord><gx:coord>14.4 48.2 300</gx:coord></gx:Track>"
    head = (
        '<?xml version="1.0" encoding="{}"?><kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://g"><Document>'
    )
    documents = [
        (head.format(name) + body + track + "</Document></kml>").encode(name)
        for name in ("UTF-8", "UTF-16", "ISO-8859-1")
    ]
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("doc.kml", documents[0])
    return [*documents, archive.getvalue()]


@cache
def _tile_files() -> list[bytes]:
    """A small MBTiles file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "t.mbtiles"
        db = sqlite3.connect(path)
        db.execute("PRAGMA page_size = 512")
        db.execute("CREATE TABLE metadata (name TEXT, value TEXT)")
        db.execute("CREATE TABLE tiles (zoom_level INT, tile_column INT, tile_row INT, tile_data BLOB)")
        db.executemany("INSERT INTO metadata VALUES (?, ?)", [("bounds", "14.3,48.1,14.4,48.2"), ("scheme", "xyz")])
        db.executemany("INSERT INTO tiles VALUES (10, 552, ?, ?)", [(355, b"one"), (356, b"two")])
        db.commit()
        db.close()
        return [path.read_bytes()]


def _read_tiles(path: Path) -> None:
    reader = MbtilesReader(path)
    try:
        for row in (355, 356):
            reader.get(Tile(10, 552, row))
        reader.first(reader.zooms[-1])
    finally:
        reader.close()


@cache
def _elevations() -> list[bytes]:
    """Small elevation models: feet by unit, by vertical system, with scale and offset."""
    import rasterio
    from rasterio.transform import Affine

    profile = {"driver": "GTiff", "width": 8, "height": 8, "count": 1, "transform": Affine(10, 0, 3e5, 0, -10, 5e6)}
    found = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "d.tif"
        for crs, unit, scale in (("EPSG:32632", "US survey foot", 0.1), ("EPSG:32632+6360", "", 1.0)):
            with rasterio.open(path, "w", crs=crs, dtype="int16", nodata=-99, **profile) as file:
                file.write(np.full((1, 8, 8), 500, np.int16))
                file.scales, file.offsets, file.units = (scale,), (10.0,), (unit,)
            found.append(path.read_bytes())
    return found


def _read_elevation(path: Path) -> None:
    with open_raster(path) as file:
        heights = heights_of(file, str(path))
        height_statement(file, path, heights, crs_of(file, path), (3e5, 5e6))


def _gopro_payload() -> bytes:
    """Device, name and streams of one payload of a GoPro; GPMF as its reference describes it."""

    def item(key: str, kind: str, size: int, count: int, values: bytes) -> bytes:
        head = key.encode() + struct.pack(">cBH", kind.encode(), size, count)
        return head + values + b"\0" * (-len(values) % 4)

    fixes = b"".join(struct.pack(">5i", 480_000_000 + 10 * k, 110_000_000, 500_000, 1000, 100) for k in range(10))
    scales = struct.pack(">5i", 10_000_000, 10_000_000, 1000, 1000, 100)
    gps = item("GPSF", "L", 4, 1, struct.pack(">I", 3)) + item("SCAL", "l", 4, 5, scales)
    gps += item("GPS5", "l", 20, 10, fixes)
    accelerations = item("SCAL", "s", 2, 1, struct.pack(">h", 418)) + item("ACCL", "s", 6, 4, bytes(24))
    streams = b"".join(item("STRM", "\0", 1, len(one), one) for one in (gps, accelerations))
    device = item("DVNM", "c", 1, 12, b"HERO10 Black") + streams
    return item("DEVC", "\0", 1, len(device), device)


def gopro_video(head: bytes = b"", payloads: int = 3, moov: bytes = b"") -> bytes:
    """An MP4 with a track of GoPro's telemetry, a payload a second, after ``head``; ``moov``: further tracks."""

    def box(kind: bytes, *parts: bytes) -> bytes:
        content = b"".join(parts)
        return struct.pack(">I4s", 8 + len(content), kind) + content

    payload = _gopro_payload()
    media = box(b"mdat", payload * payloads)
    first = len(head) + 8
    places = struct.pack(f">II{payloads}I", 0, payloads, *(first + len(payload) * k for k in range(payloads)))
    table = box(
        b"stbl",
        box(b"stsd", struct.pack(">III4s", 0, 1, 16, b"gpmd")),
        box(b"stts", struct.pack(">IIII", 0, 1, payloads, 1000)),
        box(b"stsc", struct.pack(">IIIII", 0, 1, 1, 1, 1)),
        box(b"stsz", struct.pack(">III", 0, len(payload), payloads)),
        box(b"stco", places),
    )
    clock = box(b"mdhd", struct.pack(">IIIII", 0, 0, 0, 1000, 1000 * payloads))
    return head + media + box(b"moov", moov, box(b"trak", box(b"mdia", clock, box(b"minf", table))))


def _start(data: bytes) -> None:
    parse_start(data.decode("utf-8", "replace"))


def _image(data: bytes) -> None:
    for by in (1, 2):
        decode_image(data, WIDTH, HEIGHT, by)


TARGETS: tuple[Target, ...] = (
    Target("mavlink", lambda: _telemetry()[0], _receive),
    Target("telemetry log", _logs, _in_file(".tlog", _read_log)),
    Target("configuration", _configs, _in_file(".toml", lambda path: load_config([path]))),
    Target("description", _descriptions, _in_file(".toml", read_description)),
    Target("frames.csv", _tables, _in_file(".csv", lambda path: read_table(path, "frames.csv", with_file=True))),
    Target("image", _images, _image),
    Target("photo", _photos, _in_file(".jpg", read_info)),
    Target("photo tags", _xmp_packets, read_xmp),
    Target("stream", _streams, _stream),
    Target("record", _records, _in_file(".mcap", _read_record)),
    Target("map", _maps, _in_file(".gpkg", _read_map)),
    Target("mission", _missions, _in_file(".waypoints", read_mission)),
    Target("plan", _missions, _in_file(".plan", read_mission)),
    Target("course", _courses, _in_file(".waypoints", lambda path: read_mission(path, course_only=True))),
    Target("area", _kml, _in_file(".kml", lambda path: read_area(str(path), corridor_km=1.0))),
    Target("tile file", _tile_files, _in_file(".mbtiles", _read_tiles)),
    Target("elevation", _elevations, _in_file(".tif", _read_elevation)),
    Target("GoPro telemetry", lambda: [gopro_video(), _gopro_payload()], _in_file(".mp4", read_gpmf)),
    Target("DataFlash log", _dataflash_logs, _in_file(".bin", read_autopilot_log)),
    Target("autopilot log", _logs, _in_file(".tlog", read_autopilot_log)),
    Target("start", lambda: [b"48.1,11.2"], _start),
)


def refused_or_read(target: Target, data: bytes) -> None:
    """Runs a target. Raises what is a bug."""
    with suppress(TerrafixError):
        target.run(data)
