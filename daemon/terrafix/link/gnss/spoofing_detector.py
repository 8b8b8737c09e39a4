"""Spoofing detection for one GNSS receiver: its position against the vision estimate, each with its claimed accuracy.

Two tests, each over a run of readings:

* distance: beyond 5.5 sigma of both claims in three readings in a row. It detects a sudden spoofing within a second;
* change of the distance: improbable, for a second, under the prediction from the offsets of this flight and from our
  velocity (offset_predictor.py). It detects a slow drag-off.

The errors of both sides are correlated over seconds to minutes (a map fix, the map itself, multipath). For such errors
a cumulative sum of the distance (Page 1954) was measured and is worse: where it detects a drag-off as early, it has ten
times the false alarms. The performance of these tests is in docs/autopilot.md, "The spoofing detector"."""

import math
from dataclasses import dataclass

from terrafix.link.gnss.offset_predictor import HORIZON_S, OffsetPredictor
from terrafix.link.integrity.output_predictor import PredictedState, east_north_m
from terrafix.messages import FIX_3D, GnssReading, GnssState

READING_TIMEOUT_NS = 1_500_000_000  # ns; readings arrive five times a second [tuned]
MAX_RECEIVER_SIGMA_M = 25.0  # m, claimed by the receiver; jamming raises it before the fix is lost [tuned]
# m, 1-sigma. Receivers claim less under open sky, without their slowly varying error (u-blox M8: 2.5 m CEP). [tuned]
MIN_RECEIVER_SIGMA_M = 1.5
DEFAULT_RECEIVER_SIGMA_M = 5.0  # m, 1-sigma of a receiver without a claim [tuned]
READING_DELAY_S, READING_DELAY_SIGMA_S = 0.15, 0.1  # s; age on arrival: receiver, autopilot, stream [tuned]
MAX_VISION_AGE_S = 2.0  # s; an older estimate is not compared [tuned]
MAX_VISION_SIGMA_M = 50.0  # m; an estimate with a larger 1-sigma is not compared [tuned]
GNSS_JUMP_SIGMAS, JUMP_READINGS = 5.5, 3  # chosen in 5000 h with 5 alarms [measured: docs/autopilot.md]
# Drag-off test: p-value below which a reading counts, and how long that must last (the fifth reading at 5 Hz). One
# false alarm in 100 h is allowed; measured was one in 770 h. [measured: docs/autopilot.md]
DRAG_P_VALUE = 2e-4
DRAG_MIN_S, DRAG_MIN_READINGS = 0.8, 3  # s, readings in a row [measured: docs/autopilot.md]
MAX_READING_INTERVAL_S = 1.0  # s; a reading counts for the time since the last one, up to this [tuned]
GNSS_AGREEMENT_SIGMAS, AGREEMENT_P_VALUE = 3.0, 1e-3  # within these a reading agrees with the estimate [tuned]
AGREEMENT_MAX_SIGMA_M = 20.0  # m, 1-sigma of the distance; with a larger one agreement has no weight [tuned]
# s of agreement without a break before a receiver is trusted. [tuned]
TRUST_AFTER_START_S, TRUST_AFTER_LOSS_S, TRUST_AFTER_SPOOFING_S = 10.0, 30.0, 60.0
DISPUTE_STEP_SHARE = 0.5  # step of our estimate over the distance, above which our estimate may be wrong [tuned]


@dataclass(frozen=True)
class Assessment:
    """Result for a receiver at present."""

    state: GnssState
    distance_m: float | None = None  # from the vision estimate
    sigmas: float | None = None  # the distance in claimed standard deviations
    reason: str = ""


@dataclass(frozen=True)
class ReceiverOffset:
    """Offset of a receiver from the estimate."""

    offset_m: complex  # east + j north
    sigma_m: float  # claimed 1-sigma per axis of both sides, across the track
    along_sigma_m: float  # along the track, with the term of the unknown age of the reading
    sigmas: float  # length of the offset in standard deviations
    drift_m: complex  # displacement of the receiver since its last reading minus the integral of our velocity
    drift_sigma_m: float  # 1-sigma per axis of the drift over HORIZON_S


@dataclass(frozen=True)
class _ComparedReading:
    """A reading that was compared, with our velocity (east + j north)."""

    t_ns: int
    lat_deg: float
    lon_deg: float
    velocity_mps: complex


class ReadingRun:
    """Readings in a row for which a condition holds. ``seconds``: from the first to the last of them."""

    def __init__(self) -> None:
        self.count = 0
        self.seconds = 0.0

    def update(self, holds: bool, dt_s: float) -> None:
        self.seconds = self.seconds + dt_s if holds and self.count else 0.0
        self.count = self.count + 1 if holds else 0


class SpoofingDetector:
    """Detector for one receiver. ``update`` with each reading, ``check_timeout`` between readings."""

    def __init__(self) -> None:
        self.assessment = Assessment(GnssState.UNKNOWN)
        self._reading_t_ns: int | None = None
        self._jump_run = ReadingRun()
        self._drag_run = ReadingRun()
        self._predictor = OffsetPredictor()
        self._last: _ComparedReading | None = None
        self._agreement_s = 0.0
        self._trust_after_s = TRUST_AFTER_START_S

    def update(self, reading: GnssReading, vision: PredictedState | None, own_step_m: float) -> Assessment:
        """``vision``: the estimate at the time of the reading, None when there is none to compare with. ``own_step_m``:
        the largest recent step of our own estimate."""
        since_ns = reading.t_ns if self._reading_t_ns is None else self._reading_t_ns
        dt_s = min(MAX_READING_INTERVAL_S, max(0.0, (reading.t_ns - since_ns) * 1e-9))
        self._reading_t_ns = reading.t_ns
        loss = _loss_reason(reading)
        if loss:
            return self._mark_lost(loss)
        if vision is None or reading.lat_deg is None or reading.lon_deg is None:
            self._predictor.clear_pending()
            self._last = None
            return self._without_comparison()
        velocity_mps = complex(*vision.velocity_enu_mps[:2])
        here = _ComparedReading(reading.t_ns, reading.lat_deg, reading.lon_deg, velocity_mps)
        offset = _receiver_offset(here, reading.horizontal_m, vision, self._last)
        self._last = here
        return self._compare(offset, dt_s, own_step_m)

    def check_timeout(self, now_ns: int) -> Assessment:
        if self._reading_t_ns is not None and now_ns - self._reading_t_ns > READING_TIMEOUT_NS:
            return self._mark_lost("silent")
        return self.assessment

    def _compare(self, offset: ReceiverOffset, dt_s: float, own_step_m: float) -> Assessment:
        distrusted = self.assessment.state in (GnssState.SPOOFED, GnssState.DISPUTED)
        claims = offset.along_sigma_m, offset.drift_m, offset.drift_sigma_m
        p_value, error_m = self._predictor.update(offset.offset_m, *claims, dt_s, learn=not distrusted)
        own_step = error_m is not None and not distrusted and own_step_m > DISPUTE_STEP_SHARE * error_m
        if own_step and p_value < AGREEMENT_P_VALUE:
            self._predictor, p_value = OffsetPredictor(), 1.0  # our estimate moved: the statistics restart
        distance_m = abs(offset.offset_m)
        self._jump_run.update(offset.sigmas > GNSS_JUMP_SIGMAS, dt_s)
        self._drag_run.update(p_value < DRAG_P_VALUE, dt_s)
        if offset.sigmas >= GNSS_AGREEMENT_SIGMAS or p_value < AGREEMENT_P_VALUE:
            self._agreement_s = 0.0
        elif offset.sigma_m < AGREEMENT_MAX_SIGMA_M:
            self._agreement_s += dt_s
        state, reason = self._without_comparison().state, self.assessment.reason
        dragged = self._drag_run.count >= DRAG_MIN_READINGS and self._drag_run.seconds >= DRAG_MIN_S
        if self._jump_run.count >= JUMP_READINGS or dragged:
            disputed = state is not GnssState.SPOOFED and own_step_m > DISPUTE_STEP_SHARE * distance_m
            state = GnssState.DISPUTED if disputed else GnssState.SPOOFED
            reason = f"{distance_m:.0f} m away, {offset.sigmas:.1f} sigma"
            if dragged and error_m is not None:
                reason += f", {error_m:.0f} m from where it should be"
            self._predictor.clear_pending()
            self._trust_after_s = TRUST_AFTER_SPOOFING_S
        elif state is not GnssState.TRUSTED and self._agreement_s >= self._trust_after_s:
            state, reason = GnssState.TRUSTED, ""
        self.assessment = Assessment(state, distance_m, offset.sigmas, reason)
        return self.assessment

    def _mark_lost(self, reason: str) -> Assessment:
        """The reading is unusable or missing. A spoofed receiver stays spoofed: it still needs the long agreement."""
        self._jump_run, self._drag_run, self._agreement_s = ReadingRun(), ReadingRun(), 0.0
        self._predictor.clear_pending()
        self._last = None
        if self.assessment.state is not GnssState.SPOOFED:
            if self.assessment.state is GnssState.TRUSTED:
                self._trust_after_s = max(self._trust_after_s, TRUST_AFTER_LOSS_S)
            self.assessment = Assessment(GnssState.LOST, reason=reason)
        return self.assessment

    def _without_comparison(self) -> Assessment:
        """A usable reading without a comparison: LOST becomes UNKNOWN, every other state remains."""
        if self.assessment.state is GnssState.LOST:
            self.assessment = Assessment(GnssState.UNKNOWN)
        return self.assessment


def _loss_reason(reading: GnssReading) -> str:
    """Why the receiver counts as lost; empty when it does not."""
    if reading.fix_type < FIX_3D:
        return "no 3D fix"
    if reading.horizontal_m is not None and reading.horizontal_m > MAX_RECEIVER_SIGMA_M:
        return f"says itself that it is only good to {reading.horizontal_m:.0f} m"
    return ""


def _receiver_offset(
    here: _ComparedReading, claimed_m: float | None, vision: PredictedState, last: _ComparedReading | None
) -> ReceiverOffset:
    """``claimed_m``: 1-sigma claimed by the receiver. ``last``: the reading before ``here``."""
    offset_m = complex(*east_north_m((vision.lat_deg, vision.lon_deg), (here.lat_deg, here.lon_deg)))
    receiver_m = DEFAULT_RECEIVER_SIGMA_M if claimed_m is None else max(MIN_RECEIVER_SIGMA_M, claimed_m)
    sigma_m = math.hypot(vision.horizontal_sigma_m, receiver_m)
    speed_mps = abs(here.velocity_mps)
    along_m = (offset_m * here.velocity_mps.conjugate()).real / speed_mps if speed_mps > 0.0 else 0.0
    across_m2 = max(0.0, abs(offset_m) ** 2 - along_m**2)
    along_sigma_m = math.hypot(sigma_m, READING_DELAY_SIGMA_S * speed_mps)
    sigmas = math.sqrt((along_m / along_sigma_m) ** 2 + across_m2 / sigma_m**2)
    drift_m = 0j
    if last is not None:
        own_m = 0.5 * (last.velocity_mps + here.velocity_mps) * ((here.t_ns - last.t_ns) * 1e-9)
        drift_m = complex(*east_north_m((last.lat_deg, last.lon_deg), (here.lat_deg, here.lon_deg))) - own_m
    endpoints_sigma_m = math.sqrt(2.0) * math.hypot(receiver_m, READING_DELAY_SIGMA_S * speed_mps)
    drift_sigma_m = math.hypot(HORIZON_S * vision.speed_sigma_mps, endpoints_sigma_m)
    return ReceiverOffset(offset_m, sigma_m, along_sigma_m, sigmas, drift_m, drift_sigma_m)
