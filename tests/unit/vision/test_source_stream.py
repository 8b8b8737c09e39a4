"""Frames over HTTP: exposure times, lost connections, other cameras, and a stream to the real source."""

import http.server
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from source_folders import HEIGHT, TOML, WIDTH, jpeg, picture
from terrafix.core.clock import now_ns
from terrafix.core.errors import SourceError, UsageError
from terrafix.vision.sources import Shot, Source, open_source
from terrafix.vision.sources.capture import STALL_S
from terrafix_lab.sim.camera.stream import FrameStream

pytestmark = pytest.mark.real_time


@pytest.fixture
def description(tmp_path: Path) -> Path:
    path = tmp_path / "camera.toml"
    path.write_text(TOML)
    return path


@pytest.fixture
def watch() -> Iterator[Callable[[Source], list[Shot]]]:
    """``watch(source)``: a list to which a thread appends the shots, as in flight."""
    running: list[tuple[Source, threading.Thread]] = []

    def start(source: Source) -> list[Shot]:
        seen: list[Shot] = []
        thread = threading.Thread(target=lambda: seen.extend(source.shots()))
        thread.start()
        running.append((source, thread))
        return seen

    yield start
    for source, thread in running:
        source.close()
        thread.join(10.0)
        assert not thread.is_alive()


def until(true: Callable[[], bool], limit_s: float = 20.0) -> None:
    end_s = time.monotonic() + limit_s
    while not true():
        assert time.monotonic() < end_s, "never happened"
        time.sleep(0.005)


def test_mjpeg_frames_carry_their_exposure_times(description: Path, watch: Callable[[Source], list[Shot]]) -> None:
    with FrameStream(jpeg_quality=95) as stream:
        source = open_source(stream.url, camera=description, rate_hz=100.0)
        assert source.live
        seen = watch(source)
        assert stream.wait_for_viewer(10.0)
        base_ns = now_ns() - 900_000_000  # exposed long before they are sent, like delayed frames
        for i in range(5):
            stream.push(picture(i), base_ns + i * 50_000_001)
        until(lambda: len(seen) == 5)
    assert [s.frame.t_ns - base_ns for s in seen] == [i * 50_000_001 for i in range(5)]
    assert [s.frame.frame_id for s in seen] == list(range(5))
    for i, shot in enumerate(seen):
        assert shot.image is not None and shot.image.shape == (HEIGHT, WIDTH, 3)
        assert float(np.abs(shot.image.astype(float) - picture(i)).mean()) < 6.0


def test_images_that_come_more_than_two_seconds_after_their_stamp_are_left_out(
    description: Path, watch: Callable[[Source], list[Shot]]
) -> None:
    with FrameStream() as stream:
        seen = watch(open_source(stream.url, camera=description, rate_hz=100.0))
        assert stream.wait_for_viewer(10.0)
        begin_ns = now_ns()
        stream.push(picture(0), begin_ns - 1_000_000_000)
        until(lambda: len(seen) == 1)
        for i in range(3):  # the camera's clock is wrong, or its buffer is long
            stream.push(picture(i), begin_ns - 2_100_000_000 + i)
            time.sleep(0.05)
        in_time_ns = now_ns()
        stream.push(picture(1), in_time_ns)
        until(lambda: len(seen) == 2)
    assert [shot.frame.t_ns for shot in seen] == [begin_ns - 1_000_000_000, in_time_ns]
    assert [shot.frame.frame_id for shot in seen] == [0, 1]


def test_a_lost_stream_is_reconnected(description: Path, watch: Callable[[Source], list[Shot]]) -> None:
    first = FrameStream()
    port = int(first.url.rstrip("/").rsplit(":", 1)[1])
    seen = watch(open_source(first.url, camera=description, rate_hz=1e6))
    assert first.wait_for_viewer(10.0)
    first.push(picture(0), now_ns())
    until(lambda: len(seen) == 1)
    first.close()
    with FrameStream(port) as second:
        assert second.wait_for_viewer(20.0)
        second.push_jpeg(b"no picture", now_ns())
        second.push(picture(1, 160, 120), now_ns())
        second.push(picture(2), now_ns())
        until(lambda: len(seen) >= 4)
    errors = [s.frame.error for s in seen]
    assert errors[0] == "" and "decoded" in errors[1] and "wrong size: 160x120" in errors[2] and errors[3] == ""


@pytest.mark.parametrize("answered", [False, True])
def test_closing_does_not_wait_for_a_camera_that_is_connected_and_sends_nothing(
    description: Path, answered: bool
) -> None:
    head = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=b\r\n\r\n"
    with socket.create_server(("127.0.0.1", 0)) as camera:
        url = f"http://127.0.0.1:{camera.getsockname()[1]}/"
        opened: list[Source] = []
        reading = threading.Thread(target=lambda: opened.append(open_source(url, camera=description)))
        reading.start()
        connection, _ = camera.accept()
        connection.sendall(head)
        reading.join(10.0)
        reading = threading.Thread(target=lambda: list(opened[0].shots()))
        reading.start()
        if not answered:
            connection.close()  # the source connects again
            connection, _ = camera.accept()
        with connection:
            connection.recv(4096)
            time.sleep(0.1)
            closed_s = time.monotonic()
            opened[0].close()
            reading.join(10.0)
    assert not reading.is_alive() and time.monotonic() - closed_s < STALL_S / 2


def test_a_slow_mjpeg_client_does_not_block_the_server(description: Path) -> None:
    with FrameStream() as stream:
        source = open_source(stream.url, camera=description, rate_hz=1000.0)
        assert stream.wait_for_viewer(10.0)
        blank = jpeg(0)
        for i in range(3000):
            stream.push_jpeg(blank + bytes(20_000), i)  # 60 MB: more than any socket holds
        shots = source.shots()
        assert next(shots).image is not None
        source.close()
        shots.close()  # type: ignore[attr-defined]


class ForeignCamera(http.server.BaseHTTPRequestHandler):
    """Sends no lengths or times, and a boundary with the dashes in the header, as some cameras do."""

    def do_GET(self) -> None:
        if self.path != "/video":
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace;boundary=--cam")
        self.end_headers()
        for i in range(3):
            self.wfile.write(b"--cam\r\nContent-Type: image/jpeg\r\n\r\n" + jpeg(i) + b"\r\n")
        self.wfile.write(b"--cam--\r\n")

    def log_message(self, format: str, *args: object) -> None:
        pass


def test_an_mjpeg_stream_without_lengths_and_times_is_read(description: Path) -> None:
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), ForeignCamera)
    threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
    address = f"http://127.0.0.1:{server.server_address[1]}"
    try:
        began_ns = now_ns()
        source = open_source(f"{address}/video", camera=description, rate_hz=1e6)
        shots = source.shots()
        taken = [next(shots) for _ in range(3)]
        assert began_ns <= taken[0].frame.t_ns <= taken[2].frame.t_ns <= now_ns()
        for i, shot in enumerate(taken):
            assert shot.image is not None
            assert np.array_equal(shot.image, cv2.imdecode(np.frombuffer(jpeg(i), np.uint8), cv2.IMREAD_COLOR))
        source.close()
        shots.close()  # type: ignore[attr-defined]
        with pytest.raises(SourceError, match=r"answers 404 .*, not an MJPEG stream"):
            open_source(f"{address}/", camera=description)
    finally:
        server.shutdown()
        server.server_close()


def test_stream_errors_are_one_line(description: Path) -> None:
    with FrameStream() as stream:
        url = stream.url
        with pytest.raises(UsageError, match="cannot be streamed there"):
            FrameStream(int(url.rstrip("/").rsplit(":", 1)[1]))
        with pytest.raises(SourceError, match=r"set \[source\] camera"):
            open_source(url)
    with pytest.raises(SourceError, match="no response from the stream"):
        open_source(url, camera=description)
    with pytest.raises(SourceError, match="no response from the stream"):
        open_source("http://127.0.0.1:99999/", camera=description)
    source = open_source(url, camera=description, wait_for_camera=True)  # a restart in flight
    source.close()
