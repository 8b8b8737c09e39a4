"""An estimator that is started in a flight: from where the one before it left off, or from the flight's start."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from terrafix.core.geodesy import LocalFrame, rot_from_quat, yaw_of
from terrafix.core.rundir import write_whole
from terrafix.core.start import SEARCHED_START_M
from terrafix.estimator.factors import BIAS_SIZE
from terrafix.estimator.pace import TYPICAL_SPEED_MPS
from terrafix.estimator.velocity import MAX_SPEED_SIGMA_MPS, leg
from terrafix.messages import MapMatch, Message, NavEstimate, Origin, SlowErrors

KEPT_EVERY_NS = 200_000_000
SLOW_AGE_NS = 5_000_000_000  # learnt longer before the estimate (the computer was hot): heading and height were others


class Last(msgspec.Struct, frozen=True):
    """What an estimator said last. ``slow`` None: it had learnt nothing yet. ``match``: the last one that told the
    ground, without its points; None: no map tells it."""

    estimate: NavEstimate
    slow: SlowErrors | None = None
    match: MapMatch | None = None


@dataclass(frozen=True)
class Learnt:
    """Slow errors (6,) with their covariance (6x6), and where they were learnt: time, heading."""

    t_s: float
    error: np.ndarray
    cov: np.ndarray
    yaw_rad: float


@dataclass(frozen=True)
class Known:
    """A position that is known: time, east and north with their 1-sigma, velocity with its 1-sigma (each axis), and
    what was learnt of the slow errors and of the ground."""

    t_s: float
    at_m: np.ndarray
    sigma_m: float
    velocity_mps: np.ndarray
    velocity_sigma_mps: float
    learnt: Learnt | None = None
    match: MapMatch | None = None

    @classmethod
    def start(cls, origin: Origin, t_s: float) -> "Known":
        """The start coordinate, of a vehicle of whose motion nothing is known."""
        sigma_m = min(max(origin.start_sigma_m, 1.0), SEARCHED_START_M)
        return cls(t_s, np.zeros(2), sigma_m, np.zeros(2), float(MAX_SPEED_SIGMA_MPS[0]))

    @classmethod
    def of(cls, last: Last, frame: LocalFrame) -> "Known":
        said, slow = last.estimate, last.slow
        at_m = np.array(frame.to_local(said.lat_deg, said.lon_deg))
        sigma_m = float(np.sqrt(max(said.cov[0], said.cov[7])))
        t_s, velocity_mps = said.t_ns * 1e-9, np.array(said.velocity_enu_mps[:2])
        learnt = None
        if slow is not None and said.t_ns - slow.t_ns <= SLOW_AGE_NS:
            yaw_rad = yaw_of(rot_from_quat(said.q_w_b))
            cov = np.array(slow.cov).reshape(BIAS_SIZE, BIAS_SIZE)
            learnt = Learnt(slow.t_ns * 1e-9, np.array(slow.error), cov, yaw_rad)
        return cls(t_s, at_m, sigma_m, velocity_mps, said.velocity_sigma_mps, learnt, last.match)

    def later(self, t_s: float) -> tuple[np.ndarray, float]:
        """-> way (2,) since then, and the 1-sigma of each axis of it: nobody looked."""
        if t_s <= self.t_s:
            return np.zeros(2), 0.0
        speed_mps = max(float(np.hypot(*self.velocity_mps)), TYPICAL_SPEED_MPS)
        way = leg(t_s - self.t_s, None, (0.0, 0.0), 0.0, speed_mps, 0.0, same_kind=False)
        sigma_m = np.hypot(way.reach_s * self.velocity_sigma_mps, np.sqrt(way.cov[0, 0]))
        return way.reach_s * self.velocity_mps, float(sigma_m)


class Keeper:
    """An Edge: keeps the newest estimate in memory that outlives this process."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._kept_ns = -KEPT_EVERY_NS
        self._slow: SlowErrors | None = None
        self._match: MapMatch | None = None

    def poll(self, now_ns: int) -> Iterable[Message]:
        return ()

    def heard(self, message: Message) -> None:
        if isinstance(message, SlowErrors):
            self._slow = message
        elif isinstance(message, MapMatch) and message.ground is not None and message.mode_mass > 0.0:
            self._match = msgspec.structs.replace(message, matches=[])
        elif isinstance(message, NavEstimate) and message.t_ns - self._kept_ns >= KEPT_EVERY_NS:
            self._kept_ns = message.t_ns
            write_whole(self._file, msgspec.msgpack.encode(Last(message, self._slow, self._match)))

    def close(self) -> None:
        pass


def kept(file: Path) -> Last | None:
    """What a ``Keeper`` kept there."""
    return msgspec.msgpack.decode(file.read_bytes(), type=Last) if file.is_file() else None
