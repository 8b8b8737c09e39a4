"""Videos, cameras and telemetry logs: sources with their own clock."""

import math
import struct
import threading
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from source_folders import HEIGHT, TOML, WIDTH, flight, picture
from terrafix.core.clock import now_ns
from terrafix.core.config import HealthSection
from terrafix.core.errors import SourceError
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.mavlink.tlog import read_tlog
from terrafix.messages import STAMP_SIGMA_S, Camera, Frame
from terrafix.vision.edge import SourceEdge
from terrafix.vision.frame_rate import FrameRateLimit
from terrafix.vision.sources import open_source
from terrafix.vision.sources.camera import LiveCamera
from terrafix.vision.sources.capture import Stamp

T0_US = 1_700_000_000_000_000
DESCRIPTION = TOML.replace("[start]\nlat_deg = 48.0\nlon_deg = 2.0\n", "")


def video(path: Path, seconds: float = 3.0, fps: float = 10.0) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, (WIDTH, HEIGHT))
    assert writer.isOpened()
    for i in range(round(seconds * fps)):
        writer.write(np.full((HEIGHT, WIDTH, 3), i * 8, np.uint8))
    writer.release()
    path.with_suffix(".toml").write_text(TOML)
    return path


def test_a_video_is_sampled_by_its_timestamps(tmp_path: Path) -> None:
    path = video(tmp_path / "flight.mp4")
    path.with_suffix(".csv").write_text("t_s,agl_m\n0,50\n0.2,51\n0.4,52\n")
    source = open_source(str(path))
    shots = list(source.shots())
    assert [round(s.frame.t_ns / 1e9, 3) for s in shots] == [0.0, 0.5, 1.0, 1.5, 2.0, 2.5]
    assert [s.frame.frame_id for s in shots] == list(range(6))
    assert source.length() == 6
    for i, shot in enumerate(shots):  # the image is the one of that time
        assert shot.image is not None and abs(float(shot.image.mean()) - i * 40) < 6
    assert [[s.agl_m for s in shot.states] for shot in shots[:2]] == [[50.0], [51.0, 52.0]]
    again = list(source.shots(from_s=1.2))
    assert [(s.frame.frame_id, s.frame.file) for s in again] == [(s.frame.frame_id, s.frame.file) for s in shots[3:]]
    every = list(open_source(str(path), rate_hz=30).shots())
    assert len(every) == 30


def test_subtitles_of_dji_are_the_telemetry_of_a_video_without_a_table(tmp_path: Path) -> None:
    path = video(tmp_path / "flight.mp4", 1.0)
    path.with_suffix(".SRT").write_text("1\n00:00:00,200 --> 00:00:00,233\n[rel_alt: 61.3 abs_alt: 590.1]\n")
    states = [state for shot in open_source(str(path)).shots() for state in shot.states]
    assert [(state.t_ns, state.agl_m) for state in states] == [(200_000_000, 61.3)]
    path.with_suffix(".csv").write_text("t_s,agl_m\n0.3,50\n")
    states = [state for shot in open_source(str(path)).shots() for state in shot.states]
    assert [state.agl_m for state in states] == [50.0]


def test_invalid_videos_are_reported(tmp_path: Path) -> None:
    path = video(tmp_path / "flight.mp4", 1.0)
    path.with_suffix(".toml").write_text(TOML.replace("width = 320", "width = 640"))
    with pytest.raises(SourceError, match="the video is 320x240"):
        open_source(str(path))
    path.with_suffix(".toml").unlink()
    with pytest.raises(SourceError, match=r"'terrafix camera calibrate'.*--out .*flight\.toml"):
        open_source(str(path))
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(path.read_bytes()[:500])
    broken.with_suffix(".toml").write_text(TOML)
    with pytest.raises(SourceError, match="cannot be opened as a video"):
        open_source(str(broken))


class FakeCamera:
    """A device that delivers ``frames`` images and is then unplugged."""

    def __init__(self, frames: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
        self.left, self.decoded, self.shape, self.released = frames, 0, size, False
        self.why = "unplugged"

    def grab(self) -> bool:
        self.left -= 1
        return self.left >= 0

    def retrieve(self) -> tuple[bool, np.ndarray]:
        self.decoded += 1
        return True, picture(self.left, *self.shape)

    def stamp(self, arrival_ns: int) -> Stamp:
        return Stamp(arrival_ns, True, STAMP_SIGMA_S)

    def size(self) -> tuple[int, int]:
        return self.shape

    def described(self) -> str:
        return "a fake"

    def release(self) -> None:
        self.released = True


def live(tmp_path: Path, devices: Iterable[FakeCamera | None], wait: bool = False) -> LiveCamera:
    description = tmp_path / "camera.toml"
    description.write_text(DESCRIPTION)
    supply = iter(devices)

    def plug(spec: str, camera: Camera) -> FakeCamera:
        if (device := next(supply, None)) is None:
            raise SourceError(f"{spec}: the camera cannot be opened")
        return device

    return LiveCamera("0", (1.0, 2.0), description, 1e6, open_capture=plug, reconnect_s=0.001, wait=wait)


def test_an_unplugged_camera_is_reconnected(tmp_path: Path) -> None:
    first, second = FakeCamera(2), FakeCamera(3)
    camera = live(tmp_path, [first, None, None, second])
    began_ns = now_ns()
    shots = camera.shots()
    taken = [next(shots) for _ in range(5)]
    assert [s.frame.frame_id for s in taken] == [0, 1, 2, 3, 4]
    times = [s.frame.t_ns for s in taken]
    assert times == sorted(times) and began_ns <= times[0] <= now_ns()
    assert first.released and camera.spec == "/dev/video0" and camera.live
    threading.Timer(0.05, camera.close).start()
    assert list(shots) == []  # ends when it is closed, also without a camera
    assert second.released


def test_images_of_a_camera_that_are_not_taken_are_not_decoded(tmp_path: Path) -> None:
    device, asked_ns, frames = FakeCamera(9), list[int](), list[Frame]()
    rate = FrameRateLimit(HealthSection())
    rate.takes_frame = lambda t_ns: asked_ns.append(t_ns) or len(asked_ns) % 3 == 1  # type: ignore[method-assign, func-returns-value]
    edge = SourceEdge(live(tmp_path, [device]), MemoryFrameStore(), None, True, rate=rate)
    while len(frames) < 3:
        frames += [one for one in edge.poll(now_ns()) if isinstance(one, Frame)]
    edge.close()
    assert [frame.frame_id for frame in frames] == [0, 3, 6] and device.decoded == 3
    assert [frame.t_ns for frame in frames] == asked_ns[::3] and len(asked_ns) == 9


def test_a_camera_of_another_size_or_a_missing_camera_is_reported(tmp_path: Path) -> None:
    small = FakeCamera(1, (160, 120))
    with pytest.raises(SourceError, match="the camera gives 160x120, its description says 320x240"):
        live(tmp_path, [small])
    assert small.released
    with pytest.raises(SourceError, match="cannot be opened"):
        live(tmp_path, [])
    late = live(tmp_path, [None, FakeCamera(1)], wait=True)
    assert next(late.shots()).image is not None
    probed = FakeCamera(1)
    live(tmp_path, [probed]).close()
    assert probed.released


def test_missing_camera_settings_are_reported(tmp_path: Path) -> None:
    description = tmp_path / "camera.toml"
    description.write_text(DESCRIPTION)
    with pytest.raises(SourceError, match=r"set \[source\] camera"):
        open_source("/dev/video77")
    with pytest.raises(SourceError, match="/dev/video77: the camera cannot be opened"):
        open_source("77", camera=description, start=(1.0, 2.0))


@pytest.mark.parametrize("name", sorted(p.name for p in (Path(__file__).parents[3] / "config/cameras").glob("*.toml")))
def test_the_camera_examples_are_valid(name: str) -> None:
    description = Path(__file__).parents[3] / "config" / "cameras" / name
    with pytest.raises(SourceError, match="cannot be opened"):
        open_source("77", camera=description, start=(1.0, 2.0))


def record(offset_s: float, message: mavlink.MAVLink_message, component: int = 1, mavlink1: bool = False) -> bytes:
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=component)
    packet = message.pack(sender, force_mavlink1=mavlink1)
    return struct.pack(">Q", T0_US + round(offset_s * 1e6)) + bytes(packet)


def attitude(offset_s: float, yaw: float, component: int = 1) -> bytes:
    return record(offset_s, mavlink.MAVLink_attitude_message(0, 0.1, -0.2, yaw, 0, 0, 0), component)


def height(offset_s: float, relative_m: float) -> bytes:
    position = mavlink.MAVLink_global_position_int_message(
        0, 480000000, 20000000, 250000, int(relative_m * 1e3), 0, 0, 0, 0
    )
    return record(offset_s, position, mavlink1=True)


def hud(offset_s: float, alt_m: float) -> bytes:
    return record(offset_s, mavlink.MAVLink_vfr_hud_message(0, 0, 350, 0, alt_m, 0))


def test_a_tlog_yields_attitude_and_height(tmp_path: Path) -> None:
    log = tmp_path / "t.tlog"
    log.write_bytes(attitude(0, 1.0) + hud(0.1, 300) + height(0.5, 80.5) + attitude(1, 1.1) + attitude(1.2, 2, 154))
    states = read_tlog(log)
    assert [(s.t_ns, s.agl_m) for s in states] == [(0, None), (500_000_000, 80.5), (10**9, None)]
    assert (states[0].roll_rad, states[0].pitch_rad, states[2].yaw_rad) == pytest.approx((0.1, -0.2, 1.1))
    assert all(s.source == "mavlink" and s.velocity_enu_mps is None for s in states)
    assert read_tlog(log, T0_US + 250_000)[0].t_ns == -250_000_000


def test_a_tlog_with_few_messages_is_read(tmp_path: Path) -> None:
    log = tmp_path / "t.tlog"
    log.write_bytes(hud(0, 300) + hud(1, 340))
    states = read_tlog(log)
    assert [s.agl_m for s in states if s.agl_m is not None] == [0, 40]
    assert [s.yaw_rad for s in states if s.yaw_rad is not None] == pytest.approx([math.radians(-10)] * 2)


def test_damage_in_a_tlog_loses_the_damaged_records_only(tmp_path: Path) -> None:
    log = tmp_path / "t.tlog"
    good = [attitude(i, 0.1 * i) for i in range(5)]
    crc = bytearray(good[1])
    crc[-1] ^= 0xFF
    log.write_bytes(good[0] + bytes(crc) + good[2] + b"\xfd\xfe garbage \xfd" * 3 + good[3] + good[4][:-5])
    assert [s.t_ns // 10**9 for s in read_tlog(log)] == [0, 2, 3]
    log.write_bytes(b"not a log, " * 50)
    with pytest.raises(SourceError, match="holds no MAVLink record"):
        read_tlog(log)


def test_a_flight_folder_with_a_tlog_needs_only_file_and_time(tmp_path: Path) -> None:
    rows = "\n".join(f"{i:04}.jpg,{i * 0.5}" for i in range(3))
    toml = TOML.replace("yaw_sigma_deg = 3.0", f"yaw_sigma_deg = 3.0\ntlog_t0_us = {T0_US}")
    folder = flight(tmp_path / "f", 3, toml=toml, csv=f"file,t_s\n{rows}\n")
    records = [attitude(t, t) for t in (-1.0, 0.0, 0.2, 0.4, 0.9, 7.0)]
    (folder / "telemetry.tlog").write_bytes(b"".join(records))
    shots = list(open_source(str(folder)).shots())
    assert [[round(s.t_ns / 1e9, 1) for s in shot.states] for shot in shots] == [[0.0], [0.2, 0.4], [0.9]]
