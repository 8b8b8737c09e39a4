"""`terrafix locate`: from a record to the position of what a pixel shows."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

import pointed_flight as rig
from flight_records import ORIGIN, write_record
from terrafix.core.errors import MapError, SourceError, UsageError
from terrafix_tools.cli import app
from terrafix_tools.console.compute.locating import Locators
from terrafix_tools.console.locating import Question
from terrafix_tools.locate.locator import FlightLocator
from terrafix_tools.locate.views import read_views

ROOF_M = np.array([rig.HOUSE_E_M + 4.0, -6.0, rig.START_AMSL_M + rig.HOUSE_M])
FIELD_M = np.array([20.0, 30.0, rig.START_AMSL_M])


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rig.write_flight(tmp_path_factory.mktemp("run") / "flight.mcap")


def call(record: Path, *arguments: str) -> Result:
    return CliRunner().invoke(app, ["locate", str(record), *arguments])


def pixel(i: int, point_m: np.ndarray) -> str:
    u, v = rig.pixel(i, point_m)
    return f"{u},{v}"


@pytest.mark.parametrize("frame", [1, 2, 4])
@pytest.mark.parametrize("point_m", [ROOF_M, FIELD_M])
def test_roof_and_field_are_where_they_are(record: Path, frame: int, point_m: np.ndarray) -> None:
    found = FlightLocator.open(record).locate([(str(frame), rig.pixel(frame, point_m))])
    assert found.p_m == pytest.approx(point_m, abs=0.3)
    assert found.surface == "points"


def test_json_has_position_accuracy_surface_and_sightings(record: Path) -> None:
    done = call(record, "--frame", "2", "--pixel", pixel(2, FIELD_M), "--json")
    values = json.loads(done.output)
    lat_deg, lon_deg = ORIGIN.to_wgs84(20.0, 30.0)
    assert done.exit_code == 0
    assert (values["lat_deg"], values["lon_deg"]) == pytest.approx((lat_deg, lon_deg), abs=5e-6)
    assert values["alt_amsl_m"] == pytest.approx(500.0, abs=0.3)
    found = FlightLocator.open(record).locate([("2", rig.pixel(2, FIELD_M))])
    assert [values[f"sigma_{axis}_m"] ** 2 for axis in "enu"] == pytest.approx(found.cov.diagonal(), rel=1e-2)
    assert values["cov_en_m2"] == pytest.approx(found.cov[0, 1], abs=1e-4)
    assert values["radius95_m"] == pytest.approx(found.radius95_m, abs=1e-3)
    assert values["surface"] == "points" and values["consistent"] is True
    assert [sighting["frame"] for sighting in values["sightings"]] == ["2"]


def test_text_names_position_and_accuracy(record: Path) -> None:
    lines = call(record, "--frame", "0002.jpg", "--pixel", pixel(2, FIELD_M)).output.splitlines()
    assert lines[0].startswith("48.00026") and lines[0].endswith("500.0 m above sea level")
    assert lines[1].startswith("within ") and "(95 %), by the points; 1-sigma of the height" in lines[1]


def test_frames_of_two_objects_are_named_and_end_with_exit_code_1(record: Path) -> None:
    there = pixel(2, FIELD_M + np.array([0.0, 30.0, 0.0]))
    done = call(
        record, "--frame", "1", "--pixel", pixel(1, FIELD_M), "--frame", "3", "--pixel", pixel(3, FIELD_M),
        "--frame", "2", "--pixel", there,
    )  # fmt: skip
    assert done.exit_code == 1
    assert "frame 2 shows something else" in done.output


def test_height_is_not_above_sea_level_where_neither_start_nor_map_has_an_elevation(tmp_path: Path) -> None:
    messages = [rig.origin(ground_amsl_m=None), *rig.messages()[1:]]
    write_record(tmp_path / "flight.mcap", messages)
    arguments = ("--frame", "2", "--pixel", pixel(2, FIELD_M))
    assert json.loads(call(tmp_path, *arguments, "--json").output)["alt_amsl_m"] is None
    assert "above the ground at the start" in call(tmp_path, *arguments).output
    assert FlightLocator(read_views(tmp_path), lambda e_m, _n_m: np.full(len(e_m), 500.0)).amsl_known


def test_frame_of_no_fragment_is_located_without_points(tmp_path: Path) -> None:
    write_record(tmp_path / "flight.mcap", rig.messages(fragment_id=-1))
    assert FlightLocator.open(tmp_path).locate([("2", rig.pixel(2, FIELD_M))]).surface == "plane"


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        (["--frame", "2", "--pixel", "4"], UsageError, "--pixel 4: not two numbers"),
        (["--frame", "2", "--pixel", "a,b"], UsageError, "not two numbers; give U,V"),
        (["--frame", "2", "--frame", "3", "--pixel", "4,5"], UsageError, "2 --frame and 1 --pixel"),
        (["--frame", "2", "--pixel", "4,5", "--map", "none.gpkg"], MapError, "none.gpkg"),
        (["--frame", "2", "--pixel", "900,5"], UsageError, "outside the frame"),
    ],
)
def test_wrong_arguments_are_named(record: Path, arguments: list[str], error: type[Exception], words: str) -> None:
    done = call(record, *arguments)
    assert isinstance(done.exception, error) and words in str(done.exception)


def test_file_that_is_no_record_is_refused(tmp_path: Path) -> None:
    (tmp_path / "flight.mcap").write_bytes(b"")
    assert isinstance(call(tmp_path, "--frame", "0", "--pixel", "1,1").exception, SourceError)


def test_the_console_combines_the_pixels_of_several_frames(record: Path) -> None:
    mast_m = np.array([30.0, 12.0, rig.START_AMSL_M + 20.0])  # above all points of the cloud
    seen = [(i, rig.pixel(i, mast_m)) for i in (1, 2, 3)]
    locators = Locators()
    one, three = (locators.answer(Question(str(record.parent), "", pixels)) for pixels in (seen[:1], seen))
    assert not three.refused and three.consistent
    off_m = [np.hypot(*(ORIGIN.to_local(found.lat_deg, found.lon_deg) - mast_m[:2])) for found in (one, three)]
    assert off_m[1] < 0.9 * off_m[0]
    other = locators.answer(Question(str(record.parent), "", [seen[0], (2, rig.pixel(2, FIELD_M))]))
    assert not other.consistent
