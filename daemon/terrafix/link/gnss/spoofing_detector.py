"""Is a GNSS receiver to be believed? Its position against the vision estimate, both with what they claim.

Two tests, each on runs of readings:

* the distance, beyond 5.5 sigma of what both claim, in three readings in a row: a sudden spoofer, within a second;
* its change: where the receiver should be by how it was so far in this flight, and by our velocity
  (offset_predictor.py), and is not, for a second: a slow drag-off.

Errors of both sides last for seconds to minutes (a map fix, the map itself, multipath). For such errors a cumulative
sum of the distance (Page 1954) was measured and is worse: where it sees a drag-off as early, it has ten times the false
alarms. What these tests reach is in docs/autopilot.md, "The GNSS judge"."""

import math
from dataclasses import dataclass

from terrafix.link.gnss.offset_predictor import LAG_S, OffsetForecast
from terrafix.link.integrity.output_predictor import PredictedState, apart_m
from terrafix.messages import GnssReading, GnssState

FIX_3D = 3
SILENT_NS = 1_500_000_000  # readings come five times a second
USELESS_M = 25.0  # accuracy that a receiver claims of itself; jamming raises it before the fix goes
LEAST_M = 1.5  # 1-sigma; receivers claim less in the open, their slow error is not in it (u-blox M8: 2.5 m CEP)
UNKNOWN_M = 5.0  # of a receiver that claims nothing
DELAY_S, DELAY_SIGMA_S = 0.15, 0.1  # age of a reading on arrival: receiver, autopilot, stream
VISION_OLD_S = 2.0  # an estimate that is older says nothing about a receiver
VISION_VAGUE_M = 50.0
JUMP_SIGMAS, JUMP_READINGS = 5.5, 3
DRAG_CHANCE = 2e-4  # of being so far from the forecast, while nothing happens: one false alarm in 100 h is allowed ...
DRAG_S, DRAG_READINGS = 0.8, 3  # ... for so long: the fifth reading at 5 Hz
READING_MAX_S = 1.0  # a reading counts for the time since the last one, not for a gap
AGREE_SIGMAS, AGREE_CHANCE = 3.0, 1e-3
AGREE_VAGUE_M = 20.0  # 1-sigma of the distance: agreement within more proves nothing
FIRST_TRUST_S, AFTER_LOSS_S, AFTER_SPOOFING_S = 10.0, 30.0, 60.0  # of agreement without a break
DISPUTE_SHARE = 0.5  # a step of our own this large against the distance: it may be we who are wrong


@dataclass(frozen=True)
class Opinion:
    """What is thought of a receiver now."""

    state: GnssState
    distance_m: float | None = None  # from the vision estimate
    sigmas: float | None = None  # the same in standard deviations, when both are honest
    reason: str = ""


@dataclass(frozen=True)
class Offset:
    """Of a receiver from the estimate."""

    metres: complex  # east + j north
    sigma_m: float  # 1-sigma per axis that both claim, across the track
    along_sigma_m: float  # and along it, where the age of the reading adds, which is not known
    sigmas: float  # the distance in standard deviations
    slip_m: complex  # how much further the receiver has moved since its last reading than our velocity says
    slip_sigma_m: float  # 1-sigma per axis of all slip in LAG_S


@dataclass(frozen=True)
class _Last:
    """A reading that was compared: when and where it came, and our velocity (east + j north)."""

    t_ns: int
    lat_deg: float
    lon_deg: float
    velocity_mps: complex


class Run:
    """Readings in a row of which something is true."""

    def __init__(self) -> None:
        self.count = 0
        self.seconds = 0.0  # from the first to the last of them

    def take(self, is_so: bool, dt_s: float) -> None:
        self.seconds = self.seconds + dt_s if is_so and self.count else 0.0
        self.count = self.count + 1 if is_so else 0


class SpoofingDetector:
    """One receiver. ``take`` each reading, ``look`` in between for its silence."""

    def __init__(self) -> None:
        self.opinion = Opinion(GnssState.UNKNOWN)
        self._heard_ns: int | None = None
        self._jumped = Run()
        self._dragged = Run()
        self._forecast = OffsetForecast()
        self._last: _Last | None = None
        self._agreed_s = 0.0
        self._trust_after_s = FIRST_TRUST_S

    def take(self, reading: GnssReading, vision: PredictedState | None, own_step_m: float) -> Opinion:
        """``vision``: the estimate at the time of the reading; None: none that counts. ``own_step_m``: the largest step
        that our own estimate has made lately."""
        since_ns = reading.t_ns if self._heard_ns is None else self._heard_ns
        dt_s = min(READING_MAX_S, max(0.0, (reading.t_ns - since_ns) * 1e-9))
        self._heard_ns = reading.t_ns
        lost = _why_lost(reading)
        if lost:
            return self._lose(lost)
        if vision is None or reading.lat_deg is None or reading.lon_deg is None:
            self._forecast.pause()
            self._last = None
            return self._keep()
        velocity_mps = complex(*vision.velocity_enu_mps[:2])
        here = _Last(reading.t_ns, reading.lat_deg, reading.lon_deg, velocity_mps)
        offset = _offset(here, reading.horizontal_m, vision, self._last)
        self._last = here
        return self._compare(offset, dt_s, own_step_m)

    def look(self, now_ns: int) -> Opinion:
        if self._heard_ns is not None and now_ns - self._heard_ns > SILENT_NS:
            return self._lose("silent")
        return self.opinion

    def _compare(self, offset: Offset, dt_s: float, own_step_m: float) -> Opinion:
        bad = self.opinion.state in (GnssState.SPOOFED, GnssState.DISPUTED)
        claimed = offset.along_sigma_m, offset.slip_m, offset.slip_sigma_m
        chance, off_m = self._forecast.take(offset.metres, *claimed, dt_s, learn=not bad)
        if off_m is not None and not bad and own_step_m > DISPUTE_SHARE * off_m and chance < AGREE_CHANCE:
            self._forecast, chance = OffsetForecast(), 1.0  # it was we who moved: what is usual has to be learnt anew
        away_m = abs(offset.metres)
        self._jumped.take(offset.sigmas > JUMP_SIGMAS, dt_s)
        self._dragged.take(chance < DRAG_CHANCE, dt_s)
        if offset.sigmas >= AGREE_SIGMAS or chance < AGREE_CHANCE:
            self._agreed_s = 0.0
        elif offset.sigma_m < AGREE_VAGUE_M:
            self._agreed_s += dt_s
        state, reason = self._keep().state, self.opinion.reason
        dragged = self._dragged.count >= DRAG_READINGS and self._dragged.seconds >= DRAG_S
        if self._jumped.count >= JUMP_READINGS or dragged:
            mine = state is not GnssState.SPOOFED and own_step_m > DISPUTE_SHARE * away_m
            state = GnssState.DISPUTED if mine else GnssState.SPOOFED
            reason = f"{away_m:.0f} m away, {offset.sigmas:.1f} sigma"
            if dragged and off_m is not None:
                reason += f", {off_m:.0f} m from where it should be"
            self._forecast.pause()
            self._trust_after_s = AFTER_SPOOFING_S
        elif state is not GnssState.TRUSTED and self._agreed_s >= self._trust_after_s:
            state, reason = GnssState.TRUSTED, ""
        self.opinion = Opinion(state, away_m, offset.sigmas, reason)
        return self.opinion

    def _lose(self, reason: str) -> Opinion:
        """A receiver that was spoofed and goes silent stays spoofed: it has to earn its way back all the same."""
        self._jumped, self._dragged, self._agreed_s = Run(), Run(), 0.0
        self._forecast.pause()
        self._last = None
        if self.opinion.state is not GnssState.SPOOFED:
            if self.opinion.state is GnssState.TRUSTED:
                self._trust_after_s = max(self._trust_after_s, AFTER_LOSS_S)
            self.opinion = Opinion(GnssState.LOST, reason=reason)
        return self.opinion

    def _keep(self) -> Opinion:
        """Nothing to compare with: what was thought stays, and what was lost is there again, unproved."""
        if self.opinion.state is GnssState.LOST:
            self.opinion = Opinion(GnssState.UNKNOWN)
        return self.opinion


def _why_lost(reading: GnssReading) -> str:
    if reading.fix_type < FIX_3D:
        return "no 3D fix"
    if reading.horizontal_m is not None and reading.horizontal_m > USELESS_M:
        return f"says itself that it is only good to {reading.horizontal_m:.0f} m"
    return ""


def _offset(here: _Last, claimed_m: float | None, vision: PredictedState, last: _Last | None) -> Offset:
    """``claimed_m``: 1-sigma of the receiver, by its own word. ``last``: the reading before."""
    metres = complex(*apart_m((vision.lat_deg, vision.lon_deg), (here.lat_deg, here.lon_deg)))
    receiver_m = UNKNOWN_M if claimed_m is None else max(LEAST_M, claimed_m)
    sigma_m = math.hypot(vision.horizontal_sigma_m, receiver_m)
    speed_mps = abs(here.velocity_mps)
    along_m = (metres * here.velocity_mps.conjugate()).real / speed_mps if speed_mps > 0.0 else 0.0
    across_m2 = max(0.0, abs(metres) ** 2 - along_m**2)
    along_sigma_m = math.hypot(sigma_m, DELAY_SIGMA_S * speed_mps)
    sigmas = math.sqrt((along_m / along_sigma_m) ** 2 + across_m2 / sigma_m**2)
    slip_m = 0j
    if last is not None:
        way_m = 0.5 * (last.velocity_mps + here.velocity_mps) * ((here.t_ns - last.t_ns) * 1e-9)
        slip_m = complex(*apart_m((last.lat_deg, last.lon_deg), (here.lat_deg, here.lon_deg))) - way_m
    at_its_ends_m = math.sqrt(2.0) * math.hypot(receiver_m, DELAY_SIGMA_S * speed_mps)
    slip_sigma_m = math.hypot(LAG_S * vision.speed_sigma_mps, at_its_ends_m)
    return Offset(metres, sigma_m, along_sigma_m, sigmas, slip_m, slip_sigma_m)
