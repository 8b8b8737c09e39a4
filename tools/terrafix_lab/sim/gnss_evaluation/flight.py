"""One flight for the GNSS spoofing detector, as messages: a receiver with disturbances, and consistent estimates.

The receiver is that of the simulated vehicles (sim/sensors/gnss.py). The estimate's error is the sum of a constant
part (the map) and a Gauss-Markov part, together as large as its covariance states; in some flights it is dead reckoned
for a while.
"""

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import count, islice

import numpy as np

from terrafix.core.geodesy import LocalFrame
from terrafix.link.gnss.map_registration import MapOffsetEstimator
from terrafix.link.node import LinkNode
from terrafix.messages import (
    GnssReading,
    GnssState,
    GnssVerdict,
    Message,
    NavEstimate,
    SourceLabel,
    VehicleState,
)
from terrafix_lab.sim.interfaces import GnssFix, State
from terrafix_lab.sim.sensors.gnss import DELAY_S, Gnss
from terrafix_lab.sim.sensors.gnss_events import AnyEvent
from terrafix_lab.sim.true_messages import estimate
from terrafix_lab.sim.vehicle.level import level_state
from terrafix_tools.in_process import InProcessShell

STEP_S = 0.2  # period of receiver readings, attitude and the link's tick
ESTIMATES_S = 0.4
ESTIMATE_DELAY_S = 0.3
NS_PER_S = 1_000_000_000
FRAME = LocalFrame(48.0, 11.0)
ALT_M = 620.0


@dataclass(frozen=True)
class Vision:
    """Quality of the estimate: 1-sigma per axis, and the composition of its error."""

    sigma_m: float
    constant_share: float = 0.5  # of the variance: constant error of the map over the flight
    wander_s: float = 20.0  # correlation time of the rest
    velocity_sigma_mps: float = 0.7
    gap: tuple[float, float] = (0.0, 0.0)  # (from, to) in s, without map matches and odometry
    gap_mps: float = 0.5  # 1-sigma per axis of the drift in the gap


@dataclass
class DetectorResult:
    """The detector's states with their times in s."""

    states: list[tuple[float, GnssState]] = field(default_factory=list)
    lost_fix_s: float | None = None  # time at which the receiver's own fix was lost

    def first(self, after_s: float, *wanted: GnssState) -> float | None:
        return next((t for t, state in self.states if t >= after_s and state in wanted), None)


def fly(duration_s: float, vision: Vision, events: tuple[AnyEvent, ...], seed: int) -> DetectorResult:
    """Simulates one flight."""
    rng = random.Random(f"{seed} judge")
    gnss = Gnss(FRAME, seed=seed, events=events)
    node, outputs = LinkNode(10.0, map_offsets=MapOffsetEstimator()), list[Message]()
    shell = InProcessShell({"link": node}, lambda _, message: outputs.append(message))
    course = _course(rng.uniform(12.0, 28.0), rng.uniform(-math.pi, math.pi), rng)
    estimator, result = _Estimator(vision, rng), DetectorResult()
    pending: list[tuple[float, NavEstimate]] = []
    previous_state: GnssState | None = None
    event_start_s = min((event.start_s for event in events), default=math.inf)
    for step, state in enumerate(islice(course, round(duration_s / STEP_S))):
        t_s = state.t_s
        fix = gnss.read(state)  # 0.2 s old, by the step; the detector assumes an age of 0.15 s
        if fix is not None and fix.fix_type < 3 and result.lost_fix_s is None and t_s >= event_start_s:
            result.lost_fix_s = t_s - DELAY_S
        if step % round(ESTIMATES_S / STEP_S) == 0:
            pending.append((t_s + ESTIMATE_DELAY_S, estimator.estimate(state)))
        outputs.clear()
        while pending and pending[0][0] <= t_s:
            shell.feed(pending.pop(0)[1])
        now_ns = round(t_s * NS_PER_S)
        shell.feed_read("link", _attitude(state, now_ns))
        if fix is not None:
            shell.feed_read("link", _reading(fix, now_ns))
        shell.tick(now_ns)
        for message in outputs:
            if isinstance(message, GnssVerdict) and message.state is not previous_state:
                previous_state = message.state
                result.states.append((t_s, message.state))
    return result


def _course(speed_mps: float, yaw_rad: float, rng: random.Random) -> Iterator[State]:
    """Straight legs and turns at constant speed, a state every STEP_S."""
    p_m, rate_radps, until_s = np.array([0.0, 0.0, ALT_M]), 0.0, 0.0
    for step in count():
        t_s = step * STEP_S
        if t_s >= until_s:
            turning = rate_radps == 0.0 and t_s > 0
            rate_radps = rng.choice((-1, 1)) * rng.uniform(0.05, 0.25) if turning else 0.0
            until_s = t_s + (rng.uniform(4.0, 14.0) if turning else rng.uniform(20.0, 120.0))
        state = level_state(t_s, p_m, speed_mps, yaw_rad, rate_radps)
        yield state
        p_m = p_m + state.velocity_enu_mps * STEP_S
        yaw_rad = math.remainder(yaw_rad + rate_radps * STEP_S, math.tau)


class _Estimator:
    def __init__(self, vision: Vision, rng: random.Random) -> None:
        self._vision, self._gauss = vision, rng.gauss
        constant_sigma = vision.sigma_m * math.sqrt(vision.constant_share)
        self._constant = np.array([self._gauss(0.0, constant_sigma), self._gauss(0.0, constant_sigma)])
        self._wander_sigma = vision.sigma_m * math.sqrt(1.0 - vision.constant_share)
        self._wander = np.array([self._gauss(0.0, self._wander_sigma) for _ in range(2)])
        self._velocity = np.zeros(2)
        self._drift_mps = np.array([self._gauss(0.0, vision.gap_mps) for _ in range(2)])

    def estimate(self, state: State) -> NavEstimate:
        self._wander = self._walk(self._wander, self._wander_sigma, self._vision.wander_s)
        self._velocity = self._walk(self._velocity, self._vision.velocity_sigma_mps, 2.0)
        from_s, to_s = self._vision.gap
        gap_s = state.t_s - from_s if from_s <= state.t_s < to_s else 0.0
        e, n = state.p_b_in_w_m[:2] + self._constant + self._wander + self._drift_mps * gap_s
        lat, lon = FRAME.to_wgs84(float(e), float(n))
        t_ns = round(state.t_s * NS_PER_S)
        ve, vn = state.velocity_enu_mps[:2] + self._velocity
        sigma_m = math.hypot(self._vision.sigma_m, self._vision.gap_mps * gap_s)
        return estimate(
            t_ns,
            lat,
            lon,
            sigmas=(sigma_m, 3.0, 0.0),
            velocity_enu_mps=(float(ve), float(vn), 0.0),
            velocity_sigma_mps=self._vision.velocity_sigma_mps,
            map_sigma_m=self._vision.sigma_m * math.sqrt(self._vision.constant_share),
            source_label=SourceLabel.DEAD_RECKONED if gap_s else SourceLabel.SATELLITE_ANCHORED,
            last_anchor_age_ms=round(gap_s * 1000),
            emitted_at_ns=t_ns + round(ESTIMATE_DELAY_S * NS_PER_S),
        )

    def _walk(self, value: np.ndarray, sigma: float, time_s: float) -> np.ndarray:
        """Advances a Gauss-Markov process by one estimate interval."""
        keep = math.exp(-ESTIMATES_S / time_s)
        kick = sigma * math.sqrt(1.0 - keep * keep)
        return keep * value + np.array([self._gauss(0.0, kick), self._gauss(0.0, kick)])


def _attitude(state: State, now_ns: int) -> VehicleState:
    return VehicleState(t_ns=now_ns, source="mavlink", yaw_rad=state.yaw_rad, pitch_rad=0.0, roll_rad=state.roll_rad)


def _reading(fix: GnssFix, now_ns: int) -> GnssReading:
    good = fix.fix_type >= 3
    return GnssReading(
        t_ns=now_ns,
        receiver=0,
        fix_type=fix.fix_type,
        lat_deg=fix.lat_deg if good else None,
        lon_deg=fix.lon_deg if good else None,
        horizontal_m=fix.horizontal_m if good else None,
        speed_mps=math.hypot(*fix.velocity_ned_mps[:2]) if good else None,
        satellites=fix.satellites,
    )
