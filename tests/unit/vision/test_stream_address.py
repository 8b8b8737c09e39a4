"""Addresses of cameras: pipelines, decoders, codecs by their packets, and passwords that are not shown."""

import socket
import threading
import time
from pathlib import Path

import pytest

from simulated_flight import CAMERA
from terrafix.core.config import Config, SourceSection, without_passwords
from terrafix.core.errors import SourceError, UsageError
from terrafix.core.passwords import without_password
from terrafix.recorder.provenance import header
from terrafix.vision.sources.stream_address import (
    codec_of,
    decoder_order,
    is_live,
    is_pipeline,
    listen_for_codec,
    parse_network,
    pipeline_of,
)
from terrafix_tools.replay import replay

JETSON = {"nvarguscamerasrc", "nvvidconv", "nvv4l2decoder", "avdec_h264", "avdec_h265", "jpegdec", "rtmp2src"}
DESKTOP = {"avdec_h264", "avdec_h265", "jpegdec", "rtmp2src"}


def rtp(payload: bytes, kind: int = 96, extension: bytes = b"") -> bytes:
    """A packet with one contributing source, and with ``extension`` (whole 4 bytes) if it is given."""
    first = 0x81 | (0x10 if extension else 0)
    head = bytes([first, kind]) + bytes(10) + b"\x00\x00\x00\x07"
    return head + (b"\xbe\xde" + (len(extension) // 4).to_bytes(2, "big") + extension if extension else b"") + payload


@pytest.mark.parametrize(
    ("spec", "live", "pipeline"),
    [
        ("0", True, False),
        ("/dev/video0", True, False),
        ("csi://0", True, False),
        ("rtsp://u:p!@10.0.0.1/s", True, False),
        ("udp://:5600", True, False),
        ("rtmp://10.0.0.1/live", True, False),
        ("http://10.0.0.1/video", True, False),
        ("gst: videotestsrc", True, True),
        ("videotestsrc ! appsink", True, True),
        ("flights/one", False, False),
        ("film.mp4", False, False),
    ],
)
def test_a_source_is_live_by_the_form_of_its_name(spec: str, live: bool, pipeline: bool) -> None:
    assert (is_live(spec), is_pipeline(spec)) == (live, pipeline)


@pytest.mark.parametrize("elements", [JETSON, DESKTOP])
@pytest.mark.parametrize(
    "spec", ["rtsp://h/s", "rtmp://h/s", "udp://:1", "/dev/video3", "gst: a ! b ! appsink", "a ! b"]
)
def test_every_pipeline_ends_in_one_sink_that_holds_the_newest_image_alone(spec: str, elements: set[str]) -> None:
    text = pipeline_of(spec, CAMERA, "H264", elements.__contains__)
    assert text.count("appsink") == 1 and text.rstrip().split(" ! ")[-1].startswith("appsink")
    assert "drop=true max-buffers=1 sync=false" in text
    assert ("nvvidconv" in text) == (elements is JETSON)  # takes images out of the decoder's memory


def test_csi_is_the_source_of_the_computer_in_the_described_size() -> None:
    size = f"width={CAMERA.width},height={CAMERA.height}"
    text = pipeline_of("csi://1", CAMERA, "", JETSON.__contains__)
    assert text.startswith(f"nvarguscamerasrc name=source sensor-id=1 ! video/x-raw(memory:NVMM),{size},")
    assert pipeline_of("csi://0", CAMERA, "", {"libcamerasrc"}.__contains__).startswith("libcamerasrc name=source ! ")
    with pytest.raises(SourceError, match="nvidia-l4t-gstreamer"):
        pipeline_of("csi://0", CAMERA, "", DESKTOP.__contains__)
    with pytest.raises(SourceError, match="number of the sensor"):
        pipeline_of("csi://front", CAMERA, "", JETSON.__contains__)


def test_decoders_of_hardware_are_preferred_to_software() -> None:
    assert decoder_order(JETSON.__contains__)[0] == "nvv4l2decoder"
    assert decoder_order({"v4l2h264dec", "avdec_h264"}.__contains__) == ["v4l2h264dec", "avdec_h264"]
    assert decoder_order(DESKTOP.__contains__) == ["avdec_h264", "avdec_h265", "jpegdec"]


@pytest.mark.parametrize(
    ("packets", "codec"),
    [
        ([rtp(b"\x67\x42\x00\x1f")], ("H264", 96)),  # SPS
        ([rtp(b"\x7c\x85\x00")], ("H264", 96)),  # fragment of a key frame
        ([rtp(b"\x06\x05\x10"), rtp(b"\x41\x9a\x00")], ("H264", 96)),  # SEI alone could be H.265
        ([rtp(b"\x40\x01\x0c"), rtp(b"\x42\x01\x01"), rtp(b"\x62\x01\x93")], ("H265", 96)),  # VPS, SPS, fragment
        ([rtp(b"\x42\x01\x01", 97, bytes(8))], ("H265", 97)),
        ([rtp(bytes(20), 26)], ("JPEG", 26)),
        ([rtp(b"\x47" + bytes(187), 33)], ("MP2T", 33)),
        ([b"\x47" + bytes(187)], ("", 0)),
        ([rtp(bytes(20), 0), b"\x80\xc8\x00"], None),  # audio; a packet that is cut off
        ([b"hello, this is no video", b""], None),
    ],
)
def test_the_codec_of_a_udp_stream_is_that_of_its_packets(packets: list[bytes], codec: tuple[str, int] | None) -> None:
    assert codec_of(packets) == codec


def test_a_port_is_listened_to_until_the_codec_is_known_or_the_source_is_closed() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind(("127.0.0.1", 0))
        port = sender.getsockname()[1]
    stop = threading.Event()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as camera:
            while not stop.wait(0.01):
                camera.sendto(rtp(b"\x67\x42\x00\x1f", 99), ("127.0.0.1", port))

    sending = threading.Thread(target=send)
    sending.start()
    found = listen_for_codec(parse_network(f"udp://127.0.0.1:{port}"), lambda: False)
    stop.set()
    sending.join()
    assert found == ("H264", 99)
    began_s = time.monotonic()
    with pytest.raises(SourceError, match="nothing arrives"):
        listen_for_codec(parse_network(f"udp://127.0.0.1:{port}"), lambda: True)
    assert time.monotonic() - began_s < 1.0


def test_user_and_password_are_taken_out_of_the_address() -> None:
    found = parse_network("rtsp://me:p%40ss%2F@[::1]:8554/live?x=1")
    assert (found.url, found.user, found.password, found.port) == ("rtsp://[::1]:8554/live?x=1", "me", "p@ss/", 8554)
    for wrong, todo in (("rtsp://h:port/s", "not an address"), ("udp://host", "no port"), ("rtsp:///s", "no host")):
        with pytest.raises(SourceError, match=todo):
            parse_network(wrong)


@pytest.mark.parametrize(
    "spec",
    [
        "rtsp://admin:hunter2@10.0.0.1/s",
        "rtsp://admin:hun@ter2@10.0.0.1/s",
        "rtsp://10.0.0.1/user=admin&password=hunter2&channel=1",
        "rtspsrc location=rtsp://h/s user-id=admin user-pw=hunter2 ! decodebin",
        'rtspsrc user-pw="hunter2 x" location=rtsp://h/s ! decodebin',
        "cannot open rtsp://admin:hunter2@h/s, and rtsp://admin:hunter2@h/t",
    ],
)
def test_no_password_is_shown(spec: str) -> None:
    shown = without_password(spec)
    assert "ter2" not in shown and "***" in shown and ("admin" not in spec or "admin" in shown)
    config = Config(source=SourceSection(path=spec))
    assert without_passwords(config).source.path == shown
    assert "ter2" not in str(header(config)) and shown in header(config)["config"].replace('\\"', '"')


def test_an_address_without_a_password_is_shown_as_it_is() -> None:
    for spec in ("rtsp://10.0.0.1:554/s?user=a", "udp://:5600", "/dev/video0", "v4l2src ! jpegdec", "flights/a@b:c"):
        assert without_password(spec) == spec


@pytest.mark.parametrize("flight", ["rtsp://a:hunter2@h/s", Path("rtsp://a:hunter2@h/s"), "/dev/video77"])
def test_a_camera_is_not_replayed_nor_its_password_shown(flight: str | Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="a live camera cannot be replayed") as refused:
        replay(flight, None, tmp_path / "out")
    assert "hunter2" not in str(refused.value)
