"""Where an estimator starts from: the start coordinate, an InitialPosition, or the checkpoint of the process before."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from terrafix.core.geodesy import LocalFrame, rot_from_quat, yaw_of
from terrafix.core.initial_position import SEARCH_START_SIGMA_M
from terrafix.estimator.measurements.principal_point import graph_shift
from terrafix.estimator.models.motion_model import MAX_SPEED_SIGMA_MPS, MIN_MODEL_SPEED_MPS, integrate_motion
from terrafix.estimator.models.speed_prior import TYPICAL_SPEED_MPS
from terrafix.estimator.state import CALIBRATION_SIZE, HEADING
from terrafix.messages import (
    CalibrationEstimate,
    Camera,
    CameraVehicle,
    GroundPlane,
    InitialPosition,
    LensEstimate,
    MapMatch,
    Message,
    NavEstimate,
    Origin,
    Vec2,
)
from terrafix.runtime.checkpoint import CheckpointFile

CHECKPOINT_EVERY_NS = 200_000_000  # [tuned]
# Between calibration and estimate of a checkpoint: under thermal throttle there is an older one, to which the heading
# and height of the estimate do not belong.
MAX_CALIBRATION_AGE_NS = 5_000_000_000  # [tuned]
MIN_COURSE_COSINE = 0.8  # between course and heading: wind drifts a plane by 30 degrees at most [tuned]
TURN_MPS2 = 8.0  # across the course: a bank of 40 degrees [tuned]
TURN_STARTS = (np.arange(8) + 0.5) / 8  # of a turn, in shares of the time before its latest start [tuned]


class CheckpointGround(msgspec.Struct, frozen=True):
    """Ground plane of a map match, and the place of the match: ``at_m``, east and north."""

    plane: GroundPlane
    at_m: Vec2


class EstimatorCheckpoint(msgspec.Struct, frozen=True):
    """Last messages of an estimator. ``calibration``: None: there was none yet. ``ground``: of the newest map match
    that has one; None: the map has no DEM."""

    estimate: NavEstimate
    calibration: CalibrationEstimate | None = None
    ground: CheckpointGround | None = None
    initial_position: InitialPosition | None = None
    camera_vehicle: CameraVehicle | None = None


@dataclass(frozen=True)
class CalibrationPrior:
    """Calibration state B (6,) with covariance (6, 6), at ``t_s``."""

    t_s: float
    error: np.ndarray
    cov: np.ndarray


@dataclass(frozen=True)
class NavPrior:
    """Position ``at_m`` (2,), east and north, at ``t_s`` with ``sigma_m``; ``velocity_mps`` (2,) with its 1-sigma (each
    axis); ``yaw_rad``: heading of the vehicle, None: unknown. ``learnt``, ``ground``, ``lens``: calibration, ground and
    lens of a checkpoint. ``placed``: a place stands behind the position; False: it is the centre of an area."""

    t_s: float
    at_m: np.ndarray
    sigma_m: float
    velocity_mps: np.ndarray
    velocity_sigma_mps: float
    yaw_rad: float | None = None
    learnt: CalibrationPrior | None = None
    ground: CheckpointGround | None = None
    lens: LensEstimate | None = None
    placed: bool = True

    @classmethod
    def start(cls, origin: Origin, t_s: float) -> "NavPrior":
        """Prior at the start coordinate at ``t_s``, with unknown velocity."""
        sigma_m = min(max(origin.start_sigma_m, 1.0), SEARCH_START_SIGMA_M)
        placed = origin.start_sigma_m <= SEARCH_START_SIGMA_M
        return cls(t_s, np.zeros(2), sigma_m, np.zeros(2), float(MAX_SPEED_SIGMA_MPS[0]), placed=placed)

    @classmethod
    def at_initial_position(cls, initial: InitialPosition, frame: LocalFrame, t_s: float) -> "NavPrior | None":
        """Prior at the position of ``initial`` at ``t_s``, with unknown velocity; None when ``initial`` has no
        position."""
        if initial.lat_deg is None or initial.lon_deg is None or initial.sigma_m is None:
            return None
        at_m = np.array(frame.to_local(initial.lat_deg, initial.lon_deg))
        placed = initial.sigma_m <= SEARCH_START_SIGMA_M
        return cls(t_s, at_m, initial.sigma_m, np.zeros(2), float(MAX_SPEED_SIGMA_MPS[0]), placed=placed)

    @classmethod
    def of(cls, checkpoint: EstimatorCheckpoint, frame: LocalFrame, camera: Camera) -> "NavPrior":
        """Prior at the last estimate of ``checkpoint``, with its calibration where it is of the same ``camera``."""
        estimate, calibration = checkpoint.estimate, checkpoint.calibration
        at_m = np.array(frame.to_local(estimate.lat_deg, estimate.lon_deg))
        sigma_m = float(np.sqrt(max(estimate.cov[0], estimate.cov[7])))
        t_s, velocity_mps = estimate.t_ns * 1e-9, np.array(estimate.velocity_enu_mps[:2])
        learnt, yaw_rad = None, yaw_of(rot_from_quat(estimate.q_w_b))
        lens = None if calibration is None else calibration.lens
        if lens is not None:
            at_m -= graph_shift(estimate, camera, lens)
        if calibration is not None and estimate.t_ns - calibration.t_ns <= MAX_CALIBRATION_AGE_NS:
            cov = np.array(calibration.cov).reshape(CALIBRATION_SIZE, CALIBRATION_SIZE)
            learnt = CalibrationPrior(calibration.t_ns * 1e-9, np.array(calibration.state), cov)
        return cls(
            t_s,
            at_m,
            sigma_m,
            velocity_mps,
            estimate.velocity_sigma_mps,
            yaw_rad,
            learnt,
            checkpoint.ground,
            lens,
            estimate.is_placed,
        )

    def path_until(self, t_s: float, yaw_rad: float | None) -> tuple[np.ndarray, float]:
        """-> path (2,) until ``t_s`` without any odometry, and its 1-sigma on each axis. ``yaw_rad``: reported heading
        at ``t_s``. The change of heading is one turn that may have begun at any moment: mean and spread of the paths
        that this gives."""
        dt_s = t_s - self.t_s
        if dt_s <= 0.0:
            return np.zeros(2), 0.0
        speed_mps = max(float(np.hypot(*self.velocity_mps)), TYPICAL_SPEED_MPS)
        way = integrate_motion(dt_s, None, (0.0, 0.0), 0.0, speed_mps, 0.0, same_source=False)
        turned_rad = self._turned(yaw_rad)
        # With a known heading the course does not decorrelate.
        reach_s = way.phi_pv_s if turned_rad is None else dt_s
        ends_m = _paths(complex(*self.velocity_mps), turned_rad or 0.0, dt_s) * (reach_s / dt_s)
        apart_m = float(np.sqrt(np.linalg.eigvalsh(np.cov(ends_m.real, ends_m.imag))[-1].clip(0.0)))
        sigma_m = np.linalg.norm([reach_s * self.velocity_sigma_mps, np.sqrt(way.cov[0, 0]), apart_m])
        return np.array([ends_m.real.mean(), ends_m.imag.mean()]), float(sigma_m)

    def _turned(self, yaw_rad: float | None) -> float | None:
        """Turn of the course since ``t_s``, counter-clockwise [rad]. None: unknown, or course and heading differ."""
        east, north = self.velocity_mps
        if yaw_rad is None or self.yaw_rad is None or np.hypot(east, north) < MIN_MODEL_SPEED_MPS:
            return None
        if np.cos(np.arctan2(east, north) - self.yaw_rad) < MIN_COURSE_COSINE:
            return None
        bias_rad = 0.0 if self.learnt is None else float(self.learnt.error[HEADING])
        return math.remainder(self.yaw_rad - yaw_rad + bias_rad, math.tau)


def _paths(velocity_mps: complex, turned_rad: float, dt_s: float) -> np.ndarray:
    """(N,) east + j north [m]: paths of ``dt_s`` with a turn by ``turned_rad`` at N starting times."""
    turning_s = min(dt_s, abs(turned_rad * velocity_mps) / TURN_MPS2)
    before_s = (dt_s - turning_s) * TURN_STARTS
    turn = np.exp(1j * turned_rad)
    arc_s = (turn - 1.0) / (1j * turned_rad) * turning_s if turned_rad else 0.0
    return np.asarray(velocity_mps * (before_s + arc_s + (dt_s - turning_s - before_s) * turn))


class CheckpointWriter:
    """Edge that writes the newest estimate to memory that outlives this process."""

    def __init__(self, file: Path) -> None:
        self._checkpoint = CheckpointFile(file, EstimatorCheckpoint)
        self._written_ns = -CHECKPOINT_EVERY_NS
        self._calibration: CalibrationEstimate | None = None
        self._ground: CheckpointGround | None = None
        last = self._checkpoint.load()
        self._initial = None if last is None else last.initial_position  # published once, before take-off
        self._camera_vehicle = None if last is None else last.camera_vehicle  # published once as well

    def poll(self, now_ns: int) -> Iterable[Message]:
        return ()

    def on_message(self, message: Message) -> None:
        if isinstance(message, CalibrationEstimate):
            self._calibration = message
        elif isinstance(message, InitialPosition):
            self._initial = message
        elif isinstance(message, CameraVehicle):
            self._camera_vehicle = message
        elif isinstance(message, MapMatch):
            self._ground = ground_of(message) or self._ground
        elif isinstance(message, NavEstimate) and message.t_ns - self._written_ns >= CHECKPOINT_EVERY_NS:
            self._written_ns = message.t_ns
            last = message, self._calibration, self._ground, self._initial, self._camera_vehicle
            self._checkpoint.save(EstimatorCheckpoint(*last))

    def close(self) -> None:
        pass


def ground_of(match: MapMatch) -> CheckpointGround | None:
    """What a checkpoint keeps of a match; None: no ground, or no place to which it belongs."""
    if match.ground is None or match.place is None:
        return None
    return CheckpointGround(match.ground, (match.place.e_m, match.place.n_m))


def load_checkpoint(file: Path | None) -> EstimatorCheckpoint | None:
    """What a ``CheckpointWriter`` has written; None: nothing, or a damaged file."""
    return CheckpointFile(file, EstimatorCheckpoint).load()
