"""Live cameras by GStreamer, through PyGObject (LGPL; extra ``gstreamer``, or the distribution's python3-gi).

An image is stamped with its running time on the pipeline's clock, which is CLOCK_MONOTONIC: V4L2 and CSI sources put
the driver's time there, the jitter buffer of RTP the time of arrival without its jitter."""

import contextlib
import functools
import importlib
import importlib.machinery
import importlib.util
import sys
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from terrafix.core.errors import SourceError
from terrafix.core.passwords import without_password
from terrafix.messages import STAMP_SIGMA_S, Camera
from terrafix.vision.sources.capture import NETWORK_SIGMA_S, STALL_S, Stamp
from terrafix.vision.sources.stream_address import (
    HARDWARE_DECODERS,
    JITTER_MS,
    NETWORK,
    RTSP,
    decoder_order,
    listen_for_codec,
    parse_network,
    pipeline_of,
    rtp_caps,
)

SYSTEM_PACKAGES = "/usr/lib/python3/dist-packages"  # python3-gi of Debian and Ubuntu, for the system's Python
INSTALL = "docs/camera.md#gstreamer says what to install"
FIRST_IMAGE_S = 10.0  # from connecting to the first image: twice a long interval of key frames [spec: 5 s]
SLICE_NS = 100_000_000  # ns between two looks at the bus, and at whether the source is closed
# bytes of the socket of a stream over UDP, of which the kernel grants net.core.rmem_max: a key frame arrives at once
UDP_BUFFER = 4 << 20  # [spec: four times the largest key frame that a camera of 50 Mbit/s sends]
# Properties by which depayloaders ask and wait for a key frame after a lost packet, and decoders leave out damaged
# images.
REFUSE_DAMAGED = {"wait-for-keyframe": True, "request-keyframe": True, "output-corrupt": False}
H265_PARSER = "h265parse"  # what it gets is not waited for: GStreamer's depayloader of H.265 has no such property
NTP_TO_UNIX_S = 2_208_988_800  # [spec: RFC 5905]
MAX_GST_STAMP_AGE_NS = 10_000_000_000  # an older stamp, or one of the future, is of another clock
FULL_RANGE = ("1:", "jpeg", "sRGB")  # begin of GStreamer's names of colorimetry with 0 to 255
_LIMITED = (
    np.clip(np.arange(256) * 219 / 255 + 16, 0, 255),
    np.clip((np.arange(256.0) - 128) * 224 / 255 + 128, 0, 255),
)


@functools.cache
def gstreamer() -> tuple[Any, str]:
    """-> module Gst of PyGObject, initialised, or None; and its version, or why it is missing."""
    try:
        gi = _gi()
        for name in ("Gst", "GstApp"):
            gi.require_version(name, "1.0")
        Gst = importlib.import_module("gi.repository.Gst")
        importlib.import_module("gi.repository.GstApp")  # gives the appsink its methods
        Gst.init(None)
    except (ImportError, ValueError) as error:
        return None, f"no GStreamer: {str(error).splitlines()[0]}; {INSTALL}"
    for preferred, name in enumerate(reversed(decoder_order(lambda name: _exists(Gst, name)))):
        Gst.ElementFactory.find(name).set_rank(int(Gst.Rank.PRIMARY) + 100 + preferred)
    return Gst, Gst.version_string()


def _gi() -> Any:
    """PyGObject of this environment, else that of the distribution if it is for this Python. Raises ImportError."""
    with contextlib.suppress(ModuleNotFoundError):
        return importlib.import_module("gi")
    found = importlib.machinery.PathFinder.find_spec("gi", [SYSTEM_PACKAGES])
    if found is None or found.loader is None:
        raise ImportError("no PyGObject")
    module = importlib.util.module_from_spec(found)
    sys.modules["gi"] = module
    try:
        found.loader.exec_module(module)
    except ImportError:
        del sys.modules["gi"]
        raise ImportError(
            f"the PyGObject of the system is not for Python {sys.version_info[0]}.{sys.version_info[1]}"
        ) from None
    return module


def _exists(Gst: Any, name: str) -> bool:
    return Gst.ElementFactory.find(name) is not None


class GstCapture:
    """A running pipeline. Not thread-safe; ``stopped`` may change at any time and ends a wait."""

    def __init__(self, spec: str, camera: Camera, stopped: Callable[[], bool], sender_clock: bool) -> None:
        """Returns after the first image. ``sender_clock``: time of exposure by the sender reports of RTSP.

        Raises SourceError: no such element, no connection, wrong password, no decoder, no image in FIRST_IMAGE_S."""
        self.why = ""
        self._gst, self._version = gstreamer()
        self._shown, self._stopped, self._sender_clock = without_password(spec), stopped, sender_clock
        self._network = spec.startswith(NETWORK)
        self._missing = ""  # what no element decodes
        self._sample: Any = None
        codec, payload = "", 0
        if spec.startswith("udp://"):
            codec, payload = listen_for_codec(parse_network(spec), stopped)
        text = pipeline_of(spec, camera, codec, lambda name: _exists(self._gst, name))
        try:
            self._pipeline = self._gst.parse_launch(text)
        except Exception as error:  # noqa: BLE001  # GLib.Error, whose class exists only where PyGObject does
            raise SourceError(f"{self._shown}: not a pipeline that GStreamer can make ({error})") from None
        self._pipeline.connect("deep-element-added", lambda _pipeline, _parent, element: self._refuse_damaged(element))
        for element in self._elements():
            self._refuse_damaged(element)
        if self._network:
            self._address(spec, codec, payload)
        self._sink, self._bus = self._pipeline.get_by_name("sink"), self._pipeline.get_bus()
        self._pipeline.use_clock(self._gst.SystemClock.obtain())
        result = self._pipeline.set_state(self._gst.State.PLAYING)
        # A source that is not live has times of its own: those of a file, or of a server.
        self._clocked = result == self._gst.StateChangeReturn.NO_PREROLL
        self._waiting = self._pull(FIRST_IMAGE_S)
        if not self._waiting:
            self.release()
            raise SourceError(f"{self._shown}: {self.why}")

    def grab(self) -> bool:
        if self._waiting:
            self._waiting = False
            return True
        return self._pull(STALL_S)

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        caps, buffer = self._sample.get_caps().get_structure(0), self._sample.get_buffer()
        width, height = self.size()
        data = np.frombuffer(buffer.extract_dup(0, buffer.get_size()), np.uint8)
        # Layout of GstVideoInfo: rows of whole 4 bytes, an even number of rows, then half as many of U and V.
        stride, rows = -(-width // 4) * 4, -(-height // 2) * 2
        if data.size < stride * rows * 3 // 2:
            return False, None
        image = data[: stride * rows * 3 // 2].reshape(rows * 3 // 2, stride)
        if (caps.get_string("colorimetry") or "").startswith(FULL_RANGE):
            luma, chroma = (table.round().astype(np.uint8) for table in _LIMITED)
            image = np.vstack([cv2.LUT(image[:rows], luma), cv2.LUT(image[rows:], chroma)])
        return True, cv2.cvtColor(image, cv2.COLOR_YUV2BGR_NV12)[:height, :width]

    def stamp(self, arrival_ns: int) -> Stamp:
        if self._sender_clock and (age_ns := self.sender_age_ns()) is not None and 0 <= age_ns <= MAX_GST_STAMP_AGE_NS:
            return Stamp(arrival_ns - age_ns, False, STAMP_SIGMA_S)
        t_ns = self._running_ns()
        stamped = self._clocked and t_ns is not None and 0 <= arrival_ns - t_ns <= MAX_GST_STAMP_AGE_NS
        sigma_s = NETWORK_SIGMA_S if self._network else STAMP_SIGMA_S
        return Stamp(t_ns if stamped and t_ns is not None else arrival_ns, self._network or not stamped, sigma_s)

    def described(self) -> str:
        used = [element.get_factory().get_name() for element in self._elements() if _is_decoder(element)]
        exist = [name for name in HARDWARE_DECODERS if _exists(self._gst, name)]
        reason = f"software; of hardware {', '.join(exist)}" if exist else "no decoder of hardware"
        reason = "hardware" if any(name in HARDWARE_DECODERS for name in used) else reason
        width, height = self.size()
        decoder = f"{', '.join(used)} ({reason})" if used else "no decoder: raw images"
        return f"{self._version}, {decoder}, {width}x{height}"

    def sender_age_ns(self) -> int | None:
        """Age of the grabbed image by the sender's clock (sender reports of RTSP); None: there are none."""
        meta = self._sample.get_buffer().get_reference_timestamp_meta(self._gst.Caps.from_string("timestamp/x-ntp"))
        return None if meta is None else time.time_ns() - (meta.timestamp - NTP_TO_UNIX_S * 1_000_000_000)

    def release(self) -> None:
        self._pipeline.set_state(self._gst.State.NULL)
        self._sample = None

    def size(self) -> tuple[int, int]:
        caps = self._sample.get_caps().get_structure(0)
        return caps.get_int("width")[1], caps.get_int("height")[1]

    def _running_ns(self) -> int | None:
        """Running time of the grabbed image, on the monotonic clock."""
        pts = self._sample.get_buffer().pts
        if pts == self._gst.CLOCK_TIME_NONE:
            return None
        running = self._sample.get_segment().to_running_time(self._gst.Format.TIME, pts)
        return None if running == self._gst.CLOCK_TIME_NONE else running + self._pipeline.get_base_time()

    def _pull(self, limit_s: float) -> bool:
        """Waits for the next image; ``why`` says what went wrong."""
        end_s = time.monotonic() + limit_s
        while not self._stopped():
            sample = self._sink.try_pull_sample(SLICE_NS)
            if sample is not None:
                self._sample = sample
                return True
            if self._failed():
                return False
            if time.monotonic() > end_s:
                self.why = self._missing or f"no undamaged image for {limit_s:g} s, though the camera answers"
                return False
        self.why = "closed"
        return False

    def _failed(self) -> bool:
        kinds = self._gst.MessageType
        while (message := self._bus.pop_filtered(kinds.ERROR | kinds.EOS | kinds.ELEMENT)) is not None:
            if message.type == kinds.EOS:
                self.why = "the camera has ended the stream"
                return True
            if message.type == kinds.ERROR:
                error, detail = message.parse_error()
                self.why = self._missing or self._explained(error, detail or "")
                return True
            structure = message.get_structure()
            if structure is not None and structure.get_name() == "missing-plugin":
                what = structure.get_string("name")
                self._missing = f"GStreamer has no {what}; apt install gstreamer1.0-libav gstreamer1.0-plugins-bad"
        return False

    def _explained(self, error: Any, detail: str) -> str:
        """One line of an error of GStreamer, without a password."""
        kind = self._gst.ResourceError
        if error.matches(self._gst.resource_error_quark(), kind.NOT_AUTHORIZED) or "Unauthorized" in detail:
            return "the camera refuses user and password; write rtsp://USER:PASSWORD@..., with %40 for @ and %2F for /"
        if error.matches(self._gst.resource_error_quark(), kind.OPEN_READ_WRITE):
            return "no connection; is the camera on, and its address right?"
        if error.matches(self._gst.resource_error_quark(), kind.NOT_FOUND):
            return "the camera has no such stream; look up its address in the manual"
        last = detail.strip().splitlines()[-1] if detail.strip() else ""
        return without_password(f"{error.message.rstrip('.')} ({last})" if last else error.message)

    def _address(self, spec: str, codec: str, payload: int) -> None:
        address, source = parse_network(spec), self._pipeline.get_by_name("source")
        if spec.startswith("udp://"):
            source.set_property("port", address.port)
            source.set_property("buffer-size", UDP_BUFFER)
            if address.host:
                source.set_property("address", address.host)
            if codec:
                source.set_property("caps", self._gst.Caps.from_string(rtp_caps(codec, payload)))
            return
        source.set_property("location", address.url)
        if not spec.startswith(RTSP):
            if address.user:
                source.set_property("username", address.user)
                source.set_property("password", address.password)
            return
        if spec.startswith("rtsp://"):  # over TCP nothing is lost on the way; rtspu:// is over UDP
            self._gst.util_set_object_arg(source, "protocols", "tcp")
        source.set_property("latency", JITTER_MS)
        source.set_property("drop-on-latency", True)
        source.set_property("user-id", address.user)
        source.set_property("user-pw", address.password)
        if source.find_property("add-reference-timestamp-meta") is not None:  # since 1.22
            source.set_property("add-reference-timestamp-meta", True)

    def _refuse_damaged(self, element: Any) -> None:
        for name, value in REFUSE_DAMAGED.items():
            if element.find_property(name) is not None:
                element.set_property(name, value)
        if element.get_factory() is not None and element.get_factory().get_name() == H265_PARSER:
            probe = _UndamagedImages(self._gst)
            element.get_static_pad("src").add_probe(self._gst.PadProbeType.BUFFER, probe)

    def _elements(self) -> list[Any]:
        elements: list[Any] = []
        iterator = self._pipeline.iterate_recurse()
        while True:
            result, element = iterator.next()
            if result != self._gst.IteratorResult.OK:
                return elements
            elements.append(element)


class _UndamagedImages:
    """Probe of a parser's output: lets encoded images pass. One before which packets were lost may lack a part, and
    later ones show that part until a key frame comes."""

    def __init__(self, Gst: Any) -> None:
        self._gst, self._waiting, self._first = Gst, True, True

    def __call__(self, pad: Any, info: Any) -> Any:
        flags, kinds = info.get_buffer().get_flags(), self._gst.BufferFlags
        lost, self._first = bool(flags & kinds.DISCONT) and not self._first, False
        self._waiting = lost or (self._waiting and bool(flags & kinds.DELTA_UNIT))
        return self._gst.PadProbeReturn.DROP if self._waiting else self._gst.PadProbeReturn.OK


def _is_decoder(element: Any) -> bool:
    factory = element.get_factory()
    return factory is not None and str(factory.get_metadata("klass")).startswith("Codec/Decoder")
