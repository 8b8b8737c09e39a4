"""GoPro's telemetry in a video: an MP4 by FFmpeg with a track of GPMF behind it, packed after GoPro's description."""

import struct
from pathlib import Path

import cv2
import pytest
from typer.testing import CliRunner

from source_folders import TOML, picture
from terrafix.core.errors import SourceError
from terrafix.vision.sources import open_source
from terrafix.vision.sources.contract import truth_of
from terrafix.vision.sources.facts import facts_of
from terrafix.vision.sources.gpmf import read_gpmf
from terrafix_lab.fuzz.targets import gopro_video
from terrafix_tools import cli


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three seconds; the telemetry has its own index, in front of which the file of FFmpeg keeps its offsets."""
    folder = tmp_path_factory.mktemp("gopro")
    plain, path = folder / "plain.mp4", folder / "GH010001.mp4"
    writer = cv2.VideoWriter(str(plain), cv2.VideoWriter_fourcc(*"mp4v"), 10.0, (320, 240))  # type: ignore[attr-defined]
    for i in range(30):
        writer.write(picture(i, 320, 240))
    writer.release()
    data = plain.read_bytes()
    at = data.index(b"moov") - 4
    tracks = data[at + 8 : at + struct.unpack_from(">I", data, at)[0]]
    path.write_bytes(gopro_video(data[:at], moov=tracks))
    path.with_suffix(".toml").write_text(TOML)
    return path


def test_positions_of_a_gopro_are_truth_at_the_times_of_the_frames(video: Path, tmp_path: Path) -> None:
    """48 + 1e-6 degrees north for each tenth of a second; the second payload begins again at 48."""
    found = read_gpmf(video)
    assert found is not None and found.device == "HERO10 Black" and found.streams == {"GPS5", "ACCL"}
    assert found.fixes[:2] == [(0, 48.0, 11.0), (100_000_000, 48.000001, 11.0)] and found.fixes[10][0] == 10**9
    source = open_source(str(video), rate_hz=5.0)
    rows = truth_of(source)
    assert [row[0] for row in rows] == [s.frame.file for s in source.shots()][1:] and len(rows) == 14
    for name, lat_deg, lon_deg in rows:
        tenths = round(10 * float(name.partition("@")[2])) % 10
        assert (lat_deg, lon_deg) == pytest.approx((48.0 + 1e-6 * tenths, 11.0), abs=1e-9)
    assert any("HERO10 Black in the video (ACCL, GPS5): positions are truth" in f.text for f in facts_of(source))
    assert all(not shot.states for shot in source.shots())
    run = CliRunner().invoke(cli.app, ["source", "truth", str(video), "--out", str(tmp_path / "t.csv")])
    assert run.exit_code == 0 and (tmp_path / "t.csv").read_text().startswith("file,lat_deg,lon_deg\nGH010001.mp4@")


def test_a_video_without_positions_has_no_truth(video: Path, tmp_path: Path) -> None:
    plain = tmp_path / "plain.mp4"
    plain.write_bytes((video.parent / "plain.mp4").read_bytes())
    plain.with_suffix(".toml").write_text(TOML)
    assert read_gpmf(plain) is None
    with pytest.raises(SourceError, match=r"plain.mp4: has no positions of a GoPro"):
        truth_of(open_source(str(plain)))
    unlocked = tmp_path / "unlocked.mp4"
    unlocked.write_bytes(gopro_video().replace(b"GPSFL\x04\x00\x01\x00\x00\x00\x03", b"GPSFL\x04\x00\x01" + bytes(4)))
    found = read_gpmf(unlocked)
    assert found is not None and found.fixes == []  # before a fix a GoPro writes some position


def test_a_cut_video_has_what_is_whole(video: Path, tmp_path: Path) -> None:
    data = gopro_video()
    for length in range(0, len(data), 7):
        (tmp_path / "cut.mp4").write_bytes(data[:length])
        assert read_gpmf(tmp_path / "cut.mp4") is None or length > 1000
