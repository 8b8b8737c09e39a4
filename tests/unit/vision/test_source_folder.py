"""Flight folders: what is read, and the error for every kind of invalid input."""

import math
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from source_folders import HEADER, TOML, flight, jpeg, picture
from terrafix.core.errors import SourceError, UsageError
from terrafix.core.initial_position import start_is_unknown
from terrafix.vision.sources import open_source, parse_start


def refusal(source: Path | str) -> str:
    """-> the one line with which a source is refused."""
    with pytest.raises(SourceError) as error:
        open_source(str(source))
    assert "\n" not in str(error.value)
    return str(error.value)


def test_a_flight_folder_yields_its_frames_in_order_with_telemetry(tmp_path: Path) -> None:
    source = open_source(str(flight(tmp_path / "f")))
    shots = list(source.shots())
    assert [s.frame.frame_id for s in shots] == [0, 1, 2, 3, 4]
    assert [s.frame.t_ns for s in shots] == [i * 500_000_000 for i in range(5)]
    assert all(s.image is not None and s.image.shape == (240, 320, 3) and not s.frame.error for s in shots)
    (state,) = shots[1].states
    assert state.yaw_rad == pytest.approx(math.radians(-9.0))
    assert (state.agl_m, state.pitch_rad, state.roll_rad, state.source) == (101.0, None, None, "frames.csv")
    assert (source.name(), source.length(), source.live) == ("generated", 5, False)
    assert source.map_hint() == tmp_path / "maps" / "here.tif"
    origin = source.origin()
    assert (origin.lat_deg, origin.lon_deg, origin.ground_amsl_m, origin.start_sigma_m) == (48.0, 2.0, None, 10.0)
    assert (origin.yaw_sigma_deg, origin.camera.mount_pitch_deg) == (3.0, -90.0)


def test_starting_in_the_middle_keeps_frame_ids_and_times(tmp_path: Path) -> None:
    source = open_source(str(flight(tmp_path / "f")))
    shots = list(source.shots(from_s=0.9))
    assert [(s.frame.frame_id, s.frame.t_ns) for s in shots] == [(2, 10**9), (3, 1_500_000_000), (4, 2 * 10**9)]
    assert len(shots[0].states) == 1


def test_a_start_argument_overrides_the_file_and_both_may_be_missing(tmp_path: Path) -> None:
    without = TOML.replace("[start]\nlat_deg = 48.0\nlon_deg = 2.0\n", "")
    folder = str(flight(tmp_path / "f", toml=without))
    assert open_source(folder, start=(1.0, 2.0)).origin().lat_deg == 1.0
    assert start_is_unknown(open_source(folder).origin())
    assert not start_is_unknown(open_source(folder, start=(1.0, 2.0)).origin())
    assert open_source(str(flight(tmp_path / "g")), start=(1.0, 2.0)).origin().lon_deg == 2.0


def test_frames_csv_needs_only_file_and_time(tmp_path: Path) -> None:
    folder = flight(tmp_path / "f", frames=2, csv="\ufefffile,t_s\r\n0000.jpg,0\r\n0001.jpg,1.5\r\n")
    assert [(s.frame.t_ns, s.states) for s in open_source(str(folder)).shots()] == [(0, ()), (1_500_000_000, ())]


@pytest.mark.parametrize(
    ("csv", "expected_text"),
    [
        ("file,t_s,heading\n0000.jpg,0,0", "unknown column 'heading'"),
        ("file,yaw_deg\n0000.jpg,0", "there is no column 't_s'"),
        ("t_s\n0", "there is no column 'file'"),
        ("file,t_s,t_s\n0000.jpg,0,0", "a column stands twice"),
        ("0000.jpg,0,,,,\n0009.jpg,1,,,,", "row 3: frames/0009.jpg does not exist"),
        ("0000.jpg,0,,,,\n0001.jpg,0,,,,", "row 3: t_s 0 is not later"),
        ("0000.jpg,1,,,,\n0001.jpg,0.5,,,,", "row 3: t_s 0.5 is not later"),
        ("0000.jpg,0,,,,\n0000.jpg,1,,,,", "row 3: '0000.jpg' is already in row 2"),
        ("0000.jpg,zero,,,,", "row 2: t_s 'zero' is not a number"),
        ("0000.jpg,0,nan,,,", "row 2: yaw_deg 'nan' is not a number"),
        ("0000.jpg,0,,95,,", "row 2: pitch_deg 95 is outside"),
        ("0000.jpg,,,,,", "row 2: t_s is empty"),
        (",0,,,,", "row 2: the file name is empty"),
        ("0000.jpg,0,,,", "row 2: 5 cells, the header has 6"),
        ("../flight.toml,0,,,,", "row 2: '../flight.toml' leaves frames/"),
        ("/etc/hostname,0,,,,", "leaves frames/"),
        ("", "there are no rows"),
    ],
)
def test_an_invalid_column_or_row_is_named(tmp_path: Path, csv: str, expected_text: str) -> None:
    table = csv if "t_s" in csv or "yaw" in csv else f"{HEADER}\n{csv}"
    text = refusal(flight(tmp_path / "f", csv=f"{table}\n"))
    assert expected_text in text and "frames.csv" in text


@pytest.mark.parametrize(
    ("old", "new", "expected_text"),
    [
        ("fx = 300\n", "", "[camera] has no 'fx'; add it"),
        ("fx = 300\n", "focal_x = 300\n", "unknown key 'focal_x' in [camera]"),
        ("lat_deg", "latdeg", "did you mean 'lat_deg'?"),
        ("[telemetry]", "[telemetri]", "did you mean 'telemetry'?"),
        ("fx = 300\n", "fx = -1\n", "[camera] fx: expected `float` > 0.0"),
        ("fx = 300\n", "fx = inf\n", "[camera] fx is inf"),
        ("fx = 300\n", "fx = 'wide'\n", "[camera] fx: expected `float`, got `str`"),
        ("cx = 160.0", "cx = 1600.0", "lies outside the 320x240 image"),
        ("cx = 160.0", "cx = 160.0\ndistortion = [0.1, 0.2]", "distortion has 2 numbers"),
        ("lat_deg = 48.0", "lat_deg = 148.0", "[start] lat_deg: expected `float` <= 90.0"),
        ("[camera]", "[camera", "not valid TOML"),
        (TOML, "[start]\nlat_deg=1\nlon_deg=2\n", "add one with width, height, fx, fy, cx, cy"),
        ("fx = 300\n", "fx = 2.8\n", "are a field of view of 178.0 degrees, more than 160; is that in millimetres?"),
        ("fy = 300.0\n", "fy = 2.8\n", "fy is in pixels: millimetres / sensor size in millimetres * 240"),
        ("fx = 300\n", "fx = 6200\n", "field of view of 3.0 degrees, less than 3; give the focal length in pixels"),
        ("fx = 300\n", "fx = 610\n", "fx is 2.03 times fy"),
        ("fx = 300\n", "fx = 145\n", "fx is 0.48 times fy"),
        ("[start]", "[mount]\npitch_deg = 0.0\n[start]", "pitch_deg = 0 and roll_deg = 0 do not look down"),
        ("[start]", "[mount]\npitch_deg = 90.0\n[start]", "do not look down at the ground; -90 is straight down"),
        ("[start]", "[mount]\nroll_deg = 100.0\npitch_deg = 0\n[start]", "do not look down"),
    ],
)
def test_an_invalid_key_or_an_implausible_camera_is_named_with_a_hint(
    tmp_path: Path, old: str, new: str, expected_text: str
) -> None:
    assert old in TOML
    text = refusal(flight(tmp_path / "f", toml=TOML.replace(old, new, 1)))
    assert expected_text in text and "flight.toml" in text


@pytest.mark.parametrize("gone", ["flight.toml", "frames.csv", "frames"])
def test_a_missing_file_or_folder_is_named(tmp_path: Path, gone: str) -> None:
    folder = flight(tmp_path / "f")
    shutil.rmtree(folder / gone) if gone == "frames" else (folder / gone).unlink()
    assert gone in refusal(folder)


def test_a_path_that_is_not_a_source_is_reported(tmp_path: Path) -> None:
    (tmp_path / "text.txt").write_text("hello")
    (tmp_path / "one.jpg").write_bytes(jpeg(0))
    (tmp_path / "empty").mkdir()
    for spec in ("", tmp_path / "nothing", tmp_path / "text.txt", tmp_path / "one.jpg"):
        refusal(spec)
    assert "neither a flight folder" in refusal(tmp_path / "empty")


def _cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


def _with_thumbnail(data: bytes) -> bytes:
    """A thumbnail in APP1 has its own end marker."""
    thumbnail = b"Exif\0\0" + jpeg(9, 64, 48)
    return data[:2] + b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail + data[2:]


@pytest.mark.parametrize(
    ("damage", "expected_text"),
    [
        (lambda d: b"", "empty"),
        (lambda d: b"no picture", "cannot be decoded"),
        (_cut, "truncated"),
        (lambda d: _cut(d) + b"\xff\xd9", "filled with grey"),
        (lambda d: _cut(_with_thumbnail(d)), "truncated"),
        (lambda d: _cut(d) + bytes(len(d) // 2), "truncated"),
        (lambda d: jpeg(0, 640, 480), "wrong size: 640x480, the camera says 320x240"),
    ],
)
def test_a_damaged_frame_loses_one_frame_only(tmp_path: Path, damage, expected_text: str) -> None:  # type: ignore[no-untyped-def]
    folder = flight(tmp_path / "f")
    victim = folder / "frames" / "0002.jpg"
    victim.write_bytes(damage(victim.read_bytes()))
    shots = list(open_source(str(folder)).shots())
    assert expected_text in shots[2].frame.error and shots[2].image is None
    assert [bool(s.frame.error) for s in shots] == [False, False, True, False, False]
    assert shots[2].states


def test_a_link_to_an_image_outside_of_the_folder_is_an_error_and_frames_itself_may_be_a_link(tmp_path: Path) -> None:
    folder = flight(tmp_path / "f")
    elsewhere = tmp_path / "disk"
    (folder / "frames").rename(elsewhere)
    (folder / "frames").symlink_to(elsewhere)
    assert all(shot.image is not None for shot in open_source(str(folder)).shots())
    secret = tmp_path / "secret.jpg"
    (elsewhere / "0002.jpg").rename(secret)
    (elsewhere / "0002.jpg").symlink_to(secret)
    assert "row 4: frames/0002.jpg is a link that leaves frames/" in refusal(folder)


def test_an_image_behind_a_linked_folder_outside_of_frames_is_an_error(tmp_path: Path) -> None:
    folder = flight(tmp_path / "f")
    outside = tmp_path / "outside"
    outside.mkdir()
    (folder / "frames" / "0002.jpg").rename(outside / "0002.jpg")
    (folder / "frames" / "more").symlink_to(outside)
    table = folder / "frames.csv"
    table.write_text(table.read_text().replace("0002.jpg", "more/0002.jpg"))
    assert "frames/more/0002.jpg is a link that leaves frames/" in refusal(folder)


def test_a_camera_size_mismatch_is_reported_before_the_flight(tmp_path: Path) -> None:
    toml = TOML.replace("width = 320", "width = 640").replace("height = 240", "height = 480")
    assert "wrong size: 320x240, the camera says 640x480; write [camera]" in refusal(flight(tmp_path / "f", toml=toml))


def test_a_folder_named_like_a_camera_is_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flight(tmp_path / "2014")
    flight(tmp_path / "now!")
    monkeypatch.chdir(tmp_path)
    assert open_source("2014").length() == open_source("now!").length() == 5


def test_a_frame_deleted_in_flight_loses_one_frame_only(tmp_path: Path) -> None:
    folder = flight(tmp_path / "f")
    source = open_source(str(folder))
    (folder / "frames" / "0003.jpg").unlink()
    assert [bool(s.frame.error) for s in source.shots()] == [False, False, False, True, False]


def test_complete_images_are_accepted(tmp_path: Path) -> None:
    """Trailing bytes, a thumbnail, and an image that is grey all over."""
    import cv2

    folder = flight(tmp_path / "f", frames=4)
    frames = folder / "frames"
    (frames / "0000.jpg").write_bytes(jpeg(0) + bytes(4096))
    (frames / "0001.jpg").write_bytes(_with_thumbnail(jpeg(1)))
    (frames / "0002.jpg").write_bytes(cv2.imencode(".jpg", np.full((240, 320, 3), 128, np.uint8))[1].tobytes())
    progressive = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_RST_INTERVAL, 4]
    (frames / "0003.jpg").write_bytes(cv2.imencode(".jpg", picture(3), progressive)[1].tobytes())
    assert [s.frame.error for s in open_source(str(folder)).shots()] == [""] * 4


def test_a_start_argument_is_parsed_and_validated() -> None:
    assert parse_start(" -29.4167, -51.94 ") == (-29.4167, -51.94)
    assert parse_start("") is None
    for wrong in ("48", "48,2,3", "north,east", "120,30", "nan,0"):
        with pytest.raises(UsageError, match=r"\A.*\Z"):  # one line
            parse_start(wrong)


@pytest.mark.parametrize(("name", "frames"), [("village-1", 358), ("town-a", 31)])
def test_real_flights_load(data_set: Callable[[str], Path], name: str, frames: int) -> None:
    source = open_source(str(data_set(f"flights/{name}")))
    assert source.length() == frames
    hint = source.map_hint()
    assert hint is not None and hint.is_file()
    shot = next(iter(source.shots()))
    assert shot.image is not None and shot.states[0].agl_m


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("fx = 300\n", "fx = 305\n"),
        ("fx = 300\nfy = 300.0", "fx = 6000\nfy = 4500.0"),  # 3.05 degrees
        ("fx = 300\nfy = 300.0", "fx = 30\nfy = 30.0"),  # 159 degrees
        ("[start]", "[mount]\npitch_deg = -30.0\n[start]"),
    ],
)
def test_an_unusual_but_plausible_camera_is_accepted(tmp_path: Path, old: str, new: str) -> None:
    assert old in TOML
    open_source(str(flight(tmp_path / "f", toml=TOML.replace(old, new, 1))))


@pytest.mark.parametrize(("agl", "refused"), [(12_000.0, True), (4_900.0, False)])
def test_heights_that_cannot_be_metres_are_rejected(tmp_path: Path, agl: float, refused: bool) -> None:
    rows = "\n".join(f"{i:04}.jpg,{i}.0,,,,{agl if i else 0.0}" for i in range(5))
    folder = flight(tmp_path / "f", csv=f"file,t_s,yaw_deg,pitch_deg,roll_deg,agl_m\n{rows}\n")
    if not refused:
        open_source(str(folder))
        return
    text = refusal(folder)
    assert "agl_m is 12000 in half of the rows" in text and "centimetres" in text
