"""The simulated autopilot in real time on a local UDP port, along a course that is given: for the real processes.

``AutopilotPeer`` runs in a thread; peer_process.py is the same in a process of its own. What it does with GPS_INPUT
moves its belief, not the vehicle; the closed loop (closed_loop.py) is where an error moves the vehicle."""

import math
import select
import socket
import threading
import time
from collections.abc import Callable

from terrafix.core.errors import LinkError
from terrafix.core.geodesy import LocalFrame
from terrafix_tools.sim.autopilot.autopilot import SimAutopilot
from terrafix_tools.sim.autopilot.course import Along, Course
from terrafix_tools.sim.autopilot.parameters import GPS_INPUT_ALONE, NO_DCM, Kind
from terrafix_tools.sim.autopilot.report import PeerReport, Witness
from terrafix_tools.sim.interfaces import navigation_of
from terrafix_tools.sim.sensors.clock import Clock
from terrafix_tools.sim.sensors.suite import VehicleSensors

STEP_S = 0.02
DATAGRAM_MAX = 4096


class AutopilotPeer:
    """``start``, fly, ``stop`` for the report. ``aligned``: in the air with a known position, real GPS just lost."""

    def __init__(
        self,
        *,
        seed: int = 0,
        aligned: bool = True,
        sysid: int = 1,
        parameters: dict[str, float] | None = None,
        home_amsl_m: float | None = None,
    ) -> None:
        """Raises UsageError for an unknown parameter."""
        self._parameters = GPS_INPUT_ALONE | NO_DCM | (parameters or {})
        self._seed, self._aligned, self._sysid, self._home_amsl_m = seed, aligned, sysid, home_amsl_m
        self._partner: tuple[str, int] | None = None
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self._landed = False

    def start(
        self, port: int, course: Course, clock: Callable[[], float] | None = None, *, to: int | None = None
    ) -> int:
        """Listens on 127.0.0.1:``port`` (0: any) and answers whoever speaks, or speaks first to port ``to``.

        ``clock`` gives the seconds of the flight; by default they run from now. -> the port. Raises LinkError."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(("127.0.0.1", port))
        except OSError as error:
            self._socket.close()
            raise LinkError(f"autopilot peer: port {port} cannot be used ({error.strerror}); choose another") from None
        self._socket.setblocking(False)
        self._partner = None if to is None else ("127.0.0.1", to)
        self._started_s = time.monotonic()
        self._clock = clock or self._now_s
        self._board(course)
        self._thread = threading.Thread(target=self._fly, name="autopilot-peer", daemon=True)
        self._thread.start()
        return int(self._socket.getsockname()[1])

    def stop(self) -> PeerReport:
        """Lands. Stop it before the link stops: the silence at the end would count."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
            self._socket.close()
            self._thread = None
        if not self._landed:
            raise RuntimeError("the autopilot peer's thread has died; its traceback is above")
        return self._witness.report()

    def glance(self) -> tuple[int, float | None]:
        """Fix type by GPS_INPUT, and how far its belief is off now (m); for a progress line, from any thread."""
        gps, errors = self._autopilot.gps[self._autopilot.used_gps], self._witness.errors_m
        return gps.fix_type if gps is not None else 0, errors[-1] if errors else None

    def _now_s(self) -> float:
        """Seconds since the start: the autopilot's time. The flight's may begin later."""
        return time.monotonic() - self._started_s

    def _board(self, course: Course) -> None:
        first = course(self._clock())
        frame = LocalFrame(first.lat_deg, first.lon_deg)
        self._along = Along(course, frame)
        state = self._along.state(0.0, self._clock())
        known = navigation_of(state)
        self._autopilot = SimAutopilot(
            frame,
            Kind.PLANE,
            start=known if self._aligned else None,
            home_amsl_m=first.amsl_m - first.agl_m if self._home_amsl_m is None else self._home_amsl_m,
            parameters=self._parameters,
            sysid=self._sysid,
            boot_ns=Clock.of(self._seed).boot_ns,
        )
        self._sensors = VehicleSensors(frame, seed=self._seed, airspeed=not math.isnan(first.airspeed_mps))
        self._witness = Witness(self._autopilot, frame)

    def _fly(self) -> None:
        step_at_s = STEP_S
        while not self._stopping.is_set():
            select.select([self._socket], [], [], max(0.0, step_at_s - self._now_s()))
            self._receive()
            now_s = self._now_s()
            if now_s >= step_at_s:
                step_at_s = max(step_at_s + STEP_S, now_s)
                self._step(now_s)
            self._send()
        self._landed = True

    def _step(self, now_s: float) -> None:
        state = self._along.state(now_s, self._clock())
        self._autopilot.step(now_s, self._sensors.read(state))
        self._witness.look(now_s, state)

    def _receive(self) -> None:
        while True:
            try:
                packets, self._partner = self._socket.recvfrom(DATAGRAM_MAX)
            except (BlockingIOError, ConnectionRefusedError):
                return
            self._autopilot.receive(packets, self._now_s())

    def _send(self) -> None:
        packets = self._autopilot.transmit()
        if not packets or self._partner is None:
            return
        try:
            self._socket.sendto(packets, self._partner)
        except OSError:  # nobody there, or no room: a radio would lose it too
            return
