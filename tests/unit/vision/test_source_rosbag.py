"""Bags of ROS 1 and ROS 2 as flights, written and read back by rosbags: images, camera, telemetry, truth."""

import builtins
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("rosbags", reason="needs rosbags: pip install 'terrafix[rosbag]'")

from ros_bags import (
    BEGAN_NS,
    FOCAL_PX,
    IMAGE_HZ,
    IMAGES,
    KINDS,
    LAT_DEG,
    LON_DEG,
    PITCH_RAD,
    ROLL_RAD,
    YAW_RAD,
    write_bag,
)
from source_folders import picture
from terrafix.core.errors import SourceError
from terrafix.core.geodesy import rot_from_quat
from terrafix.messages import GimbalAttitude
from terrafix.vision.sources import open_source
from terrafix.vision.sources.facts import facts_of
from terrafix_tools import cli

ENDING = {"ros1": ".bag", "sqlite3": "", "mcap": ""}


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("bags")
    return {kind: write_bag(folder / f"flight-{kind}{ENDING[kind]}", kind) for kind in KINDS}


def said(source: Any) -> str:
    return "\n".join(f"{fact.topic}: {fact.text}" for fact in facts_of(source))


@pytest.mark.parametrize("kind", KINDS)
def test_images_and_camera_of_a_bag(bags: dict[str, Path], kind: str) -> None:
    source = open_source(str(bags[kind]), rate_hz=IMAGE_HZ)
    camera = source.origin().camera
    assert (camera.width, camera.height, camera.fx, camera.cx, camera.cy) == (320, 240, FOCAL_PX, 161.0, 119.0)
    assert camera.distortion == (0.01, -0.02, 0.0, 0.0, 0.0) and camera.mount_pitch_deg == -90.0
    shots = list(source.shots())
    assert [shot.frame.t_ns for shot in shots] == [round(i / IMAGE_HZ * 1e9) for i in range(IMAGES)]
    assert source.length() == len(shots) and not any(shot.frame.error for shot in shots)
    assert all(np.array_equal(shot.image, picture(i, 320, 240)) for i, shot in enumerate(shots))  # type: ignore[arg-type]
    assert [shot.frame.frame_id for shot in source.shots(from_s=1.0)] == list(range(4, IMAGES))
    slower = open_source(str(bags[kind]), rate_hz=2.0)
    assert [shot.frame.t_ns for shot in slower.shots()] == [
        round(i / 2 * 1e9) for i in range(5)
    ] and slower.length() == 5


@pytest.mark.parametrize("kind", KINDS)
def test_telemetry_of_a_bag_is_in_the_axes_of_the_vehicle(bags: dict[str, Path], kind: str) -> None:
    """REP 103: forward, left, up in east, north, up; Terrafix: forward, right, down, heading from north."""
    shots = list(open_source(str(bags[kind]), rate_hz=IMAGE_HZ).shots())
    states = [state for shot in shots for state in shot.states]
    turned = [state for state in states if state.roll_rad is not None]
    assert len(turned) > 90
    for state in turned[::10]:
        assert (state.pitch_rad, state.roll_rad) == pytest.approx((PITCH_RAD, ROLL_RAD))
        assert state.yaw_rad == pytest.approx(YAW_RAD + 0.01e-9 * state.t_ns, abs=1e-6)
    headings = [s.yaw_rad for s in states if s.roll_rad is None and s.yaw_rad is not None]
    assert headings[0] == pytest.approx(math.radians(271.5 - 360.0)) and len(headings) > 90
    heights = [(state.t_ns, state.agl_m) for state in states if state.agl_m is not None]
    assert all(height_m == pytest.approx(80.0 + t_ns * 1e-9, abs=0.021) for t_ns, height_m in heights)
    assert {bool(state.armed) for state in states if state.t_ns < 0.9e9} == {False}
    assert {bool(state.armed) for state in states if state.t_ns > 1.1e9} == {True}
    samples = [sample for shot in shots for batch in shot.imu for sample in batch.samples]
    assert len(samples) > 80 and samples[3][1:] == pytest.approx((1.0, -2.0, -9.8, 0.1, -0.2, -0.3))
    gimbal = next(one for shot in shots for one in shot.others if isinstance(one, GimbalAttitude))
    assert gimbal.from_north and gimbal.device == 154
    assert rot_from_quat(gimbal.q) @ np.array([1.0, 0.0, 0.0]) == pytest.approx([0.0, 0.0, 1.0], abs=1e-6)  # down


def test_positions_of_a_bag_are_truth_and_nothing_else(bags: dict[str, Path], tmp_path: Path) -> None:
    source = open_source(str(bags["mcap"]), rate_hz=IMAGE_HZ)
    assert not math.isfinite(source.origin().start_sigma_m)  # no start from NavSatFix
    assert "/mavros/global_position/global is truth" in said(source)
    out = tmp_path / "truth.csv"
    run = CliRunner().invoke(cli.app, ["source", "truth", str(bags["mcap"]), "--out", str(out)])
    assert run.exit_code == 0, run.output
    rows = [line.split(",") for line in out.read_text().splitlines()]
    files = [shot.frame.file for shot in open_source(str(bags["mcap"])).shots()]
    assert rows[0] == ["file", "lat_deg", "lon_deg"] and [row[0] for row in rows[1:]] == files[1:]
    for name, lat_deg, lon_deg in rows[1:]:
        t_s = float(name.partition("@")[2])
        assert (float(lat_deg), float(lon_deg)) == pytest.approx((LAT_DEG + 1e-5 * t_s, LON_DEG), abs=1e-9)


@pytest.mark.parametrize("encoding", ["rgb8", "bgra8", "mono8", "mono16", "bayer_rggb8", "jpeg"])
def test_images_of_every_usual_encoding_are_bgr(tmp_path: Path, encoding: str) -> None:
    path = write_bag(tmp_path / "e.bag", "ros1", encoding=encoding)
    image = next(iter(open_source(str(path)).shots())).image
    assert image is not None and image.shape == (240, 320, 3)
    expected = picture(0, 320, 240)
    if encoding.startswith("mono"):
        expected = np.repeat(expected[:, :, 1:2], 3, axis=2)
    off = np.abs(image.astype(int) - expected)
    assert off.max() == 0 if encoding in ("rgb8", "bgra8", "mono8", "mono16") else off[2:-2, 2:-2].mean() < 12.0
    swapped = np.abs(image[:, :, ::-1].astype(int) - expected)[2:-2, 2:-2].mean()
    assert encoding.startswith("mono") or off[2:-2, 2:-2].mean() < 0.7 * swapped  # blue and red are where they belong


def test_several_topics_are_asked_for_and_chosen(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "two.bag", "ros1", cameras=2)
    with pytest.raises(
        SourceError, match=r"several topics could be the image: /cam0/image_raw, /cam1/image_raw; choose"
    ):
        open_source(str(path))
    chosen = open_source(str(path), topics={"image": "/cam1/image_raw"})
    assert "CameraInfo of /cam1/camera_info" in said(chosen) and "imu /mavros/imu/data," in said(chosen)
    without = open_source(str(path), topics={"image": "/cam1/image_raw", "imu": "/mavros/imu/data_raw", "heading": ""})
    states = [state for shot in without.shots() for state in shot.states]
    assert all(state.yaw_rad is None for state in states)
    for topics, reason in (
        ({"image": "/cam2/image_raw"}, "has no topic /cam2/image_raw; it has /cam0"),
        ({"image": "/mavros/state"}, "/mavros/state is mavros_msgs/msg/State, which is no image"),
        ({"picture": "/cam0/image_raw"}, r"\[source\] topics has 'picture'; known are image"),
    ):
        with pytest.raises(SourceError, match=reason):
            open_source(str(path), topics=topics)
    run = CliRunner().invoke(cli.app, ["source", "info", str(path), "--topic", "image=/cam1/image_raw"])
    assert run.exit_code == 0 and "image /cam1/image_raw" in run.output


def test_stamps_of_another_clock_give_way_to_the_times_of_recording(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "sim.bag", "ros1", stamps_from_ns=5_000_000_000)
    source = open_source(str(path), rate_hz=IMAGE_HZ)
    shots = list(source.shots())
    assert [shot.frame.t_ns for shot in shots] == [round(i / IMAGE_HZ * 1e9) for i in range(IMAGES)]
    heights = [(s.t_ns, s.agl_m) for shot in shots for s in shot.states if s.agl_m is not None]
    assert all(height_m == pytest.approx(80.03 + t_ns * 1e-9, abs=0.021) for t_ns, height_m in heights)
    assert "times of recording: the stamps are of another clock" in said(source) and BEGAN_NS > 10**18


def test_an_orientation_that_never_changes_is_not_reported(tmp_path: Path) -> None:
    source = open_source(str(write_bag(tmp_path / "s.bag", "ros1", still=True)))
    assert not any(state.roll_rad is not None for shot in source.shots() for state in shot.states)
    assert "orientation of /mavros/imu/data never changes: not reported" in said(source)


def test_a_description_beside_the_bag_is_before_camera_info(bags: dict[str, Path], tmp_path: Path) -> None:
    bare = write_bag(tmp_path / "b.bag", "ros1", k=0.0)
    with pytest.raises(SourceError, match=r"b.bag: .*not calibrated.*b.toml"):
        open_source(str(bare))
    (tmp_path / "b.toml").write_text(
        "[camera]\nwidth=320\nheight=240\nfx=300\nfy=300\ncx=160\ncy=120\n[mount]\npitch_deg=-80\n"
        "[start]\nlat_deg=48\nlon_deg=11\n"
    )
    source = open_source(str(bare))
    camera = source.origin().camera
    assert (camera.fx, camera.mount_pitch_deg, source.origin().lat_deg) == (300.0, -80.0, 48.0)
    assert "[camera] of b.toml" in said(source)


def test_damaged_and_foreign_bags_are_one_clear_line(
    bags: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut = tmp_path / "cut.bag"
    cut.write_bytes(bags["ros1"].read_bytes()[:-2000])
    (tmp_path / "no.bag").write_bytes(b"#ROSBAG V2.0\n")
    (tmp_path / "no.db3").write_bytes(b"x" * 100)
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "metadata.yaml").write_text("rosbag2_bagfile_information: 1\n")
    for name in ("cut.bag", "no.bag", "no.db3", "empty"):
        with pytest.raises(SourceError, match=rf"{name}: the bag cannot be read \(") as caught:
            open_source(str(tmp_path / name))
        assert "\n" not in str(caught.value)
    blind = write_bag(tmp_path / "blind.bag", "ros1", cameras=0)
    with pytest.raises(SourceError, match=r"has no images .*; it has /mavros/battery_hint \(std_msgs/msg/Float64\)"):
        open_source(str(blind))
    real = builtins.__import__

    def missing(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.startswith("rosbags"):
            raise ModuleNotFoundError("no", name="rosbags")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(SourceError, match=r"needs rosbags; install it with: pip install 'terrafix\[rosbag\]'"):
        open_source(str(bags["ros1"]))
