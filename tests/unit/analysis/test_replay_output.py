"""Replay with small stub nodes: files, columns, determinism, and errors on bad input."""

import csv
import errno
import json
import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from flight_records import ORIGIN, estimate
from source_folders import TOML, flight
from terrafix import messages as m
from terrafix.core.errors import ConfigError, MapError, ModelError, OutputError, UsageError
from terrafix.core.node import Node, NodeBase, NodeContext
from terrafix.map.package import MapPackage
from terrafix.recorder.reader import ReadResult, read_flight, read_frame_images, read_thumbnails
from terrafix.recorder.writer import FlightWriter
from terrafix.vision.sources import Shot, Source, open_source
from terrafix_tools.estimates import COLUMNS, ESTIMATES, read_rows
from terrafix_tools.replay import replay
from terrafix_tools.rerun.earlier import KEPT, EarlierPart, earlier_part
from terrafix_tools.rerun.frames import RecordedFrames

FRAMES = 6
KEYFRAMES = [0, 3]
LOST = 2  # the frame for which the stub estimator publishes no estimate


class StubVision(NodeBase):
    def on(self, message: m.Message) -> Iterable[m.Message]:
        if isinstance(message, m.Frame):
            keyframe = max(0, message.frame_id - 1)
            verdict = m.Verdict.BAD_IMAGE if message.error else m.Verdict.ACCEPTED
            yield m.Odometry(
                t_ns=message.t_ns,
                frame_id=message.frame_id,
                keyframe_id=keyframe,
                verdict=verdict,
                becomes_keyframe=message.frame_id in KEYFRAMES,
            )


class StubEstimator(NodeBase):
    """Publishes two estimates per frame; the last one counts."""

    def __init__(self, die_at: int = -1) -> None:
        self._die_at = die_at

    def on(self, message: m.Message) -> Iterable[m.Message]:
        match message:
            case m.Odometry(frame_id=i):
                if i == self._die_at:
                    raise RuntimeError("a bug")
                verdict = m.MeasurementVerdict(
                    t_ns=message.t_ns, frame_id=i, measurement="odometry", verdict=message.verdict
                )
                yield verdict
                if i != LOST:
                    yield estimate(i, 999.0, 999.0)
                    yield estimate(i, 10.0 * i, -10.0)
            case m.SourceEnded():
                for offset_m, m_per_unit in ((5.0, 1.25), (0.0, None)):
                    lat_deg, lon_deg = ORIGIN.to_wgs84(0.0, offset_m)
                    pose = m.RefinedPose(
                        frame_id=1,
                        lat_deg=lat_deg,
                        lon_deg=lon_deg,
                        alt_amsl_m=612.5,
                        sigma_e_m=1.0,
                        sigma_n_m=1.0,
                        fragment_id=3,
                        q_w_c=(0.5, 0.5, 0.5, -0.5),
                        cov=tuple(np.eye(6).ravel().tolist()),
                        m_per_unit=m_per_unit,
                    )
                    yield m.Refinement(t_ns=message.t_ns, poses=[pose])
            case _:
                pass


def nodes(ctx: NodeContext) -> dict[str, Node]:
    return {"vision": StubVision(), "estimator": StubEstimator()}


def map_at(path: Path, lon_deg: float = 11.0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(0).integers(1, 255, (3, 128, 128), dtype=np.uint8)
    size = 0.00001
    place = Affine(size, 0.0, lon_deg - 64 * size, 0.0, -size, 48.0 + 64 * size)
    profile = {"driver": "GTiff", "width": 128, "height": 128, "count": 3, "dtype": "uint8"}
    with rasterio.open(path, "w", crs="EPSG:4326", transform=place, **profile) as file:
        file.write(pixels)
    return path


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    map_at(tmp_path / "maps" / "here.tif")
    return flight(tmp_path / "flight", FRAMES, toml=TOML.replace("lon_deg = 2.0", "lon_deg = 11.0"))


def test_a_replay_writes_three_files_and_one_row_per_frame(folder: Path, tmp_path: Path) -> None:
    (folder / "frames" / "0004.jpg").write_bytes(b"not an image")
    summary = replay(folder, None, tmp_path / "out", nodes=nodes)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["estimates.csv", "flight.mcap", "summary.json"]
    rows = list(csv.DictReader((tmp_path / "out" / "estimates.csv").read_text().splitlines()))
    assert list(rows[0]) == list(COLUMNS)
    assert [r["file"] for r in rows] == [f"{i:04}.jpg" for i in range(FRAMES)]
    assert [bool(r["lat_deg"]) for r in rows] == [i != LOST for i in range(FRAMES)]
    last = rows[3]
    assert ORIGIN.to_local(float(last["lat_deg"]), float(last["lon_deg"])) == pytest.approx((30.0, -10.0), abs=0.01)
    assert (last["t_s"], last["yaw_deg"], last["sigma_e_m"], last["cov_en_m2"]) == (
        "1.500",
        "90.000",
        "4.0000",
        "0.00000",
    )
    assert (last["source_label"], last["anchor_age_ms"]) == ("satellite_anchored", "0")
    assert all(float(r["process_ms"]) > 0 for r in rows)
    assert [bool(r["refined_lat_deg"]) for r in rows] == [i == 1 for i in range(FRAMES)]
    assert float(rows[1]["refined_lat_deg"]) == pytest.approx(48.0, abs=1e-8)  # the last refinement
    whole = [rows[1][f"refined_{name}"] for name in ("alt_amsl_m", "q_w_c", "m_per_unit", "fragment_id")]
    assert whole == ["612.500", "0.5 0.5 0.5 -0.5", "1.2500", "3"]  # the scale of the one before, which alone states it
    assert [float(v) for v in rows[1]["refined_cov"].split()] == np.eye(6).ravel().tolist()
    assert read_rows(tmp_path / "out" / "estimates.csv")[1].refined_fragment_id == 3
    assert summary == json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["frames"], summary["localised"], summary["odometry_frames"]) == (FRAMES, FRAMES - 1, FRAMES - 2)
    assert summary["verdicts"]["odometry"] == {"accepted": FRAMES - 1, "bad_image": 1}
    recorded = [message for _, _, message in read_flight(tmp_path / "out")]
    assert sum(isinstance(message, m.Frame) for message in recorded) == FRAMES
    assert isinstance(recorded[0], m.Origin)


def test_the_summary_has_a_verdict_from_rows_faults_and_map_matches(folder: Path, tmp_path: Path) -> None:
    class Faulty(StubEstimator):
        def on(self, message: m.Message) -> Iterable[m.Message]:
            yield from super().on(message)
            if isinstance(message, m.Odometry) and message.frame_id == FRAMES - 2:
                fault = {"t_ns": message.t_ns, "quantity": "scale", "factor": 2.0, "detail": ""}
                yield m.CalibrationFault(**fault, active=True)

    verdict = replay(folder, None, tmp_path / "right", nodes=nodes)["verdict"]
    assert (
        verdict["verdict"] == "trust it in part"
        and verdict["reasons"] == ["no position"]
        and verdict["active_faults"] == []
    )
    wrong = replay(folder, None, tmp_path / "wrong", nodes=lambda ctx: nodes(ctx) | {"estimator": Faulty()})["verdict"]
    assert wrong["verdict"] == "do not trust it"
    assert wrong["active_faults"] == ["height/focal seems x2.00 off"]
    assert json.loads((tmp_path / "wrong" / "summary.json").read_text())["verdict"] == wrong


def test_two_replays_differ_only_in_run_time(folder: Path, tmp_path: Path) -> None:
    tables = []
    for name in ("a", "b"):
        replay(folder, None, tmp_path / name, nodes=nodes)
        rows = list(csv.reader((tmp_path / name / "estimates.csv").read_text().splitlines()))
        at = rows[0].index("process_ms")
        tables.append([row[:at] + row[at + 1 :] for row in rows])
    assert tables[0] == tables[1]


def test_an_interrupted_replay_leaves_readable_partial_files(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    replay(folder, None, out, nodes=nodes)
    (out / "report.html").write_text("old")
    with pytest.raises(RuntimeError, match="a bug"):
        replay(folder, None, out, nodes=lambda ctx: {"vision": StubVision(), "estimator": StubEstimator(4)})
    assert sorted(p.name for p in out.iterdir()) == ["estimates.csv.partial", "flight.mcap.partial"]
    assert len(read_rows(out / "estimates.csv.partial")) == 4
    assert sum(isinstance(x, m.Frame) for _, _, x in read_flight(out / "flight.mcap.partial")) >= 4


def test_the_ground_height_at_the_start_comes_from_the_map(folder: Path, tmp_path: Path) -> None:
    from terrafix_tools.mapping.build import build

    dem = tmp_path / "dem.tif"
    place = Affine(0.001, 0.0, 10.99, 0.0, -0.001, 48.01)
    profile = {"driver": "GTiff", "width": 20, "height": 20, "count": 1, "dtype": "float32", "crs": "EPSG:4326"}
    with rasterio.open(dem, "w", transform=place, **profile) as file:
        file.write(np.full((1, 20, 20), 512.5, np.float32))
    package = build(tmp_path / "maps" / "here.tif", tmp_path / "with-dem.gpkg", dem=dem)
    replay(folder, package, tmp_path / "out", nodes=nodes)
    origin = next(x for _, _, x in read_flight(tmp_path / "out") if isinstance(x, m.Origin))
    assert origin.ground_amsl_m is not None
    assert math.isclose(origin.ground_amsl_m, 512.5, abs_tol=0.1)


def test_a_given_start_overrides_that_of_the_source(folder: Path, tmp_path: Path) -> None:
    replay(folder, None, tmp_path / "out", start=(48.0001, 11.0), nodes=nodes)
    origin = next(x for _, _, x in read_flight(tmp_path / "out") if isinstance(x, m.Origin))
    assert (origin.lat_deg, origin.lon_deg) == (48.0001, 11.0)


def test_the_error_of_a_map_elsewhere_states_the_distance(folder: Path, tmp_path: Path) -> None:
    elsewhere = map_at(tmp_path / "far.tif", lon_deg=11.1)
    with pytest.raises(
        MapError, match=r"does not cover the start 48.000000, 11.000000; its nearest edge is 7\.\d km away"
    ):
        replay(folder, elsewhere, tmp_path / "out", nodes=nodes)
    assert not (tmp_path / "out").exists()


def test_the_error_of_a_start_with_swapped_coordinates_says_so(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"latitude and longitude are swapped: 48.000000, 11.000000 lies on the map"):
        replay(folder, None, tmp_path / "out", start=(11.0, 48.0), nodes=nodes)


def test_a_replay_without_a_map_is_an_error(folder: Path, tmp_path: Path) -> None:
    toml = (folder / "flight.toml").read_text()
    (folder / "flight.toml").write_text(toml.replace('map = "../maps/here.tif"', ""))
    with pytest.raises(MapError, match="names no map; give one with --map"):
        replay(folder, None, tmp_path / "out", nodes=nodes)
    with pytest.raises(MapError, match="no such map"):
        replay(folder, tmp_path / "none.tif", tmp_path / "out", nodes=nodes)


def test_models_are_checked_before_the_flight(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERRAFIX_MODELS", str(tmp_path / "models"))
    for text, error, says in (
        ("xfeat=none.onnx", ModelError, "none.onnx: no such model file"),
        ("xfeat", ModelError, r"models/xfeat\.onnx: no such model file \(xfeat\); terrafix models fetch xfeat"),
        ("xfeat=", UsageError, "write NAME=PATH, or NAME alone"),
        ("xfeat=lighterglue-l3", ModelError, "'lighterglue-l3' cannot be used as xfeat"),
        ("superglue=a.onnx", UsageError, "unknown model 'superglue'; known: xfeat"),
    ):
        with pytest.raises(error, match=says):
            replay(folder, None, tmp_path / "out", models=[text], nodes=nodes)


def test_a_bad_configuration_or_output_folder_is_an_error(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.toml").write_text("[recorder]\nframe = 3\n")
    with pytest.raises(ConfigError, match="did you mean 'frames'"):
        replay(folder, None, tmp_path / "out", configs=[tmp_path / "bad.toml"], nodes=nodes)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        replay(folder, None, tmp_path / "file" / "out", nodes=nodes)


def test_a_full_disk_is_one_line(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_self: FlightWriter) -> None:
        if (tmp_path / "out" / "estimates.csv.partial").read_text(encoding="utf-8").count("\n") > 3:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(FlightWriter, "flush", full)
    with pytest.raises(OutputError, match=r"cannot be written \(No space left on device\); is the disk full"):
        replay(folder, None, tmp_path / "out", nodes=nodes)
    assert not (tmp_path / "out" / "estimates.csv").exists()


@pytest.mark.parametrize(
    ("setting", "thumbnails", "at_full_size"),
    [("none", False, []), ("thumbnails", True, []), ("keyframes", True, KEYFRAMES), ("all", True, range(FRAMES))],
)
def test_recorded_images_follow_the_configuration(
    folder: Path, tmp_path: Path, setting: str, thumbnails: bool, at_full_size: Sequence[int]
) -> None:
    (tmp_path / "c.toml").write_text(f'[recorder]\nframes = "{setting}"\nframe_format = "png"\n')
    replay(folder, None, tmp_path / "out", configs=[tmp_path / "c.toml"], nodes=nodes)
    small = dict(read_thumbnails(tmp_path / "out"))
    assert sorted(small) == (list(range(FRAMES)) if thumbnails else [])
    images = {image.frame_id: (image.image_format, image.data) for image in read_frame_images(tmp_path / "out")}
    assert sorted(images) == list(at_full_size)
    for frame_id, (form, data) in images.items():
        source = cv2.imread(str(sorted((folder / "frames").iterdir())[frame_id]))
        assert form == "png"
        assert np.array_equal(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), source)


def test_header_of_the_record_names_map_and_computer(folder: Path, tmp_path: Path) -> None:
    replay(folder, None, tmp_path / "out", nodes=nodes)
    result = ReadResult()
    messages = [message for _, _, message in read_flight(tmp_path / "out", result)]
    (origin,) = (message for message in messages if isinstance(message, m.Origin))
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert result.header["map"]["checksum"] == MapPackage.open(Path(summary["map"]["path"])).manifest.checksum
    assert result.header["calibration"]["fx"] == origin.camera.fx
    assert result.header["device"]["cores"] >= 1


def test_replay_of_recorded_frames_gives_the_messages_of_the_replay(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text('[recorder]\nframes = "all"\nframe_format = "png"\n')
    replay(folder, None, tmp_path / "a", configs=[tmp_path / "c.toml"], nodes=nodes)
    summary = replay(RecordedFrames(tmp_path / "a"), None, tmp_path / "b", configs=[tmp_path / "c.toml"], nodes=nodes)
    first, second = (list(read_flight(tmp_path / name)) for name in ("a", "b"))
    assert first == second and len(first) > 3 * FRAMES
    images = [list(read_frame_images(tmp_path / name)) for name in ("a", "b")]
    assert images[0] == images[1]
    assert summary["source"] == str(tmp_path / "a")


class RunningSum(NodeBase):
    """A stub estimator whose position is the sum of all heights that it has heard."""

    def __init__(self) -> None:
        self.heard: list[int] = []
        self._sum_m = 0.0

    def on(self, message: m.Message) -> Iterable[m.Message]:
        if isinstance(message, m.VehicleState):
            self._sum_m += message.agl_m or 0.0
        elif isinstance(message, m.Odometry):
            self.heard.append(message.frame_id)
            yield estimate(message.frame_id, self._sum_m, 0.0)


class SeenFrames(StubVision):
    def __init__(self, seen: list[int]) -> None:
        self.seen = seen

    def on(self, message: m.Message) -> Iterable[m.Message]:
        if isinstance(message, m.Frame):
            self.seen.append(message.frame_id)
        return super().on(message)


class From:
    """A source without its frames before ``first``."""

    def __init__(self, source: Source, first: int) -> None:
        self._source, self._first = source, first

    def __getattr__(self, name: str) -> object:
        return getattr(self._source, name)

    def shots(self, from_s: float = 0.0) -> Iterator[Shot]:
        return (shot for shot in self._source.shots(from_s) if shot.frame.frame_id >= self._first)


@pytest.mark.parametrize("again_at", [-1, 1])  # frame at which the second replay is ended, too; -1: it is not
def test_a_replay_that_was_ended_goes_on_after_its_last_frame_to_the_same_record(
    folder: Path, tmp_path: Path, again_at: int
) -> None:
    """The estimator has heard all frames once, vision those that the ended replay has not seen."""
    out, killed_at, seen = tmp_path / "out", 3, list[int]()
    replay(folder, None, tmp_path / "whole", nodes=lambda _: {"vision": StubVision(), "estimator": RunningSum()})

    def run(earlier: EarlierPart | None, end_at: int) -> RunningSum:
        estimator = RunningSum()
        first = 0 if earlier is None else earlier.frames

        def end(messages: list[m.Message]) -> None:
            if any(isinstance(message, m.Frame) and message.frame_id == end_at for message in messages):
                raise InterruptedError

        def made(ctx: NodeContext) -> dict[str, Node]:
            assert (ctx.epoch_ns is None) == (earlier is None)
            return {"vision": SeenFrames(seen), "estimator": estimator}

        with suppress(InterruptedError):
            replay(From(open_source(str(folder)), first), None, out, nodes=made, watch=end, earlier=earlier)
        return estimator

    run(None, killed_at)  # after its messages are on the disk, before its results are stored
    if again_at >= 0:
        run(earlier_part(out, killed_at), again_at)  # before it has the whole record of the first one
    seen.clear()
    estimator = run(earlier_part(out, killed_at), -1)
    assert estimator.heard == [*range(FRAMES)] and seen == [*range(killed_at, FRAMES)]
    messages = [[message for _, _, message in read_flight(folder)] for folder in (tmp_path / "whole", out)]
    assert messages[0] == messages[1]
    assert [row.lat_deg for row in read_rows(out / ESTIMATES)] == [
        row.lat_deg for row in read_rows(tmp_path / "whole" / ESTIMATES)
    ]
    assert len(list(read_thumbnails(out))) == FRAMES and not (out / KEPT).exists()
