"""An estimator that is started in a flight: from where the one before it left off, or from the flight's start."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from terrafix.core.geodesy import LocalFrame
from terrafix.core.rundir import write_whole
from terrafix.core.start import SEARCHED_START_M
from terrafix.estimator.pace import TYPICAL_SPEED_MPS
from terrafix.estimator.velocity import MAX_SPEED_SIGMA_MPS, leg
from terrafix.messages import Message, NavEstimate, Origin

KEPT_EVERY_NS = 200_000_000


@dataclass(frozen=True)
class Known:
    """A position that is known: time, east and north with their 1-sigma, velocity with its 1-sigma (each axis)."""

    t_s: float
    at_m: np.ndarray
    sigma_m: float
    velocity_mps: np.ndarray
    velocity_sigma_mps: float

    @classmethod
    def start(cls, origin: Origin, t_s: float) -> "Known":
        """The start coordinate, of a vehicle of whose motion nothing is known."""
        sigma_m = min(max(origin.start_sigma_m, 1.0), SEARCHED_START_M)
        return cls(t_s, np.zeros(2), sigma_m, np.zeros(2), float(MAX_SPEED_SIGMA_MPS[0]))

    @classmethod
    def of(cls, said: NavEstimate, frame: LocalFrame) -> "Known":
        at_m = np.array(frame.to_local(said.lat_deg, said.lon_deg))
        sigma_m = float(np.sqrt(max(said.cov[0], said.cov[7])))
        return cls(said.t_ns * 1e-9, at_m, sigma_m, np.array(said.velocity_enu_mps[:2]), said.velocity_sigma_mps)

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

    def poll(self, now_ns: int) -> Iterable[Message]:
        return ()

    def heard(self, message: Message) -> None:
        if isinstance(message, NavEstimate) and message.t_ns - self._kept_ns >= KEPT_EVERY_NS:
            self._kept_ns = message.t_ns
            write_whole(self._file, msgspec.msgpack.encode(message))

    def close(self) -> None:
        pass


def kept(file: Path) -> NavEstimate | None:
    """What a ``Keeper`` kept there."""
    return msgspec.msgpack.decode(file.read_bytes(), type=NavEstimate) if file.is_file() else None
