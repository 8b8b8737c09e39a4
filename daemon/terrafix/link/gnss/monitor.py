"""Consequences of the assessment of the receivers: texts to the pilot, and in mode "act" the switch of the source."""

import math
from collections import deque
from collections.abc import Iterator

from terrafix.core.clock import NS_PER_S
from terrafix.core.config import GnssMode
from terrafix.link.gnss.map_registration import MAP, MapOffsetEstimator
from terrafix.link.gnss.spoofing_detector import (
    MAX_VISION_AGE_S,
    MAX_VISION_SIGMA_M,
    READING_DELAY_S,
    Assessment,
    SpoofingDetector,
)
from terrafix.link.integrity.fix_type import SILENCE_AFTER_NS
from terrafix.link.integrity.output_predictor import InertialBuffer, PredictedState, distance_m, predict_to
from terrafix.link.pilot_text.statustext import CRITICAL, INFO, NOTICE, WARNING, statustext
from terrafix.messages import (
    EkfStatus,
    GnssReading,
    GnssState,
    GnssVerdict,
    MapOffset,
    Message,
    NavEstimate,
    PositionSource,
    VehicleState,
)

GNSS_VERDICT_PERIOD_NS = NS_PER_S  # ns; a verdict is published on every change, and in this period [tuned]
# ns for which a step of our own estimate counts as a possible cause of a disagreement. [tuned]
OWN_STEP_MEMORY_NS = 10 * NS_PER_S
MIN_FIX_DURATION_NS = 2 * NS_PER_S  # ns with a 3D fix of ours before the autopilot is switched to it [tuned]
MIN_VISION_NS = 30 * NS_PER_S  # ns on our position before a switch back [tuned]
# m from the autopilot's own position to ours; over a larger step it is not switched [spec: ON-6 of the requirements]
MAX_SWITCH_STEP_M = 200.0
EKF_POSITION_TIMEOUT_NS = 3 * NS_PER_S  # its position comes with its status, at 1 Hz [spec: link/mavlink/message_rates]
MIN_GNSS_NS = 5 * NS_PER_S  # ns on the receiver before a further switch; short, for repeated spoofing [tuned]
# ns without a 3D fix of ours for which the autopilot must not use a spoofed receiver. Its EKF rejects that position for
# 7 s and is then reset to it; a gap shorter than the first one costs no parameter. [measured: docs/autopilot-facts.md]
LOCKOUT_NS = (NS_PER_S, SILENCE_AFTER_NS)
MIN_REPORTED_OFFSET_M = 3.0  # m; smaller map offsets are not reported to the pilot [tuned]
UNUSABLE_STATES = (GnssState.LOST, GnssState.SPOOFED)


class GnssMonitor:
    """``on_estimate`` for each accepted estimate, ``on_reading`` for each reading of a receiver, ``tick`` at every
    transmission."""

    def __init__(
        self, mode: GnssMode, map_offsets: MapOffsetEstimator | None = None, *, on_vision: bool = False
    ) -> None:
        """``map_offsets`` None: the map offset is not estimated. ``on_vision``: an earlier link process switched the
        autopilot to our position, and nothing has switched it back."""
        self._mode = mode
        self._map_offsets = map_offsets
        self._offset_reported = False
        self._detectors: dict[int, SpoofingDetector] = {}
        self._published: dict[int, tuple[GnssState, int]] = {}  # receiver -> (state, time of publication)
        self._estimate: NavEstimate | None = None
        self._own_steps: deque[tuple[int, float]] = deque()  # (t_ns, step [m]) of the estimate
        self._fix_since_ns: int | None = None
        self._last_fix_ns: int | None = None
        self._armed: bool | None = None
        self._on_vision = on_vision
        self._fallback = True  # the autopilot may use its receiver while we send no fix
        self._switched_ns: int | None = None
        self._ekf_status: EkfStatus | None = None
        self._refused = False  # a switch to our position, that was reported to the pilot

    def on_estimate(self, estimate: NavEstimate, inertial: InertialBuffer) -> None:
        if self._estimate is not None:
            before = predict_to(self._estimate, estimate.t_ns, inertial)
            step_m = distance_m(before.lat_deg, before.lon_deg, estimate.lat_deg, estimate.lon_deg)
            self._own_steps.append((estimate.t_ns, step_m))
            self._forget_steps(estimate.t_ns)  # without readings, too
        self._estimate = estimate

    def _forget_steps(self, now_ns: int) -> None:
        while self._own_steps and now_ns - self._own_steps[0][0] > OWN_STEP_MEMORY_NS:
            self._own_steps.popleft()

    def on_vehicle_state(self, state: VehicleState) -> None:
        self._armed = state.armed

    def on_ekf_status(self, status: EkfStatus) -> None:
        self._ekf_status = status

    def on_reading(self, reading: GnssReading, inertial: InertialBuffer) -> Iterator[Message]:
        if self._mode == "off":
            return
        detector = self._detectors.setdefault(reading.receiver, SpoofingDetector())
        self._forget_steps(reading.t_ns)
        own_step_m = max((step_m for _, step_m in self._own_steps), default=0.0)
        vision = self._vision_at_reading(reading.t_ns, inertial)
        assessment = detector.update(reading, vision, own_step_m)
        if self._map_offsets is not None:
            trusted = assessment.state is GnssState.TRUSTED
            map_offset = self._map_offsets.update(reading, vision, self._estimate, trusted=trusted)
            if map_offset is not None:
                yield from self._publish_offset(map_offset, reading)
        yield from self._publish(reading.receiver, assessment, reading.t_ns)

    def correct_map_offset(self, estimate: NavEstimate, now_ns: int) -> tuple[NavEstimate, tuple[float, float]]:
        """See MapOffsetEstimator.correct."""
        return (estimate, (0.0, 0.0)) if self._map_offsets is None else self._map_offsets.correct(estimate, now_ns)

    def tick(self, now_ns: int, *, has_fix: bool) -> Iterator[Message]:
        """``has_fix``: a 3D fix is sent now."""
        self._fix_since_ns = (self._fix_since_ns or now_ns) if has_fix else None
        self._last_fix_ns = now_ns if has_fix else self._last_fix_ns
        if self._on_vision and (self._armed is False or self._mode != "act"):
            yield from self._select(now_ns, vision=False)
        if self._mode == "off":
            return
        for receiver, detector in self._detectors.items():
            yield from self._publish(receiver, detector.check_timeout(now_ns), now_ns)
        if self._mode == "act" and self._detectors:
            yield from self._switch(now_ns)
            yield from self._lock_out(now_ns)

    def _vision_at_reading(self, now_ns: int, inertial: InertialBuffer) -> PredictedState | None:
        """Our estimate at the time of a reading that arrives now; None when it is too old or too uncertain. Before the
        first map fix it is not used: it is a start coordinate, which may belong to another flight."""
        if self._estimate is None or self._estimate.last_anchor_age_ms < 0:
            return None
        predicted = predict_to(self._estimate, now_ns - round(READING_DELAY_S * NS_PER_S), inertial)
        uncertain = predicted.horizontal_sigma_m > MAX_VISION_SIGMA_M
        return None if uncertain or predicted.age_s > MAX_VISION_AGE_S else predicted

    def _publish(self, receiver: int, assessment: Assessment, now_ns: int) -> Iterator[Message]:
        before, published_ns = self._published.get(receiver, (GnssState.UNKNOWN, -GNSS_VERDICT_PERIOD_NS))
        changed = assessment.state is not before
        if not changed and now_ns - published_ns < GNSS_VERDICT_PERIOD_NS:
            return
        self._published[receiver] = (assessment.state, now_ns)
        yield GnssVerdict(
            t_ns=now_ns,
            receiver=receiver,
            state=assessment.state,
            distance_m=assessment.distance_m,
            sigmas=assessment.sigmas,
            reason=assessment.reason,
        )
        text = self._pilot_text(receiver + 1, before, assessment) if changed else None
        if text is not None:
            yield statustext(now_ns, *text)

    def _publish_offset(self, map_offset: MapOffset, reading: GnssReading) -> Iterator[Message]:
        yield map_offset
        offset_m = math.hypot(*map_offset.state[MAP])
        if not self._offset_reported and offset_m >= MIN_REPORTED_OFFSET_M:
            self._offset_reported = True
            yield statustext(reading.t_ns, INFO, f"map is {offset_m:.0f} m off GPS {reading.receiver + 1}")

    def _pilot_text(self, number: int, before: GnssState, assessment: Assessment) -> tuple[int, str] | None:
        """-> (MAV_SEVERITY, text) about a change of state, or None. A receiver that was never trusted is not reported
        as lost."""
        match assessment.state:
            case GnssState.SPOOFED:
                return CRITICAL, f"GPS {number} is {assessment.distance_m or 0:.0f} m off the map"
            case GnssState.DISPUTED:
                return WARNING, f"GPS {number} and the map disagree"
            case GnssState.LOST if before is GnssState.TRUSTED:
                return WARNING, f"GPS {number} is lost"
            case GnssState.TRUSTED if before is not GnssState.UNKNOWN:
                return INFO, f"GPS {number} agrees with the map again"
        return None

    def _switch(self, now_ns: int) -> Iterator[Message]:
        """To our position when no receiver is usable, by a step of MAX_SWITCH_STEP_M at most; back when one is
        trusted."""
        wait_ns = MIN_VISION_NS if self._on_vision else MIN_GNSS_NS
        if self._armed is False or (self._switched_ns is not None and now_ns - self._switched_ns < wait_ns):
            return
        states = [detector.assessment.state for detector in self._detectors.values()]
        if not self._on_vision and self._own_fix(now_ns) and all(state in UNUSABLE_STATES for state in states):
            yield from self._promote(now_ns)
        elif self._on_vision and any(state is GnssState.TRUSTED for state in states):
            yield from self._select(now_ns, vision=False)

    def _promote(self, now_ns: int) -> Iterator[Message]:
        step_m = self._step_m(now_ns)
        if step_m <= MAX_SWITCH_STEP_M:
            self._refused = False
            yield from self._select(now_ns, vision=True)
        elif not self._refused:
            self._refused = True
            yield statustext(now_ns, CRITICAL, f"not switched: the map is {step_m:.0f} m off")

    def _step_m(self, now_ns: int) -> float:
        """From where the autopilot takes itself to be to our position: by its own report, else by the receivers, all of
        which are unusable. Without any position it has none to step from: 0."""
        status = self._ekf_status
        if status is None or status.lat_deg is None or now_ns - status.t_ns > EKF_POSITION_TIMEOUT_NS:
            return max((d.assessment.distance_m or 0.0 for d in self._detectors.values()), default=0.0)
        assert self._estimate is not None and status.lon_deg is not None  # we have a fix
        ours = predict_to(self._estimate, status.t_ns, InertialBuffer())
        return distance_m(ours.lat_deg, ours.lon_deg, status.lat_deg, status.lon_deg)

    def _lock_out(self, now_ns: int) -> Iterator[Message]:
        """While we are without a fix and a receiver is spoofed, the autopilot must not fall back to it."""
        if not self._on_vision or self._last_fix_ns is None:
            return
        without_fix_ns = now_ns - self._last_fix_ns
        spoofed = any(detector.assessment.state is GnssState.SPOOFED for detector in self._detectors.values())
        if self._fallback and spoofed and LOCKOUT_NS[0] <= without_fix_ns < LOCKOUT_NS[1]:
            self._fallback = False
        elif not self._fallback and (self._own_fix(now_ns) or not spoofed or without_fix_ns >= LOCKOUT_NS[1]):
            self._fallback = True
        else:
            return
        yield PositionSource(t_ns=now_ns, vision=True, receiver=0, fallback=self._fallback)

    def _own_fix(self, now_ns: int) -> bool:
        """Whether we have had a fix for some time."""
        return self._fix_since_ns is not None and now_ns - self._fix_since_ns >= MIN_FIX_DURATION_NS

    def _select(self, now_ns: int, *, vision: bool) -> Iterator[Message]:
        self._on_vision, self._switched_ns, self._fallback = vision, now_ns, True
        receiver = next((n for n, d in self._detectors.items() if d.assessment.state is GnssState.TRUSTED), 0)
        yield PositionSource(t_ns=now_ns, vision=vision, receiver=receiver)
        yield statustext(now_ns, NOTICE, f"position source: {'map' if vision else 'GPS'}")
