"""An autopilot on a local UDP port that really consumes GPS_INPUT: ArduPilot's rules, a course to fly, a report.

``AutopilotPeer`` runs in a thread; peer_process.py is the same in a process of its own. It stands in for a flight
controller; it is not one."""

import select
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.errors import LinkError
from terrafix.link.carry import distance_m
from terrafix_tools.sim.peer_course import Course, PeerState
from terrafix_tools.sim.peer_filter import Fusion, PositionFilter
from terrafix_tools.sim.peer_gps import TYPE_MAV, Fix, GpsDriver
from terrafix_tools.sim.peer_report import PeerReport, quantile
from terrafix_tools.sim.peer_streams import RATES_HZ, PeerStreams

STEP_S = 0.01  # prediction and the finest stream
PARAMETERS = {  # those that decide about GPS_INPUT; the values of config/vehicles/copter.param
    "GPS1_TYPE": 14.0,
    "GPS1_DELAY_MS": 5.0,
    "EK3_GPS_CHECK": 23.0,
    "EK3_CHECK_SCALE": 100.0,
}
BOOTED_BEFORE_S = 42.0  # the autopilot's clock is not ours: another start,
CLOCK_DRIFT = 20e-6  # and another crystal
DATAGRAM_MAX = 4096


class AutopilotPeer:
    """``start``, fly, ``stop`` for the report. ``aligned``: in the air with a known position, real GPS just lost."""

    def __init__(
        self,
        *,
        seed: int = 0,
        aligned: bool = True,
        gps_id: int = 0,
        sysid: int = 1,
        parameters: dict[str, float] | None = None,
        home_amsl_m: float | None = None,
    ) -> None:
        self._parameters = PARAMETERS | (parameters or {})
        self._said = PeerStreams(seed)
        self._seed, self._aligned, self._home_amsl_m = seed, aligned, home_amsl_m
        self._driver = GpsDriver(gps_id, self._parameters["GPS1_DELAY_MS"])
        self._filter: PositionFilter | None = None
        self._mav = mavlink.MAVLink(None, srcSystem=sysid, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)
        self._mav.robust_parsing = True
        self._report = PeerReport()
        self._rates = dict(RATES_HZ)
        self._next_s: dict[int, float] = {}
        self._partner: tuple[str, int] | None = None
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self._landed = False
        self._first_gps_s: float | None = None
        self._healthy_s = self._fix3_s = self._without_s = 0.0
        self._gps_errors: list[float] = []
        self._errors: list[float] = []
        self._accuracies: list[float] = []

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
        self._course = course
        self._started_s = time.monotonic()
        self._clock = clock or (lambda: time.monotonic() - self._started_s)
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
        return self._finished()

    def glance(self) -> tuple[int, float | None]:
        """Fix type in use, and how far the filter's position is off now (m); for a progress line, from any thread."""
        errors = self._errors
        return self._driver.fix_type, errors[-1] if errors else None

    # --- flying ---

    def _fly(self) -> None:
        now = time.monotonic()
        truth = self._course(self._clock())
        self._home_m = truth.amsl_m - truth.agl_m if self._home_amsl_m is None else self._home_amsl_m
        if self._aligned:
            self._filter = PositionFilter(truth.lat_deg, truth.lon_deg, (truth.vn_mps, truth.ve_mps), self._seed)
        step_at = now + STEP_S
        while not self._stopping.is_set():
            select.select([self._socket], [], [], max(0.0, step_at - time.monotonic()))
            self._receive()
            if time.monotonic() < step_at:
                continue
            before, before_truth = now, truth
            now, truth = time.monotonic(), self._course(self._clock())
            step_at = max(step_at + STEP_S, now)
            self._step(now, now - before, before_truth, truth)
            self._stream(now, truth)
        self._landed = True

    def _step(self, now: float, dt_s: float, before: PeerState, truth: PeerState) -> None:
        self._driver.look(now)
        if self._filter is not None:
            self._filter.predict(now, dt_s, (truth.vn_mps - before.vn_mps, truth.ve_mps - before.ve_mps))
        if self._first_gps_s is None:
            return
        fix3 = self._driver.fix_type >= 3
        self._healthy_s += dt_s * self._driver.healthy(now)
        self._fix3_s += dt_s * fix3
        self._without_s = 0.0 if fix3 else self._without_s + dt_s
        self._report.longest_without_fix3_s = max(self._report.longest_without_fix3_s, self._without_s)
        if self._filter is not None:
            self._errors.append(self._filter.error_m(truth.lat_deg, truth.lon_deg))

    # --- in ---

    def _receive(self) -> None:
        while True:
            try:
                data, sender = self._socket.recvfrom(DATAGRAM_MAX)
            except (BlockingIOError, ConnectionRefusedError):
                return
            for message in self._mav.parse_buffer(data) or ():
                if message.get_type() == "BAD_DATA":
                    self._report.bad_packets += 1
                else:
                    self._partner = sender
                    self._take(message)

    def _take(self, message: Any) -> None:
        match message.get_type():
            case "GPS_INPUT":
                self._take_gps(message, time.monotonic())
            case "HEARTBEAT":
                self._report.companion_heartbeats += 1
            case "STATUSTEXT":
                self._report.status_texts.append(message.text)
            case "TIMESYNC" if message.tc1 == 0:
                self._report.timesync_requests += 1
                self._send(mavlink.MAVLink_timesync_message(self._boot_ns(), message.ts1))
            case "TIMESYNC":
                self._report.timesync_answers += 1
            case "COMMAND_LONG":
                self._take_command(message)
            case "PARAM_REQUEST_READ" | "PARAM_SET" | "PARAM_REQUEST_LIST":
                self._take_parameter(message)

    def _take_gps(self, message: Any, now: float) -> None:
        self._report.gps_input_received += 1
        if self._parameters["GPS1_TYPE"] != TYPE_MAV:
            return
        self._first_gps_s = self._first_gps_s or now
        fix = self._driver.take(message, now)
        self._report.other_instance = self._driver.other_instance
        if fix is None:
            self._report.no_fix += message.fix_type < 3
            return
        truth = self._course(self._clock() - (now - fix.t_s))
        self._gps_errors.append(distance_m(fix.lat_deg, fix.lon_deg, truth.lat_deg, truth.lon_deg))
        self._accuracies.append(message.horiz_accuracy)
        self._fuse(fix, now)

    def _fuse(self, fix: Fix, now: float) -> None:
        if self._filter is None:
            check, scale = int(self._parameters["EK3_GPS_CHECK"]), self._parameters["EK3_CHECK_SCALE"]
            if not self._driver.aligned(fix, now, check, scale):
                self._report.waiting_for_alignment += 1
                return
            vn, ve, _ = fix.velocity_ned_mps
            self._filter = PositionFilter(fix.lat_deg, fix.lon_deg, (vn, ve), self._seed)
        match self._filter.fuse(fix, now):
            case Fusion.FUSED:
                self._report.accepted += 1
            case Fusion.REJECTED:
                self._report.rejected += 1
            case Fusion.RESET:
                self._report.resets += 1

    def _take_command(self, message: Any) -> None:
        result = mavlink.MAV_RESULT_UNSUPPORTED
        if message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            result = mavlink.MAV_RESULT_DENIED
            if int(message.param1) in RATES_HZ and message.param2 > 0:
                self._rates[int(message.param1)] = min(1.0 / STEP_S, 1e6 / message.param2)
                self._next_s.pop(int(message.param1), None)
                self._report.message_intervals_set += 1
                result = mavlink.MAV_RESULT_ACCEPTED
        self._send(mavlink.MAVLink_command_ack_message(message.command, result))

    def _take_parameter(self, message: Any) -> None:
        names = list(self._parameters)
        if message.get_type() == "PARAM_REQUEST_READ":
            by_index = 0 <= message.param_index < len(names)
            names = [names[message.param_index]] if by_index else [n for n in names if n == message.param_id]
        elif message.get_type() == "PARAM_SET":
            names = [n for n in names if n == message.param_id]
            self._parameters.update(dict.fromkeys(names, message.param_value))
        for name in names:
            value, kind = self._parameters[name], mavlink.MAV_PARAM_TYPE_REAL32
            index = list(self._parameters).index(name)
            self._send(mavlink.MAVLink_param_value_message(name.encode(), value, kind, len(self._parameters), index))

    # --- out ---

    def _stream(self, now: float, truth: PeerState) -> None:
        for message_id, rate_hz in self._rates.items():
            if now >= self._next_s.get(message_id, now):
                self._next_s[message_id] = max(self._next_s.get(message_id, now) + 1.0 / rate_hz, now)
                self._send(
                    self._said.message(message_id, self._boot_ns(), self._home_m, truth, self._filter, self._driver)
                )

    def _boot_ns(self) -> int:
        return round((time.monotonic() - self._started_s) * (1.0 + CLOCK_DRIFT) * 1e9 + BOOTED_BEFORE_S * 1e9)

    def _send(self, message: Any) -> None:
        packet = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256
        if self._partner is None:
            return
        try:
            self._socket.sendto(packet, self._partner)
        except OSError:  # nobody there, or no room: a radio would lose it too
            return

    def _finished(self) -> PeerReport:
        report, gaps_ms = self._report, [g * 1e3 for g in self._driver.gaps_s]
        now = time.monotonic()
        heard_s = max(1e-9, now - (self._first_gps_s or now))
        report.duration_s = now - self._started_s
        report.velocity_rejected = self._filter.velocity_rejected if self._filter else 0
        report.healthy_share = min(1.0, self._healthy_s / heard_s)
        report.fix3_share = min(1.0, self._fix3_s / heard_s)
        report.longest_gap_ms = max(gaps_ms, default=None)
        report.interval_median_ms, report.interval_p99_ms = quantile(gaps_ms, 0.5), quantile(gaps_ms, 0.99)
        report.gps_error_median_m, report.gps_error_p95_m = (
            quantile(self._gps_errors, 0.5),
            quantile(self._gps_errors, 0.95),
        )
        report.position_error_median_m = quantile(self._errors, 0.5)
        report.position_error_p95_m = quantile(self._errors, 0.95)
        report.position_error_max_m = max(self._errors, default=None)
        report.position_error_final_m = self._errors[-1] if self._errors else None
        report.horiz_accuracy_median_m = quantile(self._accuracies, 0.5)
        return report
