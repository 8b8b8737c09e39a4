"""The link node: selects the estimate for GPS_INPUT, decides about the fix type, and produces the texts for the pilot.

A function of messages without I/O; the edge (edge.py) sends the result. The rules are in docs/link.md."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

from terrafix.core.config import GnssMode
from terrafix.core.node import Edge, NodeContext
from terrafix.link.autopilot.checkpoint import load_checkpoint
from terrafix.link.autopilot.ekf_status_monitor import EkfStatusMonitor
from terrafix.link.gnss.initial_position import GnssInitializer
from terrafix.link.gnss.map_registration import MapOffsetEstimator
from terrafix.link.gnss.monitor import GnssMonitor
from terrafix.link.gnss.previous_source import PreviousSourceFile
from terrafix.link.ground_station.prior_request import PriorRequest
from terrafix.link.integrity import fix_type
from terrafix.link.integrity.estimate_gate import EstimateGate
from terrafix.link.integrity.output_predictor import InertialBuffer, predict_to
from terrafix.link.output import gps_report
from terrafix.link.output.gps_time import LatchedClock
from terrafix.link.output.send_schedule import SendSchedule
from terrafix.link.pilot_text.debounce import Debounce
from terrafix.link.pilot_text.statustext import CRITICAL, INFO, LINK_FAULTS, NOTICE, WARNING, fault_text, statustext
from terrafix.messages import (
    NO_FRAME_ID,
    CalibrationFault,
    EkfStatus,
    GnssReading,
    GpsInput,
    Health,
    HintVerdict,
    Imu,
    InitialPosition,
    MeasurementVerdict,
    Message,
    NavEstimate,
    Origin,
    ProcessEvent,
    SearchState,
    ServedVehicle,
    StatusText,
    ThermalBand,
    VehicleState,
    Verdict,
    WallClock,
)

TICK_HZ = 50.0  # tick rate of the link process [spec: processes.py]


def make_node(ctx: NodeContext) -> "LinkNode":
    """The node, with map offset and clock of the checkpoint after a restart in flight, and the source of position that
    an earlier process has selected."""
    link, checkpoint = ctx.config.link, load_checkpoint(ctx.checkpoint)
    offsets = MapOffsetEstimator(None if checkpoint is None else checkpoint.map_offset) if link.map_offset else None
    clock = LatchedClock(None if checkpoint is None else checkpoint.unix_minus_monotonic_ns)
    on_vision = PreviousSourceFile(ctx.state_dir).load() is not None
    return LinkNode(
        link.rate_hz,
        link.gnss,
        gnss_start=link.gnss_start,
        ground_fix=link.ground_fix,
        map_offsets=offsets,
        clock=clock,
        on_vision=on_vision,
    )


def make_edge(ctx: NodeContext) -> Edge:
    """The edge of a live process, which gets real-time priority. Raises LinkError when the device cannot be opened,
    ConfigError for an invalid configuration."""
    from terrafix.link.edge import open_edge  # replay has no edge and need not load MAVLink
    from terrafix.link.output.realtime_priority import set_realtime_priority

    edge = open_edge(ctx.config.link, ctx.checkpoint, ctx.state_dir)
    set_realtime_priority()
    return edge


class LinkNode:
    """Receives estimates, publishes GpsInput at ``rate_hz``. ``map_offsets`` None: the map offset is not estimated.
    ``clock``: from the checkpoint of the previous link process of this flight. ``on_vision``: see GnssMonitor."""

    def __init__(
        self,
        rate_hz: float,
        gnss: GnssMode = "advise",
        *,
        gnss_start: bool = True,
        ground_fix: bool = False,
        map_offsets: MapOffsetEstimator | None = None,
        clock: LatchedClock | None = None,
        on_vision: bool = False,
    ) -> None:
        self._schedule = SendSchedule(rate_hz, TICK_HZ)
        self._gate = EstimateGate()
        self._fix_gate = fix_type.FixGate()
        self._inertial = InertialBuffer()
        self._gnss = GnssMonitor(gnss, map_offsets, on_vision=on_vision)
        self._starts = GnssInitializer(enabled=gnss_start)
        self._prior_request = PriorRequest()
        self._ekf_monitor = EkfStatusMonitor()
        self._candidates: list[int] = []  # of ServedVehicle
        self._armed: bool | None = None
        self._ground_fix, self._stood = ground_fix, False  # ``_stood``: it was disarmed once
        # There was a map fix, a receiver has measured that the vehicle stands, or the operator says so.
        self._position_confirmed = False
        self._now_ns = 0
        self._ground_amsl_m: float | None = None
        self._clock = clock or LatchedClock()
        self._week_sent = False
        self._newest_estimate_ns: int | None = None  # t_ns of the newest plausible estimate; too old: silence
        self._map_fix_ns: int | None = None  # time of the last map fix
        self._estimator_failure = ""
        self._band = ThermalBand.NORMAL
        self._level = 0  # degradation level
        self._silent = False
        self._no_fix_reason: fix_type.NoFixReason | None = None
        self._started_text_sent = False
        self._faults: dict[str, tuple[CalibrationFault, Debounce[str]]] = {}  # newest of each quantity
        self._fix_debounce = Debounce[bool]()
        self._level_debounce = Debounce[int]()
        self._level_debounce.reported = 0
        self._highest_level = 0  # highest degradation level since the last map fix
        self._handlers: dict[type, Callable[[Any], list[Message]]] = {
            NavEstimate: self._on_estimate,
            VehicleState: self._on_vehicle_state,
            Imu: self._on_imu,
            GnssReading: self._on_gnss_reading,
            Origin: self._on_origin,
            InitialPosition: self._on_initial_position,
            WallClock: self._on_wall_clock,
            ProcessEvent: self._on_process_event,
            Health: self._on_health,
            EkfStatus: self._on_ekf_status,
            SearchState: self._on_search_state,
            HintVerdict: self._on_hint_verdict,
            CalibrationFault: self._on_calibration_fault,
            ServedVehicle: self._on_served_vehicle,
        }

    def on(self, message: Message) -> Iterable[Message]:
        handler = self._handlers.get(type(message))
        return [] if handler is None else handler(message)

    def tick(self, now_ns: int) -> Iterable[Message]:
        self._now_ns = now_ns
        return self._send(now_ns) if self._schedule.due(now_ns) else ()

    def _on_estimate(self, estimate: NavEstimate) -> list[Message]:
        now_ns = max(self._now_ns, estimate.emitted_at_ns)  # the last tick may be older than the estimate
        verdict, detail = self._gate.evaluate(estimate, now_ns, self._inertial, self._ground_amsl_m)
        if verdict is Verdict.ACCEPTED or (self._gate.pending_jump and detail == self._gate.pending_jump):
            self._newest_estimate_ns = max(self._newest_estimate_ns or 0, estimate.t_ns)
            self._prior_request.on_estimate(estimate)
        if verdict is Verdict.ACCEPTED:
            self._gnss.on_estimate(estimate, self._inertial)
            age_ms = estimate.last_anchor_age_ms
            if age_ms >= 0:
                self._position_confirmed = True
                self._starts.on_map_fix()
                self._map_fix_ns = max(self._map_fix_ns or 0, estimate.t_ns - age_ms * 1_000_000)
            elif self._map_fix_ns is None:
                self._map_fix_ns = estimate.t_ns  # before the first map fix the start coordinate counts as one
        return [
            MeasurementVerdict(
                t_ns=estimate.t_ns, frame_id=estimate.frame_id, measurement="estimate", verdict=verdict, detail=detail
            )
        ]

    def _on_vehicle_state(self, state: VehicleState) -> list[Message]:
        self._inertial.add_attitude(state)
        self._gnss.on_vehicle_state(state)
        self._starts.on_armed(state.armed)
        self._armed = state.armed
        self._stood = self._stood or state.armed is False
        self._position_confirmed = self._position_confirmed or (self._ground_fix and self._stood)
        return []

    def _on_imu(self, imu: Imu) -> list[Message]:
        self._inertial.add_imu(imu)
        return []

    def _on_gnss_reading(self, reading: GnssReading) -> list[Message]:
        return [*self._gnss.on_reading(reading, self._inertial), *self._starts.on_reading(reading)]

    def _on_origin(self, origin: Origin) -> list[Message]:
        self._ground_amsl_m = origin.ground_amsl_m
        self._starts.on_origin(origin)
        return []

    def _on_initial_position(self, initial: InitialPosition) -> list[Message]:
        text = self._starts.on_answer(initial)
        stands = initial.verdict is Verdict.ACCEPTED and initial.lat_deg is not None  # five seconds below 0.5 m/s
        self._position_confirmed = self._position_confirmed or stands
        return [] if text is None else [text]

    def _on_wall_clock(self, clock: WallClock) -> list[Message]:
        if clock.unix_ns is None:
            return []
        in_flight = bool(self._armed) or (self._armed is None and self._week_sent)
        why = self._clock.update(clock.unix_ns, clock.t_ns, in_flight=in_flight)
        if not why:
            return []
        return [
            MeasurementVerdict(
                t_ns=clock.t_ns,
                frame_id=NO_FRAME_ID,
                measurement="wall clock",
                verdict=Verdict.IMPLAUSIBLE,
                detail=f"{clock.source} clock {why}",
            )
        ]

    def _on_process_event(self, event: ProcessEvent) -> list[Message]:
        if event.process != "estimator":
            return []
        if event.event in ("died", "stuck", "gave_up"):
            self._estimator_failure = f"estimator {event.event.replace('_', ' ')}"
            return [statustext(event.t_ns, CRITICAL, self._estimator_failure)]
        if event.event in ("started", "restarted"):
            self._estimator_failure = ""
        return []

    def _on_health(self, health: Health) -> list[Message]:
        if health.band is self._band:
            return []
        self._band = health.band
        severity = {ThermalBand.NORMAL: INFO, ThermalBand.HOT: NOTICE, ThermalBand.CRITICAL: WARNING}[health.band]
        degrees = "" if health.temperature_c is None else f", {health.temperature_c:.0f} C"
        return [statustext(health.t_ns, severity, f"computer is {health.band}{degrees}")]

    def _on_ekf_status(self, status: EkfStatus) -> list[Message]:
        self._ekf_monitor.on_status(status)
        self._gnss.on_ekf_status(status)
        return []

    def _on_search_state(self, state: SearchState) -> list[Message]:
        self._prior_request.search_step = state.step
        return []

    def _on_hint_verdict(self, hint: HintVerdict) -> list[Message]:
        if hint.verdict is Verdict.ACCEPTED:
            self._prior_request.on_hint(hint.t_ns)
        return [statustext(hint.t_ns, INFO if hint.verdict is Verdict.ACCEPTED else WARNING, hint.text)]

    def _on_calibration_fault(self, fault: CalibrationFault) -> list[Message]:
        _, debounce = self._faults.get(fault.quantity, (fault, Debounce[str]()))
        self._faults[fault.quantity] = fault, debounce
        return list(self._fault_texts(max(self._now_ns, fault.t_ns)))

    def _fault_texts(self, now_ns: int) -> Iterator[StatusText]:
        """Texts that are due, of the faults that have begun, changed or ended."""
        for fault, debounce in self._faults.values():
            text, warning = fault_text(fault), WARNING if fault.quantity in LINK_FAULTS else CRITICAL
            if debounce.due(text, now_ns, clears=not fault.active):
                yield statustext(now_ns, warning if fault.active else INFO, text)

    def _on_served_vehicle(self, served: ServedVehicle) -> list[Message]:
        self._candidates = served.candidates
        return []

    def _send(self, now_ns: int) -> Iterator[Message]:
        """-> GpsInput of this send time and texts for the pilot; no GpsInput after 35 s without an estimate."""
        yield from self._update_degradation(now_ns)
        yield from self._fault_texts(now_ns)
        if self._armed is not False and (question := self._prior_request.due(now_ns)):  # not needed on the ground
            yield statustext(now_ns, WARNING, question)
        silent = self._newest_estimate_ns is not None and now_ns - self._newest_estimate_ns > fix_type.SILENCE_AFTER_NS
        if silent != self._silent:
            self._silent = silent
            if silent:
                after_s = fix_type.SILENCE_AFTER_NS / 1e9
                yield statustext(now_ns, CRITICAL, f"GPS_INPUT stopped: no estimate for {after_s:.0f} s")
        if silent:
            self._fix_gate.withdraw()
            yield from self._gnss.tick(now_ns, has_fix=False)
            return
        gps = self._gps_input(now_ns)
        yield gps
        has_fix = self._no_fix_reason is None
        yield from self._gnss.tick(now_ns, has_fix=has_fix)
        if self._no_fix_reason is fix_type.STARTED_IN_FLIGHT and not self._started_text_sent:
            self._started_text_sent = True
            yield statustext(now_ns, WARNING, "started in flight, searching the map")
        for uses_position, text in self._ekf_monitor.check(now_ns, has_fix=has_fix):
            yield statustext(now_ns, INFO if uses_position else WARNING, text)
        if self._fix_debounce.due(has_fix, now_ns, clears=has_fix):
            no_fix_reason = self._no_fix_reason
            yield (
                statustext(now_ns, INFO, "3D fix")
                if no_fix_reason is None
                else statustext(now_ns, WARNING, f"no fix: {no_fix_reason.short}")
            )

    def _update_degradation(self, now_ns: int) -> Iterator[StatusText]:
        """Sets the degradation level from the age of the last map fix -> texts for the pilot."""
        age_s = self._map_fix_age_s(now_ns)
        self._level = 0 if age_s is None else fix_type.degradation_level(age_s)
        after_s, _, severity = fix_type.DEGRADATION_LEVELS[self._level]
        if self._level > self._highest_level:
            urgent = severity <= WARNING
            if self._level_debounce.due(self._level, now_ns, urgent=urgent):
                yield statustext(now_ns, severity, f"no map fix for {after_s:.0f} s")
            self._highest_level = self._level
        elif self._level == 0:
            self._highest_level = 0
            if self._level_debounce.due(0, now_ns, clears=True):
                yield statustext(now_ns, INFO, "map fix again")

    def _map_fix_age_s(self, now_ns: int) -> float | None:
        """-> age of the last map fix; None before the first accepted estimate."""
        return None if self._map_fix_ns is None else (now_ns - self._map_fix_ns) * 1e-9

    def _gps_input(self, now_ns: int) -> GpsInput:
        """-> the accepted estimate, predicted to ``now_ns``, with fix type and accuracies; sets ``_no_fix_reason``."""
        if self._candidates:
            self._fix_gate.withdraw()
            text = f"the camera may be on vehicle {', '.join(map(str, self._candidates))}"
            return self._no_fix(now_ns, fix_type.NoFixReason(text, "which vehicle?"), -1.0)
        estimate = self._gate.accepted
        if estimate is None:
            reason_text = self._estimator_failure or "no estimate yet"
            return self._no_fix(now_ns, fix_type.NoFixReason(reason_text, reason_text), -1.0)
        sent, map_offset_m = self._gnss.correct_map_offset(estimate, now_ns)
        predicted = predict_to(sent, now_ns, self._inertial)
        horizontal_m, vertical_m, speed_mps = fix_type.reported_accuracy(predicted, self._level)
        if self._gate.pending_jump:
            no_fix_reason: fix_type.NoFixReason | None = fix_type.NoFixReason(
                self._gate.pending_jump, "the position has jumped"
            )
            self._fix_gate.withdraw()
        elif self._armed is not None and not self._position_confirmed:
            no_fix_reason = fix_type.ONLY_DISARMED if self._stood else fix_type.STARTED_IN_FLIGHT
            self._fix_gate.withdraw()
        else:
            no_fix_reason = self._fix_gate.evaluate(predicted, horizontal_m, self._level, estimate.source_label)
            if no_fix_reason is not None and self._estimator_failure:
                no_fix_reason = fix_type.NoFixReason(self._estimator_failure, self._estimator_failure)
        if no_fix_reason is not None:
            return self._no_fix(now_ns, no_fix_reason, predicted.age_s * 1e3)
        self._no_fix_reason = None
        degradation = gps_report.Degradation(self._level, self._map_fix_age_s(now_ns))
        accuracy = horizontal_m, vertical_m, speed_mps
        week, resets = self._week(predicted.t_ns), self._gate.jumps_accepted
        return gps_report.with_fix(predicted, accuracy, week, degradation, map_offset_m, resets=resets)

    def _no_fix(self, now_ns: int, no_fix_reason: fix_type.NoFixReason, age_ms: float) -> GpsInput:
        self._no_fix_reason = no_fix_reason
        degradation = gps_report.Degradation(self._level, self._map_fix_age_s(now_ns))
        return gps_report.no_fix(
            now_ns, no_fix_reason.text, age_ms, self._ground_amsl_m, self._week(now_ns), degradation
        )

    def _week(self, t_ns: int) -> tuple[int, int]:
        """-> GPS week and milliseconds of it at ``t_ns``; (0, 0) without a plausible clock."""
        week = self._clock.week_and_ms(t_ns)
        self._week_sent = self._week_sent or week[0] > 0
        return week
