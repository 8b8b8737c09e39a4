"""The simulated autopilot in real time on a local UDP port, along a given course, for tests with the real processes.

``AutopilotPeer`` runs in a thread; process.py runs it in its own process. GPS_INPUT changes its navigation solution,
not the course of the vehicle; in the closed loop (sim/closed_loop) an error moves the vehicle.
"""

import contextlib
import math
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from terrafix.core.errors import LinkError
from terrafix.core.geodesy import LocalFrame
from terrafix_lab.faults.edits import Edit
from terrafix_lab.faults.source import EditedSensors
from terrafix_lab.sim.autopilot.course import Course, CourseFollower
from terrafix_lab.sim.autopilot.lockstep import SimAutopilot
from terrafix_lab.sim.autopilot.parameters import GPS_INPUT_ALONE, NO_DCM, Kind
from terrafix_lab.sim.autopilot.report import PeerMonitor, PeerReport, ReceivedFix
from terrafix_lab.sim.camera.mount import FIXED, CameraMount
from terrafix_lab.sim.interfaces import Navigation, navigation_of
from terrafix_lab.sim.sensors.clock import Clock
from terrafix_lab.sim.sensors.suite import VehicleSensors

STEP_S = 0.02
DATAGRAM_MAX = 4096
FRAME_BYTES, SIGNATURE_BYTES = 12, 13  # of a MAVLink 2 packet: header with checksum, signature


def telemetry_records(packets: bytes, unix_us: int) -> bytes:
    """MAVLink 2 packets, one after the other, as records of a telemetry log: microseconds since 1970 (8 bytes, big
    endian), packet. [spec: https://mavlink.io/en/guide/serialization.html]"""
    records, at = [], 0
    while at < len(packets):
        signature = SIGNATURE_BYTES if packets[at + 2] & 1 else 0
        end = at + FRAME_BYTES + packets[at + 1] + signature
        records.append(unix_us.to_bytes(8, "big") + packets[at:end])
        at = end
    return b"".join(records)


class AutopilotPeer:
    """Interface: ``start``, then ``stop`` for the report. ``aligned``: starts in the air with a known position, after
    the loss of real GPS.
    """

    def __init__(
        self,
        *,
        seed: int = 0,
        aligned: bool = True,
        sysid: int = 1,
        kind: Kind = Kind.PLANE,
        parameters: dict[str, float] | None = None,
        home_amsl_m: float | None = None,
        log: Path | None = None,
        mount: CameraMount = FIXED,
    ) -> None:
        """``log``: telemetry log (.tlog) of what it sends, as a ground station keeps it. ``mount``: of the camera, as
        whose gimbal it reports. Raises UsageError for an unknown parameter."""
        self._log, self._mount = log, mount
        self._parameters = GPS_INPUT_ALONE | NO_DCM | (parameters or {})
        self._seed, self._aligned, self._sysid, self._home_amsl_m = seed, aligned, sysid, home_amsl_m
        self._kind = kind
        self._companion: tuple[str, int] | None = None
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self._landed = False
        self._reboots = False
        self.muted = False  # receives and sends nothing, as with the cable unplugged
        self.again_after_s: float | None = None  # all that it sends comes a second time, so much later
        self._again: deque[tuple[float, bytes]] = deque()  # when, and what
        self.received_s: list[float] = []  # monotonic time of each GPS_INPUT

    def start(
        self, port: int, course: Course, clock: Callable[[], float] | None = None, *, to: int | None = None
    ) -> int:
        """Listens on 127.0.0.1:``port`` (0: any) and replies to the sender, or sends first to port ``to``.

        ``clock`` gives the seconds of the flight; by default they run from now. Returns the port. Raises LinkError.
        """
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(("127.0.0.1", port))
        except OSError as error:
            self._socket.close()
            raise LinkError(f"autopilot peer: port {port} cannot be used ({error.strerror}); choose another") from None
        self._socket.setblocking(False)
        self._log_stream = None if self._log is None else self._log.open("wb")
        self._companion = None if to is None else ("127.0.0.1", to)
        self._started_s = time.monotonic()
        self._clock = clock or self._now_s
        self._create_autopilot(course)
        self._thread = threading.Thread(target=self._fly, name="autopilot-peer", daemon=True)
        self._thread.start()
        return int(self._socket.getsockname()[1])

    def stop(self) -> PeerReport:
        """Ends the flight and returns the report. Stop the peer before the link, otherwise the missing GPS_INPUT at
        the end counts.
        """
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
            self._socket.close()
            self._thread = None
            if self._log_stream is not None:
                self._log_stream.close()
        if not self._landed:
            raise RuntimeError("the autopilot peer's thread has died; its traceback is above")
        return self._monitor.report()

    def latest(self) -> tuple[int, float | None]:
        """Returns the fix type of GPS_INPUT and the current position error (m), for a progress line; callable from any
        thread.
        """
        gps, errors = self._autopilot.gps[self._autopilot.used_gps], self._monitor.errors_m
        return gps.fix_type if gps is not None else 0, errors[-1] if errors else None

    def fixes(self) -> list[ReceivedFix]:
        """The 3D fixes of GPS_INPUT so far, ``received_s`` on the monotonic clock; callable from any thread."""
        return [replace(fix, received_s=fix.received_s + self._started_s) for fix in list(self._monitor.fixes)]

    def texts(self) -> list[tuple[float, str]]:
        """(time on the monotonic clock, text) of each STATUSTEXT so far; callable from any thread."""
        return [(t_s + self._started_s, text) for t_s, text in list(self._autopilot.wire.received.texts)]

    def inject(self, data: bytes) -> None:
        """Sends bytes of another origin on the same line; callable from any thread."""
        if self._companion is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(data, self._companion)

    def edit_telemetry(self, edit: Edit) -> None:
        """From now on attitude, heading and height pass through ``edit``, on the monotonic clock."""
        self._sensors.alter(edit, self._started_s)

    def reboot(self) -> None:
        """The autopilot starts again in the air, without a position, and its clock begins at zero."""
        self._reboots = True

    def _now_s(self) -> float:
        """Seconds since the start: the autopilot's time. The flight's may begin later."""
        return time.monotonic() - self._started_s

    def _create_autopilot(self, course: Course) -> None:
        first = course(self._clock())
        frame = LocalFrame(first.lat_deg, first.lon_deg)
        self._course = CourseFollower(course, frame)
        state = self._course.state(0.0, self._clock())
        self._autopilot = self._new_autopilot(
            frame,
            start=navigation_of(state) if self._aligned else None,
            home_amsl_m=first.amsl_m - first.agl_m if self._home_amsl_m is None else self._home_amsl_m,
            boot_ns=Clock.of(self._seed).boot_ns,
        )
        self._sensors = EditedSensors(
            VehicleSensors(frame, seed=self._seed, airspeed=not math.isnan(first.airspeed_mps), mount=self._mount)
        )
        self._monitor = PeerMonitor(self._autopilot, frame)

    def _new_autopilot(
        self, frame: LocalFrame, *, start: Navigation | None, home_amsl_m: float, boot_ns: Callable[[float], int]
    ) -> SimAutopilot:
        self._home_amsl_m = home_amsl_m
        return SimAutopilot(
            frame,
            self._kind,
            start=start,
            home_amsl_m=home_amsl_m,
            parameters=self._parameters,
            sysid=self._sysid,
            boot_ns=boot_ns,
        )

    def _restart(self) -> None:
        boot_ns, booted_s, frame = Clock.of(self._seed).boot_ns, self._now_s(), self._monitor.frame
        assert self._home_amsl_m is not None
        self._autopilot = self._new_autopilot(
            frame, start=None, home_amsl_m=self._home_amsl_m, boot_ns=lambda now_s: boot_ns(now_s - booted_s)
        )
        self._monitor.watch(self._autopilot)

    def _fly(self) -> None:
        step_at_s = STEP_S
        while not self._stopping.is_set():
            select.select([self._socket], [], [], max(0.0, step_at_s - self._now_s()))
            if self._reboots:
                self._reboots = False
                self._restart()
            self._receive()
            now_s = self._now_s()
            if now_s >= step_at_s:
                step_at_s = max(step_at_s + STEP_S, now_s)
                self._step(now_s)
            self._send()
        self._landed = True

    def _step(self, now_s: float) -> None:
        state = self._course.state(now_s, self._clock())
        self._autopilot.step(now_s, self._sensors.read(state))
        self._monitor.observe(now_s, state)

    def _receive(self) -> None:
        while True:
            try:
                packets, self._companion = self._socket.recvfrom(DATAGRAM_MAX)
            except (BlockingIOError, ConnectionRefusedError):
                return
            if self.muted:
                continue
            before = self._autopilot.counts.received
            self._autopilot.receive(packets, self._now_s())
            self.received_s += [time.monotonic()] * (self._autopilot.counts.received - before)

    def _send(self) -> None:
        packets, now_s = self._autopilot.transmit(), self._now_s()
        if packets and self.again_after_s is not None:
            self._again.append((now_s + self.again_after_s, packets))
        while self._again and self._again[0][0] <= now_s:
            self._send_packets(self._again.popleft()[1])
        if packets:
            self._send_packets(packets)

    def _send_packets(self, packets: bytes) -> None:
        if self._companion is None or self.muted:
            return
        if self._log_stream is not None:
            self._log_stream.write(telemetry_records(packets, time.time_ns() // 1000))
        try:
            self._socket.sendto(packets, self._companion)
        except OSError:  # no receiver, or no buffer space: a radio would lose the packet as well
            return
