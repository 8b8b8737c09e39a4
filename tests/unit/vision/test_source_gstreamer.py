"""A real RTSP server: its images and their times, a refused password, another size, a server that goes and returns, and
encoded images after lost packets."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import IntFlag
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from rtsp_server import ABSENT
from source_folders import HEIGHT, TOML, WIDTH
from terrafix.core.clock import now_ns
from terrafix.core.errors import SourceError
from terrafix.vision.sources import open_source
from terrafix.vision.sources.capture import NETWORK_SIGMA_S
from terrafix.vision.sources.contract import Timing
from terrafix.vision.sources.gst import _UndamagedImages, gstreamer

PROGRAM = Path(__file__).parents[2] / "rigs" / "rtsp_server.py"
real = pytest.mark.real_time
# PyGObject 3.42 imports as Python 3.3 did.
pytestmark = pytest.mark.filterwarnings("ignore:DynamicImporter:ImportWarning")


@contextmanager
def serving(*arguments: object) -> Iterator[tuple[str, Callable[[], None]]]:
    """-> address of the stream without "rtsp://", and what kills the server."""
    if gstreamer()[0] is None:
        pytest.skip("needs GStreamer: docs/camera.md#gstreamer, and gir1.2-gst-rtsp-server-1.0")
    command = [sys.executable, str(PROGRAM), *map(str, arguments)]
    server = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        port = server.stdout.readline().strip()
        if not port and server.wait() == ABSENT:
            pytest.skip("needs gir1.2-gst-rtsp-server-1.0 gstreamer1.0-plugins-ugly gstreamer1.0-libav")
        yield f"127.0.0.1:{port}/camera", server.kill
    finally:
        server.kill()
        server.communicate()


@pytest.fixture
def description(tmp_path: Path) -> Path:
    path = tmp_path / "camera.toml"
    path.write_text(TOML)
    return path


@real
def test_images_of_a_camera_behind_a_password_are_stamped_before_they_arrive_and_its_end_is_said(
    description: Path,
) -> None:
    with serving(WIDTH, HEIGHT, "pilot:s3cret") as (address, kill):
        for login in ("", "pilot:wr0ng@"):
            with pytest.raises(SourceError, match="refuses user and password") as refused:
                open_source(f"rtsp://{login}{address}", camera=description)
            assert "wr0ng" not in str(refused.value)
        timing = Timing(0.5, 0.0)
        source = open_source(f"rtsp://pilot:s3cret@{address}", camera=description, rate_hz=30.0, timing=timing)
        began_ns, shots = now_ns(), source.shots()
        seen = [next(shots) for _ in range(5)]
        assert all(shot.image is not None and shot.image.shape == (HEIGHT, WIDTH, 3) for shot in seen)
        assert not np.array_equal(seen[0].image, seen[4].image)  # type: ignore[arg-type]
        assert all(began_ns - 2e9 < shot.frame.t_ns <= now_ns() - 0.5e9 for shot in seen)
        assert all(shot.frame.buffered and shot.frame.stamp_sigma_s < NETWORK_SIGMA_S for shot in seen)
        said = " ".join(fact.text for fact in source.facts())  # type: ignore[attr-defined]
        assert "avdec_h264" in said and "s3cret" not in said
        capture = source._capture  # type: ignore[attr-defined]
        kill()
        while capture.grab():
            pass
        assert "ended the stream" in capture.why or "no connection" in capture.why
        shots.close()  # type: ignore[attr-defined]
    with pytest.raises(SourceError, match="no connection"):
        open_source(f"rtsp://{address}", camera=description)


@real
def test_a_stream_of_another_size_than_described_is_refused(description: Path) -> None:
    with serving(2 * WIDTH, HEIGHT) as (address, _), pytest.raises(SourceError, match=f"gives {2 * WIDTH}x{HEIGHT}"):
        open_source(f"rtsp://{address}", camera=description)


class Flags(IntFlag):
    DISCONT = 1
    DELTA_UNIT = 2


def test_after_a_lost_packet_no_image_is_decoded_before_the_next_whole_key_frame() -> None:
    passes = _UndamagedImages(SimpleNamespace(BufferFlags=Flags, PadProbeReturn=SimpleNamespace(DROP="drop", OK="ok")))

    def of(flags: Flags) -> str:
        info = Mock()
        info.get_buffer.return_value.get_flags.return_value = flags
        return str(passes(None, info))

    key, delta, lost = Flags(0), Flags.DELTA_UNIT, Flags.DISCONT
    assert [of(f) for f in (delta | lost, delta, key, delta)] == ["drop", "drop", "ok", "ok"]  # joined in between
    assert [of(f) for f in (delta | lost, delta, key, delta)] == ["drop", "drop", "ok", "ok"]
    assert [of(f) for f in (key | lost, delta, key)] == ["drop", "drop", "ok"]  # a key frame may lack a part itself
