"""Addresses of live cameras, and the GStreamer pipeline of each. No GStreamer is needed here."""

import socket
import time
import urllib.parse
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from terrafix.core.errors import SourceError
from terrafix.messages import Camera

DEVICE = "/dev/"
CSI = "csi://"
RTSP = ("rtsp://", "rtspt://", "rtspu://", "rtsps://")
NETWORK = (*RTSP, "rtmp://", "rtmps://", "udp://")
PIPELINE = "gst:"
HTTP = ("http://", "https://")  # MJPEG: mjpeg.py
# Decoders in order of preference: those of hardware first. Jetson (all codecs); V4L2 stateless (Raspberry Pi 5,
# Rockchip) and stateful (Raspberry Pi 4, i.MX); VA-API; NVIDIA's cards; then software.
HARDWARE_DECODERS = (
    *("nvv4l2decoder", "nvjpegdec"),
    *("v4l2slh264dec", "v4l2slh265dec", "v4l2h264dec", "v4l2h265dec", "v4l2jpegdec"),
    *("vah264dec", "vah265dec", "vajpegdec"),
    *("nvh264dec", "nvh265dec"),
)
SOFTWARE_DECODERS = ("avdec_h264", "avdec_h265", "jpegdec", "avdec_mjpeg", "openh264dec", "libde265dec")
CSI_SOURCES = ("nvarguscamerasrc", "libcamerasrc")  # of a Jetson, of a Raspberry Pi and others
CSI_RATE_HZ = 30  # of the sensor mode; all CSI modules for these computers have one [spec: IMX219, IMX477, IMX708]
# ms that a missing RTP packet is waited for: one that comes later is as good as lost [spec: jitterbuffer of VLC and
# QGroundControl: 60 to 200 ms on radio links]
JITTER_MS = 200
WAIT_FOR_PACKETS_S = 5.0  # of a stream over UDP: the time-out of the other network streams
CODECS = ("H264", "H265", "JPEG", "MP2T")
_STATIC_TYPES = {26: "JPEG", 33: "MP2T"}  # [spec: RFC 3551]
_H265_TYPES = {*range(10), *range(16, 22), *range(32, 41), 48, 49}  # [spec: H.265 table 7-1, RFC 7798]


@dataclass(frozen=True)
class NetworkAddress:
    """``url``: without user and password; ``port``, ``host``: of ``udp://``, host "" is every one."""

    url: str
    user: str
    password: str
    host: str
    port: int


def is_live(spec: str) -> bool:
    """Whether ``spec`` names a camera by its form: a device, an address, or a GStreamer pipeline."""
    return spec.isdecimal() or spec.startswith((DEVICE, CSI, PIPELINE, *NETWORK, *HTTP)) or "!" in spec


def is_pipeline(spec: str) -> bool:
    """An address may contain an exclamation mark, and a pipeline an address."""
    return spec.startswith(PIPELINE) or ("!" in spec and not spec.startswith((DEVICE, CSI, *NETWORK, *HTTP)))


def parse_network(spec: str) -> NetworkAddress:
    """Raises SourceError: no port where one is needed, or not a URL. Its text has no password."""
    try:
        parts = urllib.parse.urlsplit(spec)
        port, host = parts.port or 0, parts.hostname or ""
    except ValueError:
        raise SourceError(
            f"{spec.split('://')[0]}://...: not an address; write for example "
            "rtsp://user:password@192.168.1.10:554/stream, with %40 for @ and %2F for / in the password"
        ) from None
    if parts.scheme == "udp" and not port:
        raise SourceError(f"{spec}: names no port; write udp://:5600")
    if parts.scheme != "udp" and not host:
        raise SourceError(f"{spec}: names no host; write for example {parts.scheme}://192.168.1.10/stream")
    bare = parts._replace(netloc=parts.netloc.rpartition("@")[2]).geturl()
    user, password = (urllib.parse.unquote(part or "") for part in (parts.username, parts.password))
    return NetworkAddress(bare, user, password, host, port)


def pipeline_of(spec: str, camera: Camera, codec: str, exists: Callable[[str], bool]) -> str:
    """Description for ``gst_parse_launch``, ending in an appsink named ``sink`` of NV12 images that holds the newest
    one alone. The address of a network stream is a property of the element ``source``, set by the caller.

    ``codec``: of RTP over UDP, one of CODECS, "" for a bare MPEG transport stream. ``exists(element)``.
    Raises SourceError: an element that the source needs does not exist."""
    # nvvidconv takes images out of the memory of a Jetson's decoders, and takes those of other decoders, too.
    converter = "nvvidconv ! video/x-raw ! " if exists("nvvidconv") else ""
    tail = f"{converter}videoconvert ! video/x-raw,format=NV12 ! appsink name=sink drop=true max-buffers=1 sync=false"
    return f"{_head(spec, camera, codec, exists)} ! {tail}"


def _head(spec: str, camera: Camera, codec: str, exists: Callable[[str], bool]) -> str:
    size = f"width={camera.width},height={camera.height}"
    if is_pipeline(spec):
        elements = [part.strip() for part in spec.removeprefix(PIPELINE).split("!")]
        if elements[-1].split(" ")[0] in ("appsink", ""):
            elements.pop()
        if not elements:
            raise SourceError(f"'{spec}': an empty pipeline; write for example gst: v4l2src ! image/jpeg ! jpegdec")
        return " ! ".join(elements)
    if spec.startswith(CSI):
        sensor = spec.removeprefix(CSI)
        if not sensor.isdecimal():
            raise SourceError(f"{spec}: write the number of the sensor, for example csi://0")
        rate = f"framerate={CSI_RATE_HZ}/1"
        if exists("nvarguscamerasrc"):
            return f"nvarguscamerasrc name=source sensor-id={sensor} ! video/x-raw(memory:NVMM),{size},{rate}"
        if exists("libcamerasrc"):
            if sensor != "0":
                raise SourceError(f"{spec}: libcamera has names, not numbers; write gst: libcamerasrc camera-name=...")
            return f"libcamerasrc name=source ! video/x-raw,{size},{rate}"
        raise SourceError(
            f"{spec}: GStreamer has none of {', '.join(CSI_SOURCES)} here; on a Jetson install nvidia-l4t-gstreamer, "
            "elsewhere gstreamer1.0-libcamera"
        )
    if spec.startswith(DEVICE):
        modes = ";".join(f"{kind},{size}" for kind in ("video/x-raw", "image/jpeg", "video/x-h264", "video/x-h265"))
        return f'v4l2src name=source device={spec} ! capsfilter caps="{modes}" ! decodebin'
    if spec.startswith("udp://"):
        return f"udpsrc name=source ! {f'rtpjitterbuffer latency={JITTER_MS} ! ' if codec else ''}decodebin"
    if spec.startswith(RTSP):
        return "rtspsrc name=source ! application/x-rtp,media=video ! decodebin"
    return f"{'rtmp2src' if exists('rtmp2src') else 'rtmpsrc'} name=source ! decodebin"


def decoder_order(exists: Callable[[str], bool]) -> list[str]:
    """The decoders that exist, the preferred one first."""
    return [name for name in (*HARDWARE_DECODERS, *SOFTWARE_DECODERS) if exists(name)]


def rtp_caps(codec: str, payload: int) -> str:
    """GStreamer's caps of RTP packets with payload type ``payload``."""
    return f"application/x-rtp,media=video,clock-rate=90000,encoding-name={codec},payload={payload}"


def codec_of(packets: Iterable[bytes]) -> tuple[str, int] | None:
    """-> codec (one of CODECS; "": a bare MPEG transport stream) and payload type of a stream over UDP; None: not
    known yet. H.264 and H.265 have dynamic payload types; a packet whose first two bytes are no header of an H.265 unit
    is H.264."""
    seen: tuple[str, int] | None = None
    for packet in packets:
        if packet[:1] == b"\x47" and len(packet) % 188 == 0:
            return "", 0
        payload = _rtp_payload(packet)
        if payload is None:
            continue
        kind = packet[1] & 0x7F
        if kind in _STATIC_TYPES:
            return _STATIC_TYPES[kind], kind
        if kind < 96:  # audio, or RTCP on the same port
            continue
        if payload[:1] == b"\x47" and len(payload) % 188 == 0:
            return "MP2T", kind
        h265 = payload[0] & 0x81 == 0 and payload[0] >> 1 in _H265_TYPES and 1 <= payload[1] <= 7
        if not h265:
            return "H264", kind
        seen = "H265", kind
    return seen


def _rtp_payload(packet: bytes) -> bytes | None:
    """None: not an RTP packet of version 2 with two bytes at least (RFC 3550, section 5.1)."""
    if len(packet) < 14 or packet[0] >> 6 != 2:
        return None
    begin = 12 + 4 * (packet[0] & 0x0F)
    if packet[0] & 0x10:
        begin += 4 + 4 * int.from_bytes(packet[begin + 2 : begin + 4], "big")
    payload = packet[begin:]
    return payload if len(payload) >= 2 else None


def listen_for_codec(address: NetworkAddress, stopped: Callable[[], bool]) -> tuple[str, int]:
    """Codec and payload type of what arrives on the port (``codec_of``), by the packets of half a second at most.

    Raises SourceError: the port is taken, or nothing that is known arrives within WAIT_FOR_PACKETS_S."""
    packets: list[bytes] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        receiver.settimeout(0.1)
        try:
            receiver.bind((address.host, address.port))
            if address.host and 224 <= int(address.host.split(".")[0]) <= 239:
                group = socket.inet_aton(address.host) + socket.inet_aton("0.0.0.0")
                receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
        except (OSError, ValueError) as error:
            raise SourceError(
                f"{address.url}: cannot listen there ({error}); the address is one of this computer or a multicast "
                "group, udp://:5600 listens on all"
            ) from None
        end_s = time.monotonic() + WAIT_FOR_PACKETS_S
        while time.monotonic() < end_s and not stopped():
            try:
                packets.append(receiver.recv(65536))
            except TimeoutError:
                continue
            found = codec_of(packets)
            # A stream that looks like H.265 after many packets is no H.264.
            if found is not None and (found[0] != "H265" or len(packets) >= 20):
                return found
    found = codec_of(packets)
    if found is None:
        what = f"{len(packets)} packets arrive, none of H.264, H.265 or MJPEG by RTP, or an MPEG transport stream"
        raise SourceError(
            f"{address.url}: {what if packets else 'nothing arrives'} within {WAIT_FOR_PACKETS_S:g} s; is the camera "
            "on, and sends it to this computer and port?"
        )
    return found
