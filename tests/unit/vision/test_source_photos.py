"""Photos: order, focal length, heading, height and initial position from EXIF and XMP."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from source_folders import jpeg, picture
from terrafix.core.camera import Mount
from terrafix.core.errors import SourceError
from terrafix.core.geodesy import rot_w_b
from terrafix.core.initial_position import start_is_unknown
from terrafix.vision.sources import open_source
from terrafix.vision.sources.xmp import body_angles_from_gimbal

XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {} ></rdf:Description></rdf:RDF></x:xmpmeta>'
)
NADIR = 'drone-dji:RelativeAltitude="+80.5" drone-dji:GimbalYawDegree="-30.0" drone-dji:GimbalPitchDegree="-90.0"'


def photo(path: Path, seconds: int | None = 0, *, focal35: int | None = 24, gps: bool = True, xmp: str = NADIR) -> None:
    exif = Image.Exif()
    if seconds is not None:
        exif.get_ifd(0x8769)[0x9003] = f"2024:05:06 10:00:{seconds:02}"
    if focal35 is not None:
        exif.get_ifd(0x8769)[0xA405] = focal35
    if gps:
        exif.get_ifd(0x8825).update({1: "S", 2: (29.0, 30.0, 0.0), 3: "W", 4: (51.0, 15.0, 36.0)})
    Image.fromarray(picture(1)).save(path, exif=exif, xmp=XMP.format(xmp).encode())


def test_photos_provide_all_metadata(tmp_path: Path) -> None:
    photo(tmp_path / "b.jpg", 0)
    photo(tmp_path / "a.jpg", 7)
    source = open_source(str(tmp_path))
    origin = source.origin()
    assert (origin.lat_deg, origin.lon_deg) == pytest.approx((-29.5, -51.26))
    assert origin.camera.fx == pytest.approx(24 / 43.267 * 400, rel=1e-3)
    shots = list(source.shots())
    assert [(s.frame.file, s.frame.t_ns) for s in shots] == [("b.jpg", 0), ("a.jpg", 7 * 10**9)]
    state = shots[0].states[0]
    assert (state.yaw_rad, state.pitch_rad, state.roll_rad) == pytest.approx((math.radians(-30), 0, 0), abs=1e-9)
    assert (state.agl_m, state.source) == (80.5, "exif")
    assert not {"lat", "lon"} & {name[:3] for name in state.__struct_fields__}


def test_photos_of_one_second_are_distributed_in_it(tmp_path: Path) -> None:
    for name, second in (("a", 0), ("b", 0), ("c", 1), ("d", 1)):
        photo(tmp_path / f"{name}.jpg", second)
    assert [s.frame.t_ns for s in open_source(str(tmp_path)).shots()] == [0, 500_000_000, 10**9, 1_500_000_000]


def test_a_broken_photo_loses_one_frame_only(tmp_path: Path) -> None:
    for i in range(3):
        photo(tmp_path / f"{i}.jpg", i * 5)
    whole = (tmp_path / "1.jpg").read_bytes()
    (tmp_path / "1.jpg").write_bytes(whole[:40])
    shots = list(open_source(str(tmp_path)).shots())
    assert [s.frame.file for s in shots] == ["0.jpg", "1.jpg", "2.jpg"]
    assert [bool(s.frame.error) for s in shots] == [False, True, False]
    assert shots[0].frame.t_ns < shots[1].frame.t_ns < shots[2].frame.t_ns


def test_photos_without_coordinate_have_an_unknown_start_and_without_focal_length_are_an_error(tmp_path: Path) -> None:
    photo(tmp_path / "a.jpg", gps=False)
    assert start_is_unknown(open_source(str(tmp_path)).origin())
    assert open_source(str(tmp_path), start=(3.0, 4.0)).origin().lon_deg == 4.0
    (tmp_path / "a.jpg").write_bytes(jpeg(0))
    with pytest.raises(SourceError, match="no photo says its focal length"):
        open_source(str(tmp_path), start=(3.0, 4.0))
    written = "[camera]\nwidth=320\nheight=240\nfx=300\nfy=300\ncx=160\ncy=120\n[start]\nlat_deg=5\nlon_deg=6\n"
    (tmp_path / "flight.toml").write_text(written)
    source = open_source(str(tmp_path))
    assert (source.origin().camera.fx, source.origin().lat_deg) == (300.0, 5.0)
    assert [s.states for s in source.shots()] == [()]


def test_photos_without_times_are_ordered_by_name(tmp_path: Path) -> None:
    for name in ("2.jpg", "1.jpg"):
        photo(tmp_path / name, None)
    assert [(s.frame.file, s.frame.t_ns) for s in open_source(str(tmp_path)).shots()] == [
        ("1.jpg", 0),
        ("2.jpg", 10**9),
    ]


def test_a_folder_of_unreadable_photos_is_reported(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"nothing")
    with pytest.raises(SourceError, match="none of the 1 photos can be read"):
        open_source(str(tmp_path))


@pytest.mark.parametrize("gimbal", [(45.0, -90.0, 0.0), (45.0, -80.0, 0.0), (-120.0, -85.0, 4.0), (10.0, -90.0, 3.0)])
def test_the_virtual_body_attitude_points_the_camera_along_the_gimbal(gimbal: tuple[float, float, float]) -> None:
    """The camera looks along the gimbal's forward axis; its image top is opposite to the gimbal's down axis."""
    r_w_gimbal = rot_w_b(*(math.radians(angle) for angle in gimbal))
    r_w_b = rot_w_b(*body_angles_from_gimbal(*gimbal))
    r_w_c = r_w_b @ Mount().r_b_c()
    assert r_w_c[:, 2] == pytest.approx(r_w_gimbal[:, 0], abs=1e-9)
    assert r_w_c[:, 1] == pytest.approx(r_w_gimbal[:, 2], abs=1e-9)


def test_real_photos_are_read(data_set: Callable[[str], Path]) -> None:
    source = open_source(str(data_set("photos/brighton_beach")))
    assert source.origin().camera.fx == pytest.approx(3.61 / 6.17 * 4000 / 2)  # read at half their size
    assert (source.origin().lat_deg, source.origin().lon_deg) == pytest.approx((46.842607, -91.994560), abs=1e-6)
    shots = list(source.shots())
    assert [s.frame.t_ns for s in shots] == [0, 7 * 10**9]
    assert [s.states[0].agl_m for s in shots] == [39.8, 40.1]
    assert shots[0].states[0].yaw_rad == pytest.approx(math.radians(45.0))
    assert all(s.image is not None and s.image.shape == (1125, 2000, 3) for s in shots)
