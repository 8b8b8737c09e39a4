"""Telemetry in the subtitles of DJI's videos, in the forms of several generations."""

import math
from pathlib import Path

import pytest

from terrafix.core.errors import SourceError
from terrafix.vision.sources.srt import read_srt

MAVIC_3 = (
    "[latitude: 48.1] [longitude: 11.2] [rel_alt: 61.300 abs_alt: 590.123] [gb_yaw: 30.0 gb_pitch: -80.0 gb_roll: 0.0]"
)
FORMS = {  # text of a subtitle -> height above take-off
    MAVIC_3: 61.3,
    "HOME(11.2,48.1) 2017.06.01 10:00:00\nGPS(11.2,48.1,17) BAROMETER:62.4": 62.4,
    "GPS (11.2, 48.1, 17), D 12.0m, H 63.5m, H.S 4.1m/s, V.S 0.2m/s": 63.5,
    "GPS(11.2,48.1,0.0M) BAROMETER(-1.5M)": -1.5,
}


def written(folder: Path, *texts: str) -> Path:
    cues = [f"{i + 1}\n00:01:0{i},033 --> 00:01:0{i},066\n{text}\n" for i, text in enumerate(texts)]
    path = folder / "DJI_0001.SRT"
    path.write_text("\n".join(cues), encoding="utf-8")
    return path


def test_heights_come_from_every_form_and_positions_from_none(tmp_path: Path) -> None:
    states = read_srt(written(tmp_path, *FORMS))
    assert [state.agl_m for state in states] == list(FORMS.values())
    assert [state.t_ns for state in states] == [(60_033 + 1000 * i) * 1_000_000 for i in range(len(FORMS))]


def test_gimbal_angles_are_those_of_a_body_with_the_camera_straight_down(tmp_path: Path) -> None:
    first, second = read_srt(written(tmp_path, MAVIC_3, "BAROMETER:3"))
    angles = first.yaw_rad, first.pitch_rad, first.roll_rad
    assert [round(math.degrees(angle), 6) for angle in angles if angle is not None] == [30.0, 10.0, 0.0]
    assert second.yaw_rad is None


def test_height_above_the_sea_alone_is_not_taken_for_one_above_ground(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no subtitle of it has a height"):
        read_srt(written(tmp_path, "[altitude: 590.1] [latitude: 48.1]", "Hello"))
