"""An estimator that is started in a flight: from where the one before it left off, or from the flight's start."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from terrafix.core.geodesy import LocalFrame, rot_from_quat, yaw_of
from terrafix.core.initial_position import SEARCHED_START_M
from terrafix.estimator.factors.custom_factors import BIAS_SIZE
from terrafix.estimator.measurements.principal_point import graph_aside
from terrafix.estimator.models.motion_model import LEAST_SPEED_MPS, MAX_SPEED_SIGMA_MPS, integrate_motion
from terrafix.estimator.models.speed_prior import TYPICAL_SPEED_MPS
from terrafix.messages import Camera, LearntLens, MapMatch, Message, NavEstimate, Origin, SlowErrors, Start
from terrafix.runtime.run_dir import load, save

KEPT_EVERY_NS = 200_000_000
SLOW_AGE_NS = 5_000_000_000  # learnt longer before the estimate (the computer was hot): heading and height were others
FLIES_AHEAD = 0.8  # cosine between course and heading: the wind sets a plane off by 30 degrees at most
TURN_MPS2 = 8.0  # across the course: a bank of 40 degrees
BEGINS = (np.arange(8) + 0.5) / 8  # of a turn, in shares of the time that it leaves


class EstimatorCheckpoint(msgspec.Struct, frozen=True):
    """What an estimator said last. ``slow`` None: it had learnt nothing yet. ``match``: the last one that told the
    ground, without its points; None: no map tells it. ``start``: where it began, if its Origin did not say so."""

    estimate: NavEstimate
    slow: SlowErrors | None = None
    match: MapMatch | None = None
    start: Start | None = None


@dataclass(frozen=True)
class CalibrationPrior:
    """Slow errors (6,) with their covariance (6x6), and when they were learnt."""

    t_s: float
    error: np.ndarray
    cov: np.ndarray


@dataclass(frozen=True)
class NavPrior:
    """A position that is known: time, east and north with their 1-sigma, velocity with its 1-sigma (each axis), heading
    of the vehicle (None: unknown), and what was learnt of the slow errors, of the ground and of the lens."""

    t_s: float
    at_m: np.ndarray
    sigma_m: float
    velocity_mps: np.ndarray
    velocity_sigma_mps: float
    yaw_rad: float | None = None
    learnt: CalibrationPrior | None = None
    match: MapMatch | None = None
    lens: LearntLens | None = None

    @classmethod
    def start(cls, origin: Origin, t_s: float) -> "NavPrior":
        """The start coordinate, of a vehicle of whose motion nothing is known."""
        sigma_m = min(max(origin.start_sigma_m, 1.0), SEARCHED_START_M)
        return cls(t_s, np.zeros(2), sigma_m, np.zeros(2), float(MAX_SPEED_SIGMA_MPS[0]))

    @classmethod
    def told(cls, start: Start, frame: LocalFrame, t_s: float) -> "NavPrior | None":
        """The place where the vehicle was at ``t_s``, by a Start; None when that says none."""
        if start.lat_deg is None or start.lon_deg is None or start.sigma_m is None:
            return None
        at_m = np.array(frame.to_local(start.lat_deg, start.lon_deg))
        return cls(t_s, at_m, start.sigma_m, np.zeros(2), float(MAX_SPEED_SIGMA_MPS[0]))

    @classmethod
    def of(cls, last: EstimatorCheckpoint, frame: LocalFrame, camera: Camera) -> "NavPrior":
        said, slow = last.estimate, last.slow
        at_m = np.array(frame.to_local(said.lat_deg, said.lon_deg))
        sigma_m = float(np.sqrt(max(said.cov[0], said.cov[7])))
        t_s, velocity_mps = said.t_ns * 1e-9, np.array(said.velocity_enu_mps[:2])
        learnt, yaw_rad = None, yaw_of(rot_from_quat(said.q_w_b))
        lens = None if slow is None else slow.lens
        if lens is not None:
            at_m -= graph_aside(said, camera, lens)
        if slow is not None and said.t_ns - slow.t_ns <= SLOW_AGE_NS:
            cov = np.array(slow.cov).reshape(BIAS_SIZE, BIAS_SIZE)
            learnt = CalibrationPrior(slow.t_ns * 1e-9, np.array(slow.error), cov)
        return cls(t_s, at_m, sigma_m, velocity_mps, said.velocity_sigma_mps, yaw_rad, learnt, last.match, lens)

    def later(self, t_s: float, yaw_rad: float | None) -> tuple[np.ndarray, float]:
        """-> way (2,) since then, and the 1-sigma of each axis of it: nobody looked. ``yaw_rad``: where it heads now,
        as the autopilot says. By as much as that is another heading it has turned, at any moment: the mean of the ways
        that this gives, and how far their ends are apart."""
        dt_s = t_s - self.t_s
        if dt_s <= 0.0:
            return np.zeros(2), 0.0
        speed_mps = max(float(np.hypot(*self.velocity_mps)), TYPICAL_SPEED_MPS)
        way = integrate_motion(dt_s, None, (0.0, 0.0), 0.0, speed_mps, 0.0, same_kind=False)
        turned_rad = self._turned(yaw_rad)
        # A heading that is known is a course that is not forgotten.
        reach_s = way.reach_s if turned_rad is None else dt_s
        ends_m = _ways(complex(*self.velocity_mps), turned_rad or 0.0, dt_s) * (reach_s / dt_s)
        apart_m = float(np.sqrt(np.linalg.eigvalsh(np.cov(ends_m.real, ends_m.imag))[-1].clip(0.0)))
        sigma_m = np.linalg.norm([reach_s * self.velocity_sigma_mps, np.sqrt(way.cov[0, 0]), apart_m])
        return np.array([ends_m.real.mean(), ends_m.imag.mean()]), float(sigma_m)

    def _turned(self, yaw_rad: float | None) -> float | None:
        """Of the course, towards north from east [rad]. None: unknown, or it does not fly where it heads."""
        east, north = self.velocity_mps
        if yaw_rad is None or self.yaw_rad is None or np.hypot(east, north) < LEAST_SPEED_MPS:
            return None
        if np.cos(np.arctan2(east, north) - self.yaw_rad) < FLIES_AHEAD:
            return None
        bias_rad = 0.0 if self.learnt is None else float(self.learnt.error[2])
        return math.remainder(self.yaw_rad - yaw_rad + bias_rad, math.tau)


def _ways(velocity_mps: complex, turned_rad: float, dt_s: float) -> np.ndarray:
    """(N,) east + j north, flown in ``dt_s`` with a turn that begins at any moment."""
    turning_s = min(dt_s, abs(turned_rad * velocity_mps) / TURN_MPS2)
    before_s = (dt_s - turning_s) * BEGINS
    turn = np.exp(1j * turned_rad)
    arc_s = (turn - 1.0) / (1j * turned_rad) * turning_s if turned_rad else 0.0
    return np.asarray(velocity_mps * (before_s + arc_s + (dt_s - turning_s - before_s) * turn))


class CheckpointWriter:
    """An Edge: keeps the newest estimate in memory that outlives this process."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._kept_ns = -KEPT_EVERY_NS
        self._slow: SlowErrors | None = None
        self._match: MapMatch | None = None
        last = load_checkpoint(file)
        self._start = None if last is None else last.start  # said once, before take-off

    def poll(self, now_ns: int) -> Iterable[Message]:
        return ()

    def heard(self, message: Message) -> None:
        if isinstance(message, SlowErrors):
            self._slow = message
        elif isinstance(message, Start):
            self._start = message
        elif isinstance(message, MapMatch) and message.ground is not None and message.mode_mass > 0.0:
            self._match = msgspec.structs.replace(message, matches=[])
        elif isinstance(message, NavEstimate) and message.t_ns - self._kept_ns >= KEPT_EVERY_NS:
            self._kept_ns = message.t_ns
            save(self._file, msgspec.msgpack.encode(EstimatorCheckpoint(message, self._slow, self._match, self._start)))

    def close(self) -> None:
        pass


def load_checkpoint(file: Path | None) -> EstimatorCheckpoint | None:
    """What a ``CheckpointWriter`` kept there."""
    return load(file, msgspec.msgpack.Decoder(EstimatorCheckpoint).decode)
