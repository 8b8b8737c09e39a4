"""The link's decisions: which estimate is believed, what the autopilot is told, and when. Pure; the edge sends it."""

from collections.abc import Iterable, Iterator

from terrafix.core.config import GnssMode
from terrafix.core.node import Edge, NodeContext
from terrafix.link.autopilot.checkpoint import load_checkpoint
from terrafix.link.autopilot.ekf_status_monitor import FilterWatch
from terrafix.link.gnss.initial_position import GnssStarts
from terrafix.link.gnss.map_registration import MapOffsets
from terrafix.link.gnss.monitor import GnssMonitor
from terrafix.link.ground_station.prior_request import PriorRequest
from terrafix.link.integrity import fix_type
from terrafix.link.integrity.estimate_gate import EstimateGate
from terrafix.link.integrity.output_predictor import Attitudes, predict_to
from terrafix.link.output import gps_report
from terrafix.link.output.gps_time import LatchedClock
from terrafix.link.output.send_schedule import SendSchedule
from terrafix.link.pilot_text.debounce import Debounce
from terrafix.link.pilot_text.statustext import CRITICAL, INFO, NOTICE, WARNING, fault_words, statustext
from terrafix.messages import (
    CalibrationFault,
    FilterStatus,
    GnssReading,
    GpsInput,
    Health,
    HintVerdict,
    Imu,
    MeasurementVerdict,
    Message,
    NavEstimate,
    Origin,
    ProcessEvent,
    SearchState,
    Start,
    StatusText,
    ThermalBand,
    VehicleState,
    Verdict,
    WallClock,
)

TICK_HZ = 50.0  # as in the process table


def make_node(ctx: NodeContext) -> "LinkNode":
    link, before = ctx.config.link, load_checkpoint(ctx.checkpoint)
    offsets = MapOffsets(None if before is None else before.map_offset) if link.map_offset else None
    clock = LatchedClock(None if before is None else before.unix_minus_monotonic_ns)
    return LinkNode(link.rate_hz, link.gnss, gnss_start=link.gnss_start, map_offsets=offsets, clock=clock)


def make_edge(ctx: NodeContext) -> Edge:
    """For a process of its own. Raises LinkError when the device cannot be opened, ConfigError."""
    from terrafix.link.edge import open_edge  # replay has no edge and need not load MAVLink
    from terrafix.link.output.realtime_priority import first_in_line

    edge = open_edge(ctx.config.link, ctx.checkpoint)
    first_in_line()
    return edge


class LinkNode:
    """Hears estimates, says GpsInput at ``rate_hz``. ``map_offsets`` None: the map's error is not learnt. ``clock``: of
    the link before this one, of the same flight."""

    def __init__(
        self,
        rate_hz: float,
        gnss: GnssMode = "advise",
        *,
        gnss_start: bool = True,
        map_offsets: MapOffsets | None = None,
        clock: LatchedClock | None = None,
    ) -> None:
        self._pacer = SendSchedule(rate_hz, TICK_HZ)
        self._gate = EstimateGate()
        self._fix = fix_type.FixGate()
        self._attitudes = Attitudes()
        self._gnss = GnssMonitor(gnss, map_offsets)
        self._starts = GnssStarts(wanted=gnss_start)
        self._asking = PriorRequest()
        self._filter = FilterWatch()
        self._armed: bool | None = None
        self._start_holds = False  # the vehicle was seen on the ground, or the map has confirmed where it is
        self._now_ns = 0
        self._ground_amsl_m: float | None = None
        self._clock = clock or LatchedClock()
        self._week_sent = False
        self._heard_ns: int | None = None  # newest time of any plausible estimate: somebody has something to say
        self._anchored_ns: int | None = None  # time of the last map fix
        self._estimator_gone = ""
        self._band = ThermalBand.NORMAL
        self._rung = 0
        self._silent = False
        self._no_fix_because: fix_type.NoFixReason | None = None
        self._said_started = False
        self._said_fix = Debounce[bool]()
        self._said_rung = Debounce[int]()
        self._said_rung.told = 0
        self._climbed = 0  # the highest rung since the last map fix

    def on(self, message: Message) -> Iterable[Message]:
        match message:
            case NavEstimate():
                return [self._on_estimate(message)]
            case VehicleState():
                self._attitudes.add(message)
                self._gnss.vehicle(message)
                self._starts.vehicle(message.armed)
                self._armed = message.armed
                self._start_holds = self._start_holds or message.armed is False
            case Imu():
                self._attitudes.add_imu(message)
            case GnssReading():
                return [*self._gnss.reading(message, self._attitudes), *self._starts.reading(message)]
            case Origin():
                self._ground_amsl_m = message.ground_amsl_m
                self._starts.origin(message)
            case Start():
                text = self._starts.answer(message)
                return [] if text is None else [text]
            case WallClock(unix_ns=int()):
                return self._on_wall_clock(message)
            case ProcessEvent(process="estimator"):
                return self._on_estimator_event(message)
            case Health():
                return self._on_health(message)
            case FilterStatus():
                self._filter.status(message)
            case SearchState():
                self._asking.step = message.step
            case HintVerdict():
                return [self._on_hint(message)]
            case CalibrationFault():
                return [statustext(message.t_ns, CRITICAL if message.active else INFO, fault_words(message))]
        return []

    def tick(self, now_ns: int) -> Iterable[Message]:
        self._now_ns = now_ns
        return self._send(now_ns) if self._pacer.due(now_ns) else ()

    def _on_estimate(self, estimate: NavEstimate) -> MeasurementVerdict:
        now_ns = max(self._now_ns, estimate.emitted_at_ns)  # the last tick may be older than the estimate
        verdict, detail = self._gate.consider(estimate, now_ns, self._attitudes, self._ground_amsl_m)
        if verdict is Verdict.ACCEPTED or (self._gate.holding and detail == self._gate.holding):
            self._heard_ns = max(self._heard_ns or 0, estimate.t_ns)
            self._asking.estimate(estimate)
        if verdict is Verdict.ACCEPTED:
            self._gnss.accepted(estimate, self._attitudes)
            age_ms = estimate.last_anchor_age_ms
            if age_ms >= 0:
                self._start_holds = True
                self._starts.anchored()
                self._anchored_ns = max(self._anchored_ns or 0, estimate.t_ns - age_ms * 1_000_000)
            elif self._anchored_ns is None:
                self._anchored_ns = estimate.t_ns  # never anchored: the start coordinate is the map fix of this flight
        return MeasurementVerdict(
            t_ns=estimate.t_ns, frame_id=estimate.frame_id, measurement="estimate", verdict=verdict, detail=detail
        )

    def _on_wall_clock(self, clock: WallClock) -> list[Message]:
        if clock.unix_ns is None:
            return []
        in_flight = bool(self._armed) or (self._armed is None and self._week_sent)
        why = self._clock.hear(clock.unix_ns, clock.t_ns, in_flight=in_flight)
        if not why:
            return []
        return [
            MeasurementVerdict(
                t_ns=clock.t_ns,
                frame_id=-1,
                measurement="wall clock",
                verdict=Verdict.IMPLAUSIBLE,
                detail=f"{clock.source} clock {why}",
            )
        ]

    def _on_estimator_event(self, event: ProcessEvent) -> list[Message]:
        if event.event in ("died", "stuck", "gave_up"):
            self._estimator_gone = f"estimator {event.event.replace('_', ' ')}"
            return [statustext(event.t_ns, CRITICAL, self._estimator_gone)]
        if event.event in ("started", "restarted"):
            self._estimator_gone = ""
        return []

    def _on_health(self, health: Health) -> list[Message]:
        if health.band is self._band:
            return []
        self._band = health.band
        severity = {ThermalBand.NORMAL: INFO, ThermalBand.HOT: NOTICE, ThermalBand.CRITICAL: WARNING}[health.band]
        degrees = "" if health.temperature_c is None else f", {health.temperature_c:.0f} C"
        return [statustext(health.t_ns, severity, f"computer is {health.band}{degrees}")]

    def _on_hint(self, hint: HintVerdict) -> StatusText:
        if hint.verdict is Verdict.ACCEPTED:
            self._asking.hinted(hint.t_ns)
        return statustext(hint.t_ns, INFO if hint.verdict is Verdict.ACCEPTED else WARNING, hint.text)

    def _send(self, now_ns: int) -> Iterator[Message]:
        yield from self._climb_ladder(now_ns)
        if self._armed is not False and (question := self._asking.due(now_ns)):  # on the ground nobody is lost
            yield statustext(now_ns, WARNING, question)
        silent = self._heard_ns is not None and now_ns - self._heard_ns > fix_type.SILENT_AFTER_NS
        if silent != self._silent:
            self._silent = silent
            if silent:
                yield statustext(now_ns, CRITICAL, f"silent: no estimate for {fix_type.SILENT_AFTER_NS / 1e9:.0f} s")
        if silent:
            self._fix.lower()
            yield from self._gnss.tick(now_ns, good=False)
            return
        gps = self._gps_input(now_ns)
        yield gps
        good = self._no_fix_because is None
        yield from self._gnss.tick(now_ns, good=good)
        if self._no_fix_because is fix_type.STARTED_IN_FLIGHT and not self._said_started:
            self._said_started = True
            yield statustext(now_ns, WARNING, "started in flight, searching the map")
        for uses, text in self._filter.look(now_ns, good=good):
            yield statustext(now_ns, INFO if uses else WARNING, text)
        if self._said_fix.due(good, now_ns, clears=good):
            because = self._no_fix_because
            yield (
                statustext(now_ns, INFO, "3D fix")
                if because is None
                else statustext(now_ns, WARNING, f"no fix: {because.short}")
            )

    def _climb_ladder(self, now_ns: int) -> Iterator[StatusText]:
        age_s = self._unanchored_s(now_ns)
        self._rung = 0 if age_s is None else fix_type.degradation_level(age_s)
        after_s, _, severity = fix_type.DEGRADATION_LEVELS[self._rung]
        if self._rung > self._climbed:
            urgent = severity <= WARNING
            if self._said_rung.due(self._rung, now_ns, urgent=urgent):
                yield statustext(now_ns, severity, f"no map fix for {after_s:.0f} s")
            self._climbed = self._rung
        elif self._rung == 0:
            self._climbed = 0
            if self._said_rung.due(0, now_ns, clears=True):
                yield statustext(now_ns, INFO, "map fix again")

    def _unanchored_s(self, now_ns: int) -> float | None:
        """Seconds without a map fix; None: nothing was ever believed."""
        return None if self._anchored_ns is None else (now_ns - self._anchored_ns) * 1e-9

    def _gps_input(self, now_ns: int) -> GpsInput:
        estimate = self._gate.accepted
        if estimate is None:
            nobody = self._estimator_gone or "no estimate yet"
            return self._no_fix(now_ns, fix_type.NoFixReason(nobody, nobody), -1.0)
        sent, map_offset_m = self._gnss.less_map_offset(estimate, now_ns)
        carried = predict_to(sent, now_ns, self._attitudes)
        horizontal_m, vertical_m, speed_mps = fix_type.reported_accuracy(carried, self._rung)
        if self._gate.holding:
            why: fix_type.NoFixReason | None = fix_type.NoFixReason(self._gate.holding, "the position has jumped")
            self._fix.lower()
        elif self._armed and not self._start_holds:
            why = fix_type.STARTED_IN_FLIGHT
            self._fix.lower()
        else:
            why = self._fix.judge(carried, horizontal_m, self._rung, estimate.source_label)
            if why is not None and self._estimator_gone:
                why = fix_type.NoFixReason(self._estimator_gone, self._estimator_gone)
        if why is not None:
            return self._no_fix(now_ns, why, carried.age_s * 1e3)
        self._no_fix_because = None
        caution = gps_report.Degradation(self._rung, self._unanchored_s(now_ns))
        accuracy = horizontal_m, vertical_m, speed_mps
        week, resets = self._week(carried.t_ns), self._gate.steps
        return gps_report.with_fix(carried, accuracy, week, caution, map_offset_m, resets=resets)

    def _no_fix(self, now_ns: int, why: fix_type.NoFixReason, age_ms: float) -> GpsInput:
        self._no_fix_because = why
        caution = gps_report.Degradation(self._rung, self._unanchored_s(now_ns))
        return gps_report.no_fix(now_ns, why.text, age_ms, self._ground_amsl_m, self._week(now_ns), caution)

    def _week(self, t_ns: int) -> tuple[int, int]:
        week = self._clock.week(t_ns)
        self._week_sent = self._week_sent or week[0] > 0
        return week
