"""`terrafix source info`, the same lines and the configuration of the source in `replay`."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from test_photo_makers import CALIBRATED, NADIR, dji, photo
from typer.testing import CliRunner

from source_folders import TOML, flight
from terrafix.core.config import load
from terrafix.core.errors import MapError, SourceError, UsageError
from terrafix.messages import Fact
from terrafix.vision.sources import open_configured, open_source
from terrafix.vision.sources.facts import facts_of
from terrafix_tools import cli
from terrafix_tools.replay import replay


def facts(source: Any) -> dict[str, str]:
    """Texts by topic, joined where a topic has several."""
    found: dict[str, str] = {}
    for fact in facts_of(source):
        found[fact.topic] = f"{found[fact.topic]}; {fact.text}" if fact.topic in found else fact.text
    return found


def photos(folder: Path, count: int = 6) -> Path:
    folder.mkdir()
    for i in range(count):
        at_s = i if i < count - 1 else i + 20
        photo(
            folder / f"{i}.jpg", dji(**CALIBRATED, **NADIR, RelativeAltitude="+60.0"), at_s=at_s, exif_size=(320, 240)
        )
    return folder


def test_photos_say_where_each_number_comes_from(tmp_path: Path) -> None:
    folder = photos(tmp_path / "p")
    (folder / "7.jpg").write_bytes(b"no photo")
    found = facts(open_source(str(folder), start=(48.0, 11.0)))
    assert found["camera"].startswith("320x240 px, focal length 280.0 px (1-sigma 3 %) from CalibratedFocalLength")
    assert "principal point 161.5, 118.5" in found["camera"] and "FC3582" in found["camera"]
    assert found["mount"].endswith("1-sigma 9, from gimbal angles of DJI in 6 of 6 photos")
    assert found["tilt"] == "6 values from the photos, 1-sigma 9 degrees"
    assert found["start"] == "48.000000, 11.000000 (1-sigma 10 m) from --start"
    assert found["height"] == "RelativeAltitude of DJI in 6 of 6 photos, 1-sigma 5 m"
    assert found["clock"] == "DateTimeOriginal of 6 of 6 photos, without fractions of a second"
    assert found["gaps"].startswith("1 gaps between photos, the longest 2") and "7.jpg" in found["left out"]


def test_a_flight_folder_says_its_columns_and_what_it_does_not_state(tmp_path: Path) -> None:
    found = facts(open_source(str(flight(tmp_path / "f", 5))))
    assert found["rate"] == "5 frames in 2.0 s, 2 a second"
    assert found["heading"] == "5 values from frames.csv, 1-sigma 3 degrees" and found["tilt"] == "not stated"
    assert found["start"].endswith("from [start] of flight.toml")
    without = TOML.replace("[start]\nlat_deg = 48.0\nlon_deg = 2.0\n", "")
    assert facts(open_source(str(flight(tmp_path / "g", 5, toml=without))))["start"].startswith("not stated: searched")


def test_source_info_prints_the_facts_as_text_and_json(tmp_path: Path) -> None:
    folder = photos(tmp_path / "p")
    run = CliRunner().invoke(cli.app, ["source", "info", str(folder), "--start", "48,11"])
    assert run.exit_code == 0 and run.output.splitlines()[0] == "p:"
    assert any(line.split()[:2] == ["camera", "320x240"] for line in run.output.splitlines())
    as_json = CliRunner().invoke(cli.app, ["source", "info", str(folder), "--start", "48,11", "--json"])
    topics = [fact["topic"] for fact in json.loads(as_json.output)["facts"]]
    assert {"camera", "mount", "start", "height", "heading", "tilt", "clock", "rate", "gaps"} <= set(topics)


def test_a_source_without_facts_has_none() -> None:
    assert facts_of(object()) == [] and Fact("a", "b").topic == "a"


@pytest.mark.parametrize(
    ("section", "error"),
    [
        ('camera = "nosuch.toml"', SourceError),
        ('start = "not a place"', UsageError),
        ('start = "95,200"', UsageError),
    ],
)
def test_replay_takes_the_source_of_its_configuration_as_run_does(
    section: str, error: type[Exception], tmp_path: Path
) -> None:
    config = tmp_path / "c.toml"
    config.write_text(f"[source]\n{section}\n")
    with pytest.raises(error):
        replay(photos(tmp_path / "p"), None, tmp_path / "out", configs=[config])


def test_a_start_of_the_command_line_is_before_that_of_the_configuration(tmp_path: Path) -> None:
    config = tmp_path / "c.toml"
    config.write_text('[source]\nstart = "48.5,11.5"\n')
    section = load([config]).source
    folder = str(photos(tmp_path / "p"))
    assert open_configured(section, folder).origin().lat_deg == 48.5
    assert open_configured(section, folder, (40.0, 10.0)).origin().lat_deg == 40.0


def test_replay_reads_a_video_at_the_rate_of_its_configuration(
    data_set: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    video = data_set("field") / "video"
    rates: list[float] = []

    def stop(source: Any) -> Any:
        rates.append(sum(1 for _ in source.shots()))
        raise MapError("far enough")

    with pytest.raises(MapError, match="far enough"):
        replay(video / "cfr.mp4", None, Path("unused"), configs=[video / "rate8.toml"], wrap_source=stop)
    assert rates == [64]


def test_replay_refuses_the_configuration_of_the_field(data_set: Callable[[str], Path], tmp_path: Path) -> None:
    config = data_set("field") / "camera-yaml" / "c.toml"
    with pytest.raises((SourceError, UsageError)):
        replay(photos(tmp_path / "p"), None, tmp_path / "out", configs=[config])
