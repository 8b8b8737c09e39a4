"""Photos as several makers write them: lens, zoom, size, attitude and height. Pillow writes the tags; the right values
follow from EXIF 2.32, the makers' descriptions and exiftool's names of their tags."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from source_folders import picture
from terrafix.core.errors import SourceError
from terrafix.vision.sources import open_source
from terrafix.vision.sources.exif import read_info
from terrafix.vision.sources.facts import facts_of

DJI, PIX4D, PARROT = (
    'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"',
    'xmlns:Camera="http://pix4d.com/camera/1.0/"',
    'xmlns:drone-parrot="http://www.parrot.com/drone-parrot/1.0/"',
)
WIDTH, HEIGHT, FOCAL_PX = 320, 240, 280.0
NADIR = {"GimbalYawDegree": "+30.00", "GimbalPitchDegree": "-90.00", "GimbalRollDegree": "+0.00"}
CALIBRATED = {
    "CalibratedFocalLength": f"{FOCAL_PX}", "CalibratedOpticalCenterX": "161.5", "CalibratedOpticalCenterY": "118.5"
}  # fmt: skip


def dji(**fields: str) -> str:
    return f"{DJI} " + " ".join(f'drone-dji:{key}="{value}"' for key, value in fields.items())


def pix4d(**fields: str) -> str:
    return f"{PIX4D} " + " ".join(f'Camera:{key}="{value}"' for key, value in fields.items())


def photo(path: Path, xmp: str = "", *, at_s: int = 0, size: tuple[int, int] = (WIDTH, HEIGHT), **tags: Any) -> Path:
    """``xmp``: attributes of its description. ``tags``: model, focal_mm, focal_35, zoom, exif_size, plane (px per
    mm)."""
    exif = Image.Exif()
    exif[0x0110] = tags.get("model", "FC3582")
    ifd = exif.get_ifd(0x8769)
    ifd[0x9003] = f"2024:06:01 10:{at_s // 60:02}:{at_s % 60:02}"
    for key, tag in {"focal_mm": 0x920A, "focal_35": 0xA405, "zoom": 0xA404}.items():
        if key in tags:
            ifd[tag] = tags[key]
    if "exif_size" in tags:
        ifd[0xA002], ifd[0xA003] = tags["exif_size"]
    if "plane" in tags:
        ifd[0xA20E], ifd[0xA210] = tags["plane"], 4
    packet = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f"<rdf:Description {xmp}/></rdf:RDF></x:xmpmeta>"
    )
    image = Image.fromarray(picture(at_s, *size))
    image.save(path, quality=90, exif=exif, xmp=packet.encode() if xmp else b"")
    return path


def lens(path: Path) -> tuple[float | None, tuple[float, float] | None, str]:
    info = read_info(path)
    assert info is not None
    return info.focal_px, info.lens.centre_px, info.lens.problem


@pytest.mark.parametrize("zoom", [0.0, 1.0, 1.4, 2.0, 4.0])
def test_the_digital_zoom_multiplies_the_focal_length_of_the_lens(zoom: float, tmp_path: Path) -> None:
    """Nor FocalLength, nor the calibration of DJI contains it. 0: there is none."""
    by = zoom or 1.0
    table = photo(tmp_path / "a.jpg", model="L1D-20c", focal_mm=10.26, zoom=zoom)
    assert lens(table)[0] == pytest.approx(10.26 / 13.2 * WIDTH * by)
    plane = photo(tmp_path / "b.jpg", focal_mm=8.0, plane=40.0, zoom=zoom)
    assert lens(plane)[0] == pytest.approx(320.0 * by)
    calibrated = photo(tmp_path / "c.jpg", dji(**CALIBRATED), zoom=zoom)
    assert lens(calibrated)[0] == pytest.approx(FOCAL_PX * by)


def test_a_zoom_with_the_35_mm_equivalent_alone_is_refused_since_makers_differ(tmp_path: Path) -> None:
    assert lens(photo(tmp_path / "a.jpg", focal_35=24, zoom=1.0))[0] == pytest.approx(24 / 43.267 * 400.0)
    photo(tmp_path / "a.jpg", focal_35=24, zoom=2.0)
    with pytest.raises(SourceError, match=r"digital zoom of 2.*FocalLengthIn35mmFilm alone.*write a flight.toml"):
        open_source(str(tmp_path))


@pytest.mark.parametrize(
    ("size", "exif_size", "factor"),
    [
        ((320, 240), (320, 240), 1.0),
        ((160, 120), (320, 240), 0.5),  # the sizes of the camera are kept in EXIF
        ((160, 120), (160, 120), 0.5),  # and here they are not: the principal point shows it
        ((80, 60), (80, 60), 0.25),
        ((640, 480), (640, 480), 2.0),
        ((107, 80), (320, 240), 1 / 3),
    ],
)
def test_calibration_and_principal_point_are_scaled_with_the_photo(
    size: tuple[int, int], exif_size: tuple[int, int], factor: float, tmp_path: Path
) -> None:
    path = photo(tmp_path / "a.jpg", dji(**CALIBRATED), size=size, exif_size=exif_size, focal_35=30)
    focal_px, centre_px, problem = lens(path)
    assert focal_px == pytest.approx(FOCAL_PX * factor, rel=0.01) and problem == ""
    if exif_size == (320, 240):
        expected = (162.0 * factor - 0.5, 119.0 * factor - 0.5)
        assert centre_px == pytest.approx(expected, abs=0.3)
    camera = open_source(str(tmp_path)).origin().camera
    assert (camera.cx, camera.cy) == pytest.approx((size[0] / 2, size[1] / 2), rel=0.03)


def test_a_photo_that_was_turned_by_a_quarter_keeps_its_focal_length(tmp_path: Path) -> None:
    path = photo(tmp_path / "a.jpg", dji(**CALIBRATED), size=(240, 320), exif_size=(320, 240))
    assert lens(path) == (FOCAL_PX, None, "")


@pytest.mark.parametrize(
    ("xmp", "tags", "says"),
    [
        (dji(**CALIBRATED), {"size": (240, 240), "exif_size": (320, 240)}, "the camera stored 320x240: it was cut"),
        (
            dji(**CALIBRATED),
            {"size": (160, 240), "exif_size": (160, 240)},
            "CalibratedOpticalCenter .* not near the middle",
        ),
        (dji(CalibratedFocalLength="280"), {"size": (160, 120), "focal_35": 30}, "FocalLengthIn35mmFilm is 139 px"),
        (dji(CalibratedFocalLength="2"), {}, "field of view of 178.6 degrees"),
        (dji(CalibratedFocalLength="28000"), {}, "field of view of 0.7 degrees"),
    ],
)
def test_a_calibration_of_another_size_or_lens_is_refused_with_the_reason(
    xmp: str, tags: dict[str, Any], says: str, tmp_path: Path
) -> None:
    photo(tmp_path / "a.jpg", xmp, **tags)
    with pytest.raises(SourceError, match=says):
        open_source(str(tmp_path))


def test_photos_of_two_lenses_are_refused_with_both_groups(tmp_path: Path) -> None:
    for i in range(4):
        photo(tmp_path / f"DJI_{i:04}_W.JPG", dji(**CALIBRATED, **NADIR), at_s=i, model="M3T")
        photo(
            tmp_path / f"DJI_{i:04}_Z.JPG", dji(**{**CALIBRATED, "CalibratedFocalLength": "1120"}), at_s=i, model="M3T"
        )
    match = r"4 photos like DJI_0000_W.JPG \(M3T, 320x240, focal length 280 px\) and 4 photos like DJI_0000_Z.* 1120 px"
    with pytest.raises(SourceError, match=match):
        open_source(str(tmp_path))
    (tmp_path / "flight.toml").write_text("[camera]\nwidth=320\nheight=240\nfx=280\nfy=280\ncx=160\ncy=120\n")
    with pytest.raises(SourceError, match="several lenses or zooms"):
        open_source(str(tmp_path))


def test_a_changing_zoom_is_several_lenses(tmp_path: Path) -> None:
    for i, zoom in enumerate((1.0, 1.0, 2.0, 2.0, 3.0)):
        photo(tmp_path / f"{i}.jpg", dji(**CALIBRATED), at_s=i, zoom=zoom)
    with pytest.raises(SourceError, match=r"several lenses or zooms.* and 1 more"):
        open_source(str(tmp_path))


def test_a_few_photos_of_another_lens_are_left_out_with_a_word(tmp_path: Path) -> None:
    for i in range(20):
        photo(
            tmp_path / f"{i:02}.jpg",
            dji(**{**CALIBRATED, **({"CalibratedFocalLength": "560"} if i == 0 else {})}),
            at_s=i,
        )
    source = open_source(str(tmp_path))
    assert source.origin().camera.fx == FOCAL_PX
    errors = [shot.frame.error for shot in source.shots()]
    assert errors[0].startswith("another lens: 00.jpg") and not any(errors[1:])


def test_zoomed_photos_whose_focal_length_is_not_clear_are_not_flown_as_the_others(tmp_path: Path) -> None:
    for i in range(20):
        photo(tmp_path / f"{i:02}.jpg", at_s=i, focal_35=24, zoom=2.0 if i == 7 else 1.0)
    errors = [shot.frame.error for shot in open_source(str(tmp_path)).shots()]
    assert errors[7].startswith("a lens that is not clear: has a digital zoom of 2") and not any(
        errors[:7] + errors[8:]
    )
    for i in range(5):
        photo(tmp_path / f"{i:02}.jpg", at_s=i, focal_35=24, zoom=2.0)
    with pytest.raises(SourceError, match=r"00.jpg and 5 more has a digital zoom of 2.*the other photos do not"):
        open_source(str(tmp_path))


def test_photos_that_were_all_cut_are_flown_with_a_described_camera(tmp_path: Path) -> None:
    for i in range(3):
        photo(tmp_path / f"{i}.jpg", dji(**CALIBRATED), at_s=i, size=(240, 240), exif_size=(320, 240))
    (tmp_path / "flight.toml").write_text("[camera]\nwidth=240\nheight=240\nfx=280\nfy=280\ncx=120\ncy=120\n")
    source = open_source(str(tmp_path))
    assert source.origin().camera.fx == 280.0 and not any(shot.frame.error for shot in source.shots())


def angles(path: Path) -> tuple[float, float, float] | None:
    """Yaw, pitch and roll of the virtual vehicle in degrees."""
    info = read_info(path)
    assert info is not None
    found = info.xmp.angles
    return None if found is None else (found.yaw_deg, found.pitch_deg, found.roll_deg)


@pytest.mark.parametrize(
    ("xmp", "expected"),
    [
        (dji(**NADIR), (30.0, 0.0, 0.0)),
        (dji(GimbalYawDegree="+30.00", GimbalPitchDegree="-80.00"), (30.0, 10.0, 0.0)),
        (dji(GimbalYawDegree="-150.00", GimbalPitchDegree="-90.00", GimbalRollDegree="+180.00"), (30.0, 0.0, 0.0)),
        (pix4d(Yaw="30.00", Pitch="0.00", Roll="0.00"), (30.0, 0.0, 0.0)),  # Pix4D: 0 looks down
        (pix4d(Yaw="30.00", Pitch="10.00", Roll="-2.00"), (30.0, 10.0, -2.0)),
        (pix4d(Yaw="3000/100", Pitch="-125/100", Roll="0/100"), (30.0, -1.25, 0.0)),  # MicaSense, FLIR
        (pix4d(Yaw="30.00", Pitch="-90.00", Roll="0.00"), (30.0, 0.0, 0.0)),  # Autel XL715: from the horizon
        (f'{PARROT} drone-parrot:CameraYawDegree="30" drone-parrot:CameraPitchDegree="-80"', (30.0, 10.0, 0.0)),
        ('xmlns:P="http://pix4d.com/camera/1.0/" P:Yaw="30" P:Pitch="2" P:Roll="1"', (30.0, 2.0, 1.0)),
        (dji(GimbalYawDegree="+0.00", GimbalPitchDegree="+0.00", GimbalRollDegree="+0.00"), None),
        (dji(GimbalYawDegree="0", GimbalPitchDegree="-0.0"), None),
        (dji(FlightYawDegree="+30.00"), None),
        ("", None),
    ],
)
def test_attitudes_of_several_makers_are_those_of_one_vehicle(
    xmp: str, expected: tuple[float, float, float] | None, tmp_path: Path
) -> None:
    found = angles(photo(tmp_path / "a.jpg", xmp, focal_35=24))
    if expected is None:
        assert found is None
    else:
        assert found is not None
        difference = [math.remainder(a - b, 360.0) for a, b in zip(found, expected, strict=True)]
        assert difference == pytest.approx([0.0] * 3, abs=1e-9)


def test_gimbal_angles_of_zero_leave_the_flights_heading_and_a_wide_mount(tmp_path: Path) -> None:
    for i in range(3):
        zeros = dict.fromkeys(NADIR, "+0.00")
        photo(
            tmp_path / f"{i}.jpg",
            dji(**CALIBRATED, **zeros, FlightYawDegree=f"{40 + i}", RelativeAltitude="+80.5"),
            at_s=i,
        )
    source = open_source(str(tmp_path))
    (state,) = next(iter(source.shots())).states
    assert state.yaw_rad == pytest.approx(math.radians(40)) and state.pitch_rad is None and state.agl_m == 80.5
    assert source.origin().camera.mount_tolerance_deg == 10.0
    assert any("gimbal angles of 0/0/0: not reported (3 photos)" in fact.text for fact in facts_of(source))


def test_a_stated_accuracy_of_the_tilt_replaces_that_of_photos(tmp_path: Path) -> None:
    for i in range(2):
        photo(tmp_path / f"{i}.jpg", dji(**CALIBRATED, **NADIR), at_s=i)
    assert open_source(str(tmp_path)).origin().attitude_sigma_deg == 9.0
    (tmp_path / "flight.toml").write_text("[telemetry]\nattitude_sigma_deg = 2.0\n")
    assert open_source(str(tmp_path)).origin().attitude_sigma_deg == 2.0


@pytest.mark.parametrize(("apart_deg", "sigma_deg"), [(0.0, 5.0), (29.0, 5.0), (47.0, 47.0), (-170.0, 170.0)])
def test_a_gimbal_yaw_far_from_that_of_the_flight_widens_the_heading(
    apart_deg: float, sigma_deg: float, tmp_path: Path
) -> None:
    for i, yaw_deg in enumerate((-175.0, 30.0, 100.0)):
        turned = {"GimbalYawDegree": f"{yaw_deg}", "FlightYawDegree": f"{math.remainder(yaw_deg + apart_deg, 360):.1f}"}
        photo(tmp_path / f"{i}.jpg", dji(**CALIBRATED, **{**NADIR, **turned}), at_s=i)
    source = open_source(str(tmp_path))
    assert source.origin().yaw_sigma_deg == pytest.approx(sigma_deg)
    (state,) = next(iter(source.shots())).states
    assert state.yaw_rad == pytest.approx(math.radians(-175.0))
    assert any("degrees apart in half of the photos" in f.text for f in facts_of(source)) == (sigma_deg > 5.0)


@pytest.mark.parametrize(
    ("xmp", "unknown"),
    [
        (dji(RelativeAltitude="+0.00", FlightYawDegree="+31.0"), "agl_m"),
        (dji(RelativeAltitude="+60.00", FlightYawDegree="+0.00"), "yaw_rad"),
        (pix4d(Yaw="0", Pitch="0", Roll="0", AboveGroundAltitude="60"), "yaw_rad"),
    ],
)
def test_what_is_exactly_zero_in_all_photos_is_not_reported(xmp: str, unknown: str, tmp_path: Path) -> None:
    for i in range(3):
        photo(tmp_path / f"{i}.jpg", xmp, at_s=i, focal_35=24)
    states = [state for shot in open_source(str(tmp_path)).shots() for state in shot.states]
    assert [getattr(state, unknown) for state in states] == [None] * 3
    assert all(state.agl_m == 60.0 for state in states if unknown != "agl_m")


def test_the_height_of_autel_and_pix4d_is_read(tmp_path: Path) -> None:
    photo(tmp_path / "a.jpg", pix4d(Yaw="10.0", Pitch="0.0", Roll="0.0", AboveGroundAltitude="119.50"), focal_35=24)
    (state,) = next(iter(open_source(str(tmp_path)).shots())).states
    assert state.agl_m == 119.5 and state.yaw_rad == pytest.approx(math.radians(10.0))


def test_the_calibrated_focal_length_of_pix4ds_tags_needs_the_size_of_a_pixel(tmp_path: Path) -> None:
    path = photo(tmp_path / "a.jpg", pix4d(PerspectiveFocalLength="5.43"), focal_mm=5.4, plane=50.0, focal_35=24)
    assert lens(path)[0] == pytest.approx(271.5)
    assert lens(photo(tmp_path / "b.jpg", pix4d(PerspectiveFocalLength="5.43"), focal_35=24))[0] == pytest.approx(
        221.9, abs=0.1
    )


def test_files_of_macos_and_windows_beside_photos_are_left_out(tmp_path: Path) -> None:
    for i in range(3):
        photo(tmp_path / f"DJI_{i:04}.JPG", dji(**CALIBRATED, **NADIR), at_s=i)
        (tmp_path / f"._DJI_{i:04}.JPG").write_bytes(bytes.fromhex("0005160700020000") + b"Mac OS X")
    (tmp_path / "Thumbs.db").write_bytes(b"\xd0\xcf\x11\xe0")
    (tmp_path / ".DS_Store").write_bytes(b"\0\0\0\1Bud1")
    source = open_source(str(tmp_path))
    assert [(shot.frame.file, shot.frame.t_ns) for shot in source.shots()] == [
        (f"DJI_{i:04}.JPG", i * 10**9) for i in range(3)
    ]
    (left_out,) = [fact.text for fact in facts_of(source) if fact.topic == "left out"]
    assert "._DJI_0000.JPG" in left_out and "and 2 more" in left_out
    for path in tmp_path.glob("DJI*"):
        path.unlink()
    with pytest.raises(SourceError, match=r"neither a flight folder .* nor a folder of photos"):
        open_source(str(tmp_path))


def test_the_zoomed_photos_of_the_field_have_the_focal_length_of_their_zoom(
    data_set: Callable[[str], Path], tmp_path: Path
) -> None:
    """As made by data/field/digital-zoom/make.py, smaller: its numbers are shares of the width."""
    assert (data_set("field") / "digital-zoom" / "make.py").is_file()
    for zoom, expected in ((1.0, 4253.2), (2.0, 8506.5)):
        path = photo(tmp_path / "a.jpg", model="L1D-20c", focal_mm=10.26, zoom=zoom, focal_35=28)
        focal_px = lens(path)[0]
        assert focal_px is not None and focal_px * 5472 / WIDTH == pytest.approx(expected, abs=0.1)
