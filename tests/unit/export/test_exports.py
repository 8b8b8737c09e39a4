"""`terrafix log export`: each format is read back by another library, or by its reader rebuilt here, with the same
numbers. pycolmap, evo, gpxpy and rosbags are used where they are installed."""

import csv
import io
import json
import math
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyogrio
import pytest
from PIL import Image
from pyproj import Transformer
from typer.testing import CliRunner, Result

from flight_records import ORIGIN, PERIOD_NS, estimate, frame, write_record
from origins import origin_of
from terrafix import messages as m
from terrafix.core.camera import CameraCalibration, Mount
from terrafix.core.errors import OutputError, SourceError, TerrafixError, UsageError
from terrafix.core.geodesy import quat_from_rot, rot_w_b
from terrafix.vision.sources.exif import read_info
from terrafix_tools.cli import app
from terrafix_tools.estimates import numbers
from terrafix_tools.export.formats import FORMATS, export
from terrafix_tools.export.geotag import tagged
from terrafix_tools.export.track import read_track
from terrafix_tools.finalised import FinalRow
from terrafix_tools.finalised import write as write_finalised

CAMERA = m.Camera(
    width=64, height=48, fx=60.0, fy=61.0, cx=32.5, cy=22.25, distortion=(-0.1, 0.02, 0.001, -0.002, 0.004)
)
FRAMES, PLACED = 6, 5  # the first frame is not placed
NOON_S = 1_783_080_000
YAW, PITCH, ROLL = 30.0, 4.0, -7.0  # degrees, of the body that carries the camera
SIGMA_M = {"immediate": 4.0, "refined": 3.0, "finalised": 2.0}
EAST_M = {"immediate": 0.0, "refined": 3.0, "finalised": 5.0}
ALT_M = {"immediate": 600.0, "refined": 601.0, "finalised": 602.0}
TURN = {"immediate": 0.0, "refined": 1.0, "finalised": 2.0}  # degrees of heading


def rotation(kind: str) -> np.ndarray:
    """Camera into east, north, up."""
    body = rot_w_b(*(math.radians(angle) for angle in (YAW + TURN[kind], PITCH, ROLL)))
    return np.asarray(body @ Mount().r_b_c())


def place(kind: str, i: int) -> tuple[float, float, float]:
    lat_deg, lon_deg = ORIGIN.to_wgs84(20.0 * i + EAST_M[kind], 7.0 * i)
    return lat_deg, lon_deg, ALT_M[kind]


def cov(kind: str) -> tuple[float, ...]:
    variances = [SIGMA_M[kind] ** 2, SIGMA_M[kind] ** 2, 9.0, 1e-4, 2e-4, 3e-4]
    return tuple(np.diag(variances).ravel().tolist())


def _pose(kind: str, i: int) -> FinalRow:
    lat_deg, lon_deg, alt_m = place(kind, i)
    q_w_c = numbers(quat_from_rot(rotation(kind)))
    sigma_m = SIGMA_M[kind]
    return FinalRow(
        f"DJI_{i}.jpg", i * PERIOD_NS / 1e9, lat_deg, lon_deg, alt_m, sigma_m, sigma_m, 0.0, 3.0, YAW + TURN[kind],
        q_w_c, numbers(cov(kind)),
    )  # fmt: skip


def _messages() -> list[m.Message]:
    found: list[m.Message] = [origin_of(CAMERA)]
    found.append(m.WallClock(t_ns=0, unix_ns=NOON_S * 10**9, source="autopilot"))
    for i in range(FRAMES):
        found.append(frame(i, f"DJI_{i}.jpg"))
        lat_deg, lon_deg, alt_m = place("immediate", i)
        q_w_b = quat_from_rot(rotation("immediate") @ Mount().r_b_c().T)
        flown = msgspec.structs.replace(
            estimate(i, 0.0, 0.0), lat_deg=lat_deg, lon_deg=lon_deg, alt_amsl_m=alt_m, q_w_b=q_w_b, cov=cov("immediate")
        )
        found.append(flown if i else msgspec.structs.replace(flown, source_label=m.SourceLabel.NOT_PLACED))
    found.append(m.Refinement(t_ns=FRAMES * PERIOD_NS, poses=[_pose("refined", i).pose(i) for i in range(1, FRAMES)]))
    return found


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight that was not finalised, called "river"."""
    folder = tmp_path_factory.mktemp("exports") / "river"
    folder.mkdir()
    write_record(folder / "flight-000.mcap", _messages())
    return folder


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same flight, finalised."""
    folder = tmp_path_factory.mktemp("exports") / "river"
    folder.mkdir()
    write_record(folder / "flight-000.mcap", _messages())
    rows = [FinalRow("DJI_0.jpg", 0.0), *(_pose("finalised", i) for i in range(1, FRAMES))]
    write_finalised(folder, rows, {"flights": []})
    return folder


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The photos of the flight at twice the size at which it read them."""
    folder = tmp_path_factory.mktemp("photos")
    for i in range(FRAMES):
        (folder / f"DJI_{i}.jpg").write_bytes(photo())
    return folder


def photo(size: tuple[int, int] = (128, 96), **exif_of: Any) -> bytes:
    """A JPEG with EXIF (with a maker note) and XMP as a drone writes them, at a place that is not the flight's."""
    image = Image.effect_noise(size, 40).convert("RGB")
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "DJI", "FC300X"
    exif.get_ifd(0x8769).update({0x9003: "2026:07:03 12:00:00", 0x927C: b"maker note" * 9})
    exif.get_ifd(0x8825).update({1: "N", 2: (1.0, 2.0, 3.0), 3: "E", 4: (4.0, 5.0, 6.0)} if not exif_of else {})
    xmp = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" drone-dji:GpsLatitude="+1.5" '
        'drone-dji:RelativeAltitude="+80.0" drone-dji:AbsoluteAltitude="+11.0"/></rdf:RDF></x:xmpmeta>'
    )
    out = io.BytesIO()
    image.save(out, "jpeg", exif=exif.tobytes(), xmp=xmp.encode())
    return out.getvalue()


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["log", "export", *(str(argument) for argument in arguments)])


@dataclass
class Read:
    """What a reader has found of a frame; NaN: the format has it not."""

    name: str
    lat_deg: float
    lon_deg: float
    alt_m: float
    r_w_c: np.ndarray | None = None
    sigma_h_m: float = math.nan


def local(e_m: float, n_m: float, u_m: float) -> tuple[float, float, float]:
    return (*ORIGIN.to_wgs84(e_m, n_m), u_m)


def opensfm_rotation(omega: float, phi: float, kappa: float) -> np.ndarray:
    """Camera into the world, by the definition of OpenSfM (opensfm/geometry.py: rotation_from_opk), degrees."""
    w, p, k = np.radians([omega, phi, kappa])
    rw = np.array([[1, 0, 0], [0, np.cos(w), np.sin(w)], [0, -np.sin(w), np.cos(w)]])
    rp = np.array([[np.cos(p), 0, -np.sin(p)], [0, 1, 0], [np.sin(p), 0, np.cos(p)]])
    rk = np.array([[np.cos(k), np.sin(k), 0], [-np.sin(k), np.cos(k), 0], [0, 0, 1]])
    return np.asarray((np.diag([1, -1, -1]) @ rk @ rp @ rw).T)


def odm(path: Path) -> list[Read]:
    """As ODM's GeoFile reads it (opendm/geo.py): columns between spaces, by position."""
    first, *lines = path.read_text().splitlines()
    assert first == "EPSG:4326"
    found = []
    for line in lines:
        parts = line.split()
        lon_deg, lat_deg, alt_m, yaw, pitch, roll, horizontal, _vertical = (float(part) for part in parts[1:9])
        body = rot_w_b(*(math.radians(angle) for angle in (yaw, pitch, roll)))
        assert len(parts) == 9
        # compute_opk of opendm/photo.py: the image axes in those of the body, top to the nose, camera down
        image = body @ np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
        found.append(Read(parts[0], lat_deg, lon_deg, alt_m, image @ np.diag([1, -1, -1]), horizontal))
    return found


def pix4d(path: Path) -> list[Read]:
    with path.open() as stream:
        _, *rows = csv.reader(stream)
    return [
        Read(name, float(lat), float(lon), float(alt), opensfm_rotation(*map(float, opk)), float(horizontal))
        for name, lat, lon, alt, *opk, horizontal, _vertical in rows
    ]


def metashape(path: Path) -> list[Read]:
    with path.open() as stream:
        rows = list(csv.DictReader(stream))
    return [
        Read(
            row["#Label"],
            float(row["Y/Latitude"]),
            float(row["X/Longitude"]),
            float(row["Z/Altitude"]),
            opensfm_rotation(*(float(row[key]) for key in ("Omega", "Phi", "Kappa"))),
            float(row["X_accuracy"]),
        )
        for row in rows
    ]


def rotation_of(w: float, x: float, y: float, z: float) -> np.ndarray:
    """Of a unit quaternion, by its action on the axes (Hamilton's product)."""
    v = np.array([x, y, z])
    return np.column_stack([a + 2 * w * np.cross(v, a) + 2 * np.cross(v, np.cross(v, a)) for a in np.eye(3)])


def tum(path: Path) -> list[Read]:
    found = []
    for i, line in enumerate(path.read_text().splitlines(), 1):
        t_s, e_m, n_m, u_m, x, y, z, w = map(float, line.split())
        assert t_s == pytest.approx(NOON_S + i * PERIOD_NS / 1e9)
        found.append(Read(f"DJI_{i}.jpg", *local(e_m, n_m, u_m), rotation_of(w, x, y, z)))
    return found


def kitti(path: Path) -> list[Read]:
    found = []
    for i, line in enumerate(path.read_text().splitlines(), 1):
        matrix = np.array([float(value) for value in line.split()]).reshape(3, 4)
        found.append(Read(f"DJI_{i}.jpg", *local(*matrix[:, 3]), matrix[:, :3]))
    return found


def colmap(folder: Path) -> list[Read]:
    """The text model as colmap.github.io/format.html defines it: two lines an image, the second of features."""
    lines = [line for line in (folder / "images.txt").read_text().split("\n") if not line.startswith("#")]
    found = []
    for line in lines[0::2]:
        if line:
            _number, w, x, y, z, tx, ty, tz, _camera, name = line.split()
            r_c_w = rotation_of(float(w), float(x), float(y), float(z))
            found.append(Read(name, *local(*(-r_c_w.T @ np.array([float(tx), float(ty), float(tz)]))), r_c_w.T))
    return found


def opensfm(path: Path) -> list[Read]:
    """Shot: axis and angle of world to camera; topocentric about reference_lla."""
    (whole,) = json.loads(path.read_text())
    reference = whole["reference_lla"]
    to_lla = Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0={reference['latitude']} "
        f"+lon_0={reference['longitude']} +h_0={reference['altitude']} +step +inv +proj=cart +ellps=WGS84 "
        "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    found = []
    for name, shot in whole["shots"].items():
        axis = np.array(shot["rotation"])
        half = np.linalg.norm(axis) / 2
        r_c_w = rotation_of(math.cos(half), *(math.sin(half) * axis / np.linalg.norm(axis)))
        lon_deg, lat_deg, alt_m = to_lla.transform(*(-r_c_w.T @ np.array(shot["translation"])))
        found.append(Read(name, lat_deg, lon_deg, alt_m, r_c_w.T, shot["gps_dop"]))
    return found


def gdal(path: Path, layer: str | None = None, name: str = "name") -> list[Read]:
    meta, _, geometry, values = pyogrio.raw.read(path, layer=layer)
    columns = dict(zip((str(field) for field in meta["fields"]), values, strict=True))
    points = [np.frombuffer(shape, "<f8", -1, 5) for shape in geometry]
    if "ele" in columns:  # of GPX: GDAL has the height as a field
        points = [np.array([*point, height]) for point, height in zip(points, columns["ele"], strict=True)]
    return [
        Read(str(label), lat_deg, lon_deg, alt_m)
        for label, (lon_deg, lat_deg, alt_m) in zip(columns[name], points, strict=True)
    ]


def exif(folder: Path) -> list[Read]:
    """By Pillow, from the EXIF of each copy."""
    found = []
    for path in sorted(folder.iterdir()):
        with Image.open(path) as image:
            gps = image.getexif().get_ifd(0x8825)
            image.load()
        lat, lon = ([float(part) for part in gps[key]] for key in (2, 4))
        assert (gps[1], gps[3], gps[5]) == ("N", "E", b"\0")
        degrees = [a + b / 60 + c / 3600 for a, b, c in (lat, lon)]
        found.append(Read(path.name, degrees[0], degrees[1], float(gps[6]), None, float(gps[31])))
    return found


READERS: dict[str, tuple[str, Callable[[Path], list[Read]]]] = {
    "odm": ("geo.txt", odm),
    "pix4d": ("pix4d.csv", pix4d),
    "metashape": ("metashape.csv", metashape),
    "tum": ("track.tum", tum),
    "kitti": ("track.kitti", kitti),
    "colmap": ("model", colmap),
    "opensfm": ("reconstruction.json", opensfm),
    "gpx": ("track.gpx", lambda path: gdal(path, "track_points")),
    "kml": ("track.kml", lambda path: gdal(path, "frames", "Name")),
    "shp": ("track.shp", lambda path: gdal(path, name="file")),
    "gpkg": ("track.gpkg", lambda path: gdal(path, "frames", "file")),
    "geojson": ("track.geojson", lambda path: gdal(path, name="file")),
    "photos": ("tagged", exif),
}


@pytest.mark.parametrize(("name", "kind"), [*((name, "finalised") for name in READERS), ("odm", "immediate")])
def test_another_reader_finds_names_positions_and_orientations(
    finished: Path, photos: Path, tmp_path: Path, name: str, kind: str
) -> None:
    file, reader = READERS[name]
    result = call(finished, tmp_path / file, "--format", name, "--which", kind, "--photos", photos)
    assert result.exception is None, result.exception
    assert result.output == f"{PLACED} positions ({kind}); written to {tmp_path / file}\n"
    found = reader(tmp_path / file)
    assert [read.name for read in found] == [f"DJI_{i}.jpg" for i in range(1, FRAMES)]
    for i, read in enumerate(found, 1):
        lat_deg, lon_deg, alt_m = place(kind, i)
        assert (read.lat_deg, read.lon_deg) == pytest.approx((lat_deg, lon_deg), abs=2e-8)  # 2 mm
        assert read.alt_m == pytest.approx(alt_m, abs=0.002)
        if read.r_w_c is not None:
            assert read.r_w_c == pytest.approx(rotation(kind), abs=1e-5)
        if not math.isnan(read.sigma_h_m):
            assert read.sigma_h_m == pytest.approx(SIGMA_M[kind], abs=1e-3)


def test_every_format_is_read_by_a_test() -> None:
    others = {"csv", "parquet", "kmz", "rosbag", "waypoints"}  # by tests of their own
    assert set(READERS) | others == set(FORMATS)


def test_without_a_choice_the_best_positions_are_exported(flown: Path, finished: Path, tmp_path: Path) -> None:
    for folder, kind in ((flown, "refined"), (finished, "finalised")):
        call(folder, tmp_path / "track.csv")
        with (tmp_path / "track.csv").open() as stream:
            rows = list(csv.DictReader(stream))
        assert [row["which"] for row in rows] == [kind] * PLACED
        assert float(rows[0]["lon_deg"]) == pytest.approx(place(kind, 1)[1], abs=1e-8)
        assert float(rows[0]["sigma_e_m"]) == SIGMA_M[kind] and float(rows[0]["sigma_u_m"]) == 3.0
        assert rows[0]["time_utc"].startswith("2026-07-03T12:00:00.5")


def test_a_frame_that_finalise_could_not_place_is_not_exported(finished: Path) -> None:
    assert "DJI_0.jpg" not in [pose.name for pose in read_track(finished).poses]


@pytest.mark.parametrize(
    ("arguments", "kind", "words"),
    [
        (("track.xyz",), UsageError, "give --format with one of csv, parquet"),
        (("track.csv", "--format", "dwg"), UsageError, "--format dwg; give --format with one of"),
        (("track.csv", "--which", "final"), UsageError, "choose one of best, finalised, refined, immediate"),
        (("track.csv", "--which", "finalised"), SourceError, "terrafix finalise"),
        (("tagged", "--format", "photos"), UsageError, "--photos"),
        (("tagged", "--format", "photos", "--photos", "nowhere"), SourceError, "DJI_1.jpg is not there"),
        (("none/track.tum",), OutputError, "check the folder"),
        (("none/track.shp",), OutputError, "check the folder"),
    ],
)
def test_what_cannot_be_exported_is_one_line(
    flown: Path, tmp_path: Path, arguments: tuple[str, ...], kind: type[TerrafixError], words: str
) -> None:
    error = call(flown, tmp_path / arguments[0], *arguments[1:]).exception
    assert isinstance(error, kind) and words in str(error), error


def test_a_name_with_a_space_is_refused_where_spaces_separate_columns(flown: Path, tmp_path: Path) -> None:
    named = [msgspec.structs.replace(x, file="a b.jpg") if isinstance(x, m.Frame) else x for x in _messages()[:9]]
    write_record(tmp_path / "flight.mcap", named)
    with pytest.raises(UsageError, match=r"'a b.jpg': this format separates"):
        export(tmp_path / "flight.mcap", tmp_path / "geo.txt")


def test_an_existing_file_is_replaced_with_a_word_and_a_full_folder_not_at_all(flown: Path, tmp_path: Path) -> None:
    out = tmp_path / "track.gpx"
    assert "replaced" not in call(flown, out).output
    assert call(flown, out).output.endswith(f"written to {out}, which was replaced\n")
    assert isinstance(call(flown, tmp_path, "--format", "colmap").exception, UsageError)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["track.gpx"]


def test_colmap_projects_a_point_of_the_ground_to_the_pixel_of_our_camera(
    flown: Path, photos: Path, tmp_path: Path
) -> None:
    """COLMAP's FULL_OPENCV (src/colmap/sensor/models.h), whose first pixel is at 0.5, 0.5."""
    call(flown, tmp_path / "model", "--format", "colmap", "--photos", photos)
    _number, model, width, height, *parameters = (tmp_path / "model" / "cameras.txt").read_text().split()
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6 = map(float, parameters)
    assert (model, width, height) == ("FULL_OPENCV", "128", "96") and k4 == k5 == k6 == 0.0
    u, v = 0.2, -0.15
    r2 = u * u + v * v
    radial = k1 * r2 + k2 * r2**2 + k3 * r2**3
    x = u + u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    y = v + v * radial + 2 * p2 * u * v + p1 * (r2 + 2 * v * v)
    ours = CameraCalibration.of(CAMERA).scaled(2.0).project(np.array([[u, v, 1.0]]))[0]
    assert (fx * x + cx - 0.5, fy * y + cy - 0.5) == pytest.approx(tuple(ours), abs=1e-6)


def test_opensfm_projects_a_point_to_the_pixel_of_our_camera(flown: Path, tmp_path: Path) -> None:
    """OpenSfM's "brown": coordinates from the middle of the image, in lengths of its longer side."""
    call(flown, tmp_path / "reconstruction.json")
    (camera,) = json.loads((tmp_path / "reconstruction.json").read_text())[0]["cameras"].values()
    u, v = 0.2, -0.15
    r2 = u * u + v * v
    radial = 1 + r2 * (camera["k1"] + r2 * (camera["k2"] + r2 * camera["k3"]))
    x = u * radial + 2 * camera["p1"] * u * v + camera["p2"] * (r2 + 2 * u * u)
    y = v * radial + 2 * camera["p2"] * u * v + camera["p1"] * (r2 + 2 * v * v)
    size = max(camera["width"], camera["height"])
    px = (camera["focal_x"] * x + camera["c_x"]) * size + camera["width"] / 2 - 0.5
    py = (camera["focal_y"] * y + camera["c_y"]) * size + camera["height"] / 2 - 0.5
    ours = CameraCalibration.of(CAMERA).project(np.array([[u, v, 1.0]]))[0]
    assert (px, py) == pytest.approx(tuple(ours), abs=1e-6)


def test_photos_of_another_size_are_not_those_of_the_flight(flown: Path, tmp_path: Path) -> None:
    (tmp_path / "DJI_1.jpg").write_bytes(photo((100, 96)))
    error = call(flown, tmp_path / "model", "--format", "colmap", "--photos", tmp_path).exception
    assert isinstance(error, SourceError) and "100x96 px, and the flight used images of 64x48" in str(error)


def test_kml_has_a_track_that_google_earth_plays_and_styles_by_source(flown: Path, tmp_path: Path) -> None:
    call(flown, tmp_path / "track.kmz", "--which", "immediate")
    root = ElementTree.fromstring(zipfile.ZipFile(tmp_path / "track.kmz").read("doc.kml"))
    space = {"k": "http://www.opengis.net/kml/2.2", "gx": "http://www.google.com/kml/ext/2.2"}
    assert root.findtext("k:Document/k:name", namespaces=space) == "river"
    timed = root.find(".//gx:Track", space)
    assert timed is not None
    when = [element.text for element in timed.findall("k:when", space)]
    coords = [element.text or "" for element in timed.findall("gx:coord", space)]
    assert len(when) == len(coords) == PLACED and when[0] == "2026-07-03T12:00:00.500+00:00"
    assert [float(value) for value in coords[0].split()] == pytest.approx(
        [place("immediate", 1)[1], place("immediate", 1)[0], 600.0], abs=1e-7
    )
    styles = {f"#{style.get('id')}" for style in root.findall(".//k:Style", space)}
    used = {element.text for element in root.findall(".//k:styleUrl", space)}
    assert "#satellite_anchored" in used and used <= styles


def test_a_tagged_photo_keeps_its_pixels_its_maker_note_and_the_rest_of_its_exif(flown: Path) -> None:
    pose = read_track(flown).poses[0]
    for before in (photo(), photo(without_gps=True)):
        after = tagged(before, pose, "a.jpg")
        at = before.index(b"\xff\xdb")  # quantisation tables: from here on the picture
        assert after.endswith(before[at:])
        with Image.open(io.BytesIO(after)) as image, Image.open(io.BytesIO(before)) as old:
            new_tags, old_tags = image.getexif(), old.getexif()
            assert new_tags[0x0110] == old_tags[0x0110] == "FC300X"
            assert new_tags.get_ifd(0x8769) == old_tags.get_ifd(0x8769)
            xmp = image.info["xmp"].decode()
        block = after.index(b"Exif\0\0") + 6
        assert after.index(b"maker note") - block == before.index(b"maker note") - before.index(b"Exif\0\0") - 6
        assert f'drone-dji:GpsLatitude="{pose.lat_deg:+.8f}"' in xmp and 'AbsoluteAltitude="601.000"' in xmp
        assert 'Camera:GPSXYAccuracy="3.000" Camera:GPSZAccuracy="3.000"' in xmp
        ElementTree.fromstring(xmp)
        assert 'RelativeAltitude="+80.0"' in xmp


def test_our_own_reader_takes_the_position_of_a_tagged_photo(flown: Path, tmp_path: Path) -> None:
    pose = read_track(flown).poses[0]
    (tmp_path / "a.jpg").write_bytes(tagged(photo(), pose, "a.jpg"))
    info = read_info(tmp_path / "a.jpg")
    assert info is not None and info.xmp.agl_m == 80.0
    assert (info.lat_deg, info.lon_deg) == pytest.approx((pose.lat_deg, pose.lon_deg), abs=1e-9)


@pytest.mark.parametrize(
    "data", [b"\xff\xd8\xff\xe1\x40\x00Exif", b"\xff\xd8\xff\xe1\x00\x0cExif\0\0XX\0\0" + b"\xff\xd9"]
)
def test_a_damaged_photo_is_refused_in_one_line(flown: Path, data: bytes) -> None:
    with pytest.raises(SourceError, match=r"^a.jpg: "):
        tagged(data, read_track(flown).poses[0], "a.jpg")


def test_a_position_without_a_height_has_none_in_any_format(tmp_path: Path) -> None:
    unknown = [msgspec.structs.replace(x, amsl_known=False) if isinstance(x, m.NavEstimate) else x for x in _messages()]
    folder = tmp_path / "flight.mcap"
    write_record(folder, unknown[:-1])
    export(folder, tmp_path / "geo.txt")
    assert [len(line.split()) for line in (tmp_path / "geo.txt").read_text().splitlines()[1:]] == [3] * PLACED
    export(folder, tmp_path / "p.csv", "pix4d")
    with (tmp_path / "p.csv").open() as stream:
        assert {row[3] for row in list(csv.reader(stream))[1:]} == {""}
    export(folder, tmp_path / "t.kitti")  # above the ground, so that the shape of the flight stays
    assert {line.split()[-1] for line in (tmp_path / "t.kitti").read_text().splitlines()} == {"100.00000000"}
    export(folder, tmp_path / "t.gpx")
    assert "<ele>" not in (tmp_path / "t.gpx").read_text()
    data = tagged(photo(), read_track(folder).poses[0], "a.jpg")
    with Image.open(io.BytesIO(data)) as image:
        assert 6 not in image.getexif().get_ifd(0x8825)


def test_a_table_without_its_record_is_exported_without_orientations(tmp_path: Path) -> None:
    (tmp_path / "estimates.csv").write_text(
        "file,t_s,lat_deg,lon_deg,sigma_e_m,sigma_n_m,cov_en_m2\na.jpg,0,50,10,1,2,0\n"
    )
    export(tmp_path, tmp_path / "geo.txt")
    assert (tmp_path / "geo.txt").read_text().splitlines()[1] == "a.jpg 10.00000000 50.00000000"
    with pytest.raises(SourceError, match="no position has an orientation"):
        export(tmp_path, tmp_path / "t.tum")


def test_pycolmap_reads_the_model(flown: Path, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    call(flown, tmp_path / "model", "--format", "colmap")
    found = pycolmap.Reconstruction(tmp_path / "model")
    assert len(found.images) == PLACED
    for image in found.images.values():
        i = int(image.name[4])
        e_m, n_m = ORIGIN.to_local(*place("refined", i)[:2])
        assert image.projection_center() == pytest.approx((e_m, n_m, 601.0), abs=1e-3)


def test_evo_reads_the_trajectories(flown: Path, tmp_path: Path) -> None:
    evo = pytest.importorskip("evo.tools.file_interface")
    call(flown, tmp_path / "t.tum")
    call(flown, tmp_path / "t.kitti")
    timed, posed = evo.read_tum_trajectory_file(tmp_path / "t.tum"), evo.read_kitti_poses_file(tmp_path / "t.kitti")
    assert timed.num_poses == posed.num_poses == PLACED
    for trajectory in (timed, posed):
        assert trajectory.poses_se3[0][:3, :3] == pytest.approx(rotation("refined"), abs=1e-5)
        e_m, n_m = ORIGIN.to_local(*place("refined", 1)[:2])
        assert trajectory.positions_xyz[0] == pytest.approx((e_m, n_m, 601.0), abs=1e-3)


def test_gpxpy_reads_the_track(flown: Path, tmp_path: Path) -> None:
    gpxpy = pytest.importorskip("gpxpy")
    call(flown, tmp_path / "t.gpx")
    (track,) = gpxpy.parse((tmp_path / "t.gpx").read_text()).tracks
    points = track.segments[0].points
    assert track.name == "river" and [point.name for point in points] == [f"DJI_{i}.jpg" for i in range(1, FRAMES)]
    assert points[0].elevation == 601.0 and points[0].time.timestamp() == pytest.approx(NOON_S + 0.5)


def test_rosbags_reads_the_bag(flown: Path, tmp_path: Path) -> None:
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    typesys = pytest.importorskip("rosbags.typesys")
    assert call(flown, tmp_path / "bag", "--format", "rosbag").exception is None
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    found: dict[str, list[Any]] = {}
    with rosbag2.Reader(tmp_path / "bag") as reader:
        for connection, t_ns, data in reader.messages():
            found.setdefault(connection.topic, []).append((t_ns, store.deserialize_cdr(data, connection.msgtype)))
    fixes, poses = found["/terrafix/fix"], found["/terrafix/pose"]
    assert len(fixes) == len(poses) == PLACED and fixes[0][0] == round((NOON_S + 0.5) * 1e9)
    fix, pose = fixes[0][1], poses[0][1].pose
    assert (fix.latitude, fix.longitude, fix.altitude) == pytest.approx(place("refined", 1), abs=1e-8)
    assert fix.position_covariance[0] == pytest.approx(9.0) and fix.position_covariance_type == 3
    q = pose.pose.orientation
    assert rotation_of(q.w, q.x, q.y, q.z) == pytest.approx(rotation("refined"), abs=1e-5)
    assert pose.covariance == pytest.approx(np.array(cov("refined")), abs=1e-9)
