"""A simulated plane whose computer has too much to do: frames that vision drops, messages that are lost or late."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from inertial_flight import ORIGIN, InertialFlight
from simulated_flight import CAMERA, PLACE, EstimatorRun
from terrafix.core.limits import MAX_KEYFRAME_AGE, MAX_SENT_VELOCITY_SIGMA_MPS
from terrafix.messages import MapMatch, MeasurementVerdict, Message, NavEstimate, Odometry, Verdict
from terrafix.vision.feature_tracker import KEYFRAME_SHIFT
from terrafix_lab.sim.flights.path import STEP_S
from terrafix_lab.sim.true_messages import first_odometry

FRAME_EVERY = 10  # steps: 5 frames a second
FRAME_S = 0.2
Frames = Callable[[int], bool]  # which frames


def none(_frame: int) -> bool:
    return False


@dataclass(frozen=True)
class Load:
    """``lost``: frames whose Odometry does not arrive. ``overtaken``: frames that vision drops (`bad_image`).
    ``telemetry_late``: frames by which the telemetry before a frame is late. A map match is tried ``match_every_s``,
    and arrives ``match_late_s`` after its frame."""

    lost: Frames = none
    overtaken: Frames = none
    telemetry_late: Callable[[int], int] = lambda _: 0
    match_every_s: float = 1.0
    match_late_s: float = 0.4


class LateStamps(InertialFlight):
    """From ``begin_s`` to ``end_s`` images are stamped ``late_s`` after their exposure, a function of the time since
    ``begin_s``, as those of a camera that are stamped on arrival; then at their exposure again. Errors are those of the
    place where the image was exposed."""

    def __init__(self, seed: int, seconds: int, late_s: Callable[[float], float], begin_s: float, end_s: float) -> None:
        super().__init__(seed, seconds, FRAME_EVERY)
        exposed = InertialFlight(seed, seconds, 1).poses
        for i in range(len(self.poses)):
            stamp_s = i * FRAME_S
            by_s = late_s(stamp_s - begin_s) if begin_s <= stamp_s < end_s else 0.0
            self.poses[i] = exposed[round((stamp_s - by_s) / STEP_S)]


@dataclass
class OverloadedResult:
    """``estimates``: with the error of each, (2,) east and north. ``maps``: verdicts on map matches."""

    estimates: list[tuple[NavEstimate, np.ndarray]] = field(default_factory=list)
    verdicts: list[MeasurementVerdict] = field(default_factory=list)

    def claimed(self, after_s: float = 0.0) -> list[tuple[NavEstimate, np.ndarray]]:
        """Those that the link would send as a 3D fix."""
        return [
            (estimate, error_m)
            for estimate, error_m in self.estimates
            if estimate.velocity_sigma_mps < MAX_SENT_VELOCITY_SIGMA_MPS and estimate.t_ns * 1e-9 > after_s
        ]

    def worst(self, after_s: float = 0.0) -> float:
        """Largest error of a claimed position over its 1-sigma along the worst axis."""
        return max((float(np.hypot(*e)) / sigma_m(estimate) for estimate, e in self.claimed(after_s)), default=0.0)

    def maps(self, after_s: float = 0.0) -> list[Verdict]:
        return [v.verdict for v in self.verdicts if v.measurement == "map" and v.t_ns * 1e-9 > after_s]

    def resets(self, after_s: float = 0.0) -> list[MeasurementVerdict]:
        return [v for v in self.verdicts if v.measurement == "reset" and v.t_ns * 1e-9 > after_s]


def fly(flight: InertialFlight, load: Load, seed: int = 0, end_s: float = math.inf) -> OverloadedResult:
    """The flight (5 frames a second) through an EstimatorNode. Vision registers each frame that it gets to its
    keyframe, as `FrameTracker` does, whatever then becomes of the message."""
    run, flown = EstimatorRun(), OverloadedResult()
    for reply in run.feed([ORIGIN, *_messages(flight, load, np.random.default_rng([seed, 54]), end_s)]):
        if isinstance(reply, NavEstimate):
            at_m = np.array(PLACE.to_local(reply.lat_deg, reply.lon_deg))
            flown.estimates.append((reply, at_m - flight.poses[reply.frame_id][1][:2]))
        elif isinstance(reply, MeasurementVerdict):
            flown.verdicts.append(reply)
    return flown


def _messages(flight: InertialFlight, load: Load, rng: np.random.Generator, end_s: float) -> Iterator[Message]:
    keyframe, age, matched = 0, 0, -math.inf
    late: list[tuple[int, Message]] = []
    matches: list[tuple[int, MapMatch]] = []
    for i in range(min(len(flight.poses), round(min(end_s, 1e6) / FRAME_S))):
        t_ns = round(i * FRAME_S * 1e9)
        telemetry = [m for m in flight.messages_by_frame[i] if not isinstance(m, Odometry | MapMatch)]
        late += [(i + load.telemetry_late(i), message) for message in telemetry]
        yield from (message for due, message in late if due <= i)
        late = [(due, message) for due, message in late if due > i]
        if i and load.overtaken(i):
            odometry = Odometry(t_ns=t_ns, frame_id=i, keyframe_id=i, verdict=Verdict.BAD_IMAGE)
        else:
            age += 1
            due = i == 0 or age >= MAX_KEYFRAME_AGE or _shift(flight, keyframe, i) > KEYFRAME_SHIFT
            odometry = flight.registered(i, keyframe, t_ns, rng, becomes_keyframe=due) if i else first_odometry(t_ns)
            keyframe, age = (i, 0) if due else (keyframe, age)
        if not load.lost(i):
            yield odometry
            if odometry.verdict is Verdict.ACCEPTED and i and (i - matched) * FRAME_S >= load.match_every_s:
                matched = i
                matches.append((i + round(load.match_late_s / FRAME_S), flight.fix(i, t_ns, rng)))
        yield from (match for due_at, match in matches if due_at <= i)
        matches = [(due_at, match) for due_at, match in matches if due_at > i]


def _shift(flight: InertialFlight, a: int, b: int) -> float:
    """Displacement of the image between two frames, image widths."""
    moved_m = flight.poses[b][1] - flight.poses[a][1]
    return float(np.hypot(*moved_m[:2])) / float(flight.poses[b][1][2]) * CAMERA.fx / CAMERA.width


def sigma_m(estimate: NavEstimate) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(np.array(estimate.cov).reshape(6, 6)[:2, :2])[-1]))
