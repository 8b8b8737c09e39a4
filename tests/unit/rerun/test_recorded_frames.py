"""The frames of a record as a source: what each shot has, and that a replay of them sees what the flight saw."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from flight_records import PERIOD_NS, frame, gps_input, origin, write_record
from terrafix import messages as m
from terrafix.core.config import Config, RecorderSection
from terrafix.core.errors import SourceError, UsageError
from terrafix.recorder.provenance import header
from terrafix.recorder.writer import FlightWriter
from terrafix.vision.sources import Shot
from terrafix_tools.cli import app
from terrafix_tools.rerun.frames import NOT_RECORDED, RecordedFrames

ALL = Config(recorder=RecorderSection(frames="all", frame_format="png"))


def image(i: int) -> np.ndarray:
    return np.random.default_rng(i).integers(0, 255, (48, 64, 3), dtype=np.uint8)


def png(i: int) -> bytes:
    return bytes(cv2.imencode(".png", image(i))[1])


def state(i: int) -> m.VehicleState:
    return m.VehicleState(t_ns=i * PERIOD_NS - 1, source="mavlink", yaw_rad=0.1 * i)


def imu(i: int) -> m.Imu:
    return m.Imu(t_ns=i * PERIOD_NS - 2, source="mavlink", samples=[])


def health(i: int) -> m.Health:
    return m.Health(
        t_ns=i, band=m.ThermalBand.HOT, temperature_c=90.0, throttled=False, disk_free_mb=1, cause="temperature"
    )


def recorded(folder: Path, *entries: m.Message | int, config: Config = ALL) -> Path:
    """A record of messages, and of the image of each frame whose number is given."""
    writer = FlightWriter(folder / "flight.mcap", header(config))
    for entry in (origin(), *entries):
        if isinstance(entry, int):
            writer.write_frame_image(entry * PERIOD_NS, entry, png(entry), "png")
        else:
            writer.write(entry, entry.t_ns)
    writer.close()
    return folder


def shots(record: Path) -> list[Shot]:
    return list(RecordedFrames(record).shots())


def test_each_shot_has_its_pixels_and_what_was_received_since_the_frame_before(tmp_path: Path) -> None:
    record = recorded(tmp_path, frame(0), 0, imu(1), state(1), health(1), gps_input(5), frame(1), state(2), 1)
    first, second = shots(record)
    assert (first.frame, first.states, first.imu, first.others) == (frame(0), (), (), ())
    assert np.array_equal(first.image, image(0)) and np.array_equal(second.image, image(1))
    assert (second.states, second.imu, second.others) == ((state(1),), (imu(1),), (health(1),))


def test_pixels_that_are_recorded_after_later_frames_belong_to_their_frame(tmp_path: Path) -> None:
    found = shots(recorded(tmp_path, frame(0), frame(1), frame(2), 0, 1, 2))
    assert [shot.frame.frame_id for shot in found] == [0, 1, 2]
    assert all(np.array_equal(shot.image, image(i)) for i, shot in enumerate(found))


def test_frame_whose_pixels_were_lost_has_an_error(tmp_path: Path) -> None:
    found = shots(recorded(tmp_path, frame(0), frame(1), 1, frame(2)))
    assert [shot.frame.error for shot in found] == [NOT_RECORDED, "", NOT_RECORDED]
    assert found[0].image is None and np.array_equal(found[1].image, image(1))


def test_frame_that_had_an_error_keeps_it(tmp_path: Path) -> None:
    broken = m.Frame(t_ns=0, frame_id=0, file="a.jpg", width=64, height=48, error="truncated")
    assert shots(recorded(tmp_path, broken, frame(1), 1))[0].frame == broken


def test_damaged_image_is_an_error_of_its_frame(tmp_path: Path) -> None:
    writer = FlightWriter(tmp_path / "flight.mcap", header(ALL))
    for message in (origin(), frame(0)):
        writer.write(message, message.t_ns)
    writer.write_frame_image(0, 0, png(0)[:40], "png")
    writer.close()
    (shot,) = shots(tmp_path)
    assert (shot.frame.error, shot.image) == (NOT_RECORDED, None)


def test_source_has_origin_name_and_map_of_the_record(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    writer = FlightWriter(tmp_path / "run" / "flight.mcap", {**header(ALL), "map": '{"path": "/maps/a.gpkg"}'})
    writer.write(origin(), 0)
    writer.close()
    source = RecordedFrames(tmp_path / "run")
    assert (source.origin(), source.name(), source.map_hint()) == (origin(), "run", Path("/maps/a.gpkg"))
    assert source.length() is None and not source.live


@pytest.mark.parametrize("kept", ["thumbnails", "keyframes", "none"])
def test_record_without_all_frames_is_refused_with_the_remedy(tmp_path: Path, kept: str) -> None:
    config = Config(recorder=RecorderSection(frames=kept))  # type: ignore[arg-type]
    with pytest.raises(SourceError, match=rf'frames = "{kept}".*without --frames'):
        RecordedFrames(recorded(tmp_path, frame(0), config=config))


def test_record_without_origin_is_refused(tmp_path: Path) -> None:
    writer = FlightWriter(tmp_path / "flight.mcap", header(ALL))
    writer.write(frame(0), 0)
    writer.close()
    with pytest.raises(SourceError, match="no origin of a flight"):
        RecordedFrames(tmp_path)


def replay(*arguments: object) -> BaseException | None:
    return CliRunner().invoke(app, ["replay", *(str(argument) for argument in arguments)]).exception


def test_start_of_a_record_cannot_be_changed(tmp_path: Path) -> None:
    error = replay(recorded(tmp_path, frame(0), 0), "--frames", "--start", "48,11", "--out", tmp_path / "out")
    assert isinstance(error, UsageError) and "omit --start" in str(error)


def test_frames_of_what_is_no_record_are_refused(tmp_path: Path) -> None:
    error = replay(tmp_path, "--frames", "--out", tmp_path / "out")
    assert isinstance(error, UsageError) and "--frames is for flight records" in str(error)


def test_other_inputs_need_the_frames(tmp_path: Path) -> None:
    write_record(tmp_path / "flight.mcap", [origin(), frame(0)])
    error = replay(tmp_path, "--map", "a.tif", "--out", tmp_path / "out")
    assert isinstance(error, UsageError) and "add --frames if the record has its frames" in str(error)
