"""Initial position from GNSS: where a receiver has the vehicle on the ground, when no start coordinate is configured.

A receiver is used on the ground only, before the vehicle is armed for the first time: while it has a 3D fix, claims
10 m or better, has been stationary for five seconds, and nothing contradicts it. When the vehicle is carried to another
place, the initial position follows. A receiver that jumps faster than a vehicle can be moved, or that another receiver
contradicts, is jammed, spoofed or broken. No measurement on the ground can decide between the two positions, so no
receiver is used from then on."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

from terrafix.link.gnss.spoofing_detector import (
    DEFAULT_RECEIVER_SIGMA_M,
    GNSS_JUMP_SIGMAS,
    MIN_RECEIVER_SIGMA_M,
    READING_TIMEOUT_NS,
)
from terrafix.link.ground_station.prior_request import UNKNOWN_POSITION_SIGMA_M
from terrafix.link.integrity.output_predictor import distance_m
from terrafix.link.pilot_text.statustext import INFO, WARNING, statustext
from terrafix.messages import (
    FIX_3D,
    GnssInitialPosition,
    GnssReading,
    InitialPosition,
    Message,
    Origin,
    StatusText,
    Verdict,
)

MAX_CLAIMED_SIGMA_M = 10.0  # m, 1-sigma; twice what ArduPilot requires before a copter is armed [tuned]
STATIONARY_NS = 5_000_000_000  # ns at one position before it is used [tuned]
# m/s; slower than a walking person, faster than the reported speed of a receiver at rest. [tuned]
MAX_STATIONARY_SPEED_MPS = 0.5
# distance in claimed sigmas, readings in a row: the receiver has moved [tuned]
START_MOVED_SIGMAS, MOVED_READINGS = 2.0, 3
SIGMA_IMPROVEMENT = 0.5  # share of the published sigma; a receiver improves after its start [tuned]
MAX_TRANSPORT_SPEED_MPS = 40.0  # m/s; transport by car [tuned]
PUBLISH_PERIOD_NS = 1_000_000_000  # ns between repetitions of the message [tuned]


@dataclass(frozen=True)
class _Fix:
    """Position of a receiver at ``t_ns``. ``sigma_m``: 1-sigma per axis."""

    t_ns: int
    lat_deg: float
    lon_deg: float
    sigma_m: float

    @classmethod
    def of(cls, reading: GnssReading) -> "_Fix | None":
        """The fix of ``reading`` if it is good enough, otherwise None."""
        claimed_m = DEFAULT_RECEIVER_SIGMA_M if reading.horizontal_m is None else reading.horizontal_m
        if (
            reading.fix_type < FIX_3D
            or claimed_m > MAX_CLAIMED_SIGMA_M
            or reading.lat_deg is None
            or reading.lon_deg is None
        ):
            return None
        return cls(reading.t_ns, reading.lat_deg, reading.lon_deg, max(MIN_RECEIVER_SIGMA_M, claimed_m))

    def differs_from(self, other: "_Fix", sigmas: float, transport_m: float = 0.0) -> bool:
        """Whether the distance exceeds ``sigmas`` of both claims plus ``transport_m``."""
        return self.distance_m(other) > sigmas * math.hypot(self.sigma_m, other.sigma_m) + transport_m

    def distance_m(self, other: "_Fix") -> float:
        return distance_m(self.lat_deg, self.lon_deg, other.lat_deg, other.lon_deg)


class _ReceiverTrack:
    """``newest``: newest good fix. ``jump_m``: length of a jump that no transport explains, else 0."""

    def __init__(self) -> None:
        self.newest: _Fix | None = None
        self.jump_m = 0.0
        self._stationary_since: _Fix | None = None

    def update(self, reading: GnssReading) -> None:
        here, before = _Fix.of(reading), self.newest
        if here is None:
            self._stationary_since = None
            return
        self.newest = here
        if before is not None:
            dt_ns = here.t_ns - before.t_ns
            if here.differs_from(before, GNSS_JUMP_SIGMAS, MAX_TRANSPORT_SPEED_MPS * dt_ns * 1e-9):
                self.jump_m = here.distance_m(before)
            if dt_ns > READING_TIMEOUT_NS:
                self._stationary_since = None
        moving = reading.speed_mps is not None and reading.speed_mps > MAX_STATIONARY_SPEED_MPS
        if self._stationary_since is None or moving or here.differs_from(self._stationary_since, START_MOVED_SIGMAS):
            self._stationary_since = here

    def stationary_fix(self, now_ns: int) -> _Fix | None:
        """The newest fix, if the receiver has been stationary for STATIONARY_NS."""
        if self._stationary_since is None or self.newest is None or now_ns - self.newest.t_ns > READING_TIMEOUT_NS:
            return None
        return self.newest if self.newest.t_ns - self._stationary_since.t_ns >= STATIONARY_NS else None


class GnssInitializer:
    """``on_reading`` yields the GnssInitialPosition, ``on_answer`` the pilot's text about its acceptance."""

    def __init__(self, *, enabled: bool) -> None:
        self._enabled = enabled
        self._start_unknown = False
        self._armed: bool | None = None
        self._finished = False  # the vehicle was armed, or there was a map fix
        self._distrusted = False
        self._tracks: dict[int, _ReceiverTrack] = {}
        self._initial: tuple[int, _Fix] | None = None  # receiver and fix that are published as initial position
        self._moved_readings = 0  # readings in a row that differ from it
        self._published: GnssInitialPosition | None = None
        self._published_ns = 0
        self._answered_ns = 0  # t_ns of the newest InitialPosition

    def on_origin(self, origin: Origin) -> None:
        self._start_unknown = origin.start_sigma_m > UNKNOWN_POSITION_SIGMA_M

    def on_armed(self, armed: bool | None) -> None:
        """``armed`` None: not known."""
        self._armed = armed
        self._finished = self._finished or armed is True

    def on_map_fix(self) -> None:
        self._finished = True

    def on_reading(self, reading: GnssReading) -> Iterator[Message]:
        if not self._enabled or not self._start_unknown or self._finished or self._armed is not False:
            return
        now_ns, number = reading.t_ns, reading.receiver
        self._tracks.setdefault(number, _ReceiverTrack()).update(reading)
        if not self._distrusted:
            yield from self._evaluate(now_ns, number)
        if self._published is not None and now_ns - self._published_ns >= PUBLISH_PERIOD_NS:
            self._published_ns = now_ns
            yield self._published

    def on_answer(self, initial: InitialPosition) -> StatusText | None:
        """``initial``: the anchor's answer to a GnssInitialPosition."""
        if initial.t_ns == self._answered_ns:
            return None
        self._answered_ns = initial.t_ns
        if initial.verdict is not Verdict.ACCEPTED:
            return statustext(initial.t_ns, WARNING, "GPS is not on the map: no start")
        if initial.lat_deg is None:
            return None  # the text with the reason was sent with the withdrawal
        return statustext(initial.t_ns, INFO, f"start from GNSS, {initial.sigma_m:.0f} m")

    def _evaluate(self, now_ns: int, number: int) -> Iterator[Message]:
        """After a reading of receiver ``number``: publishes, replaces or withdraws the initial position."""
        jump_m = self._tracks[number].jump_m
        if jump_m > 0.0:
            self._distrusted = True
            yield from self._withdraw(
                now_ns, number, f"GPS {number + 1} jumped {min(jump_m, 99_999.0):.0f} m: no start"
            )
            return
        fixes = {n: fix for n, r in self._tracks.items() if (fix := r.stationary_fix(now_ns)) is not None}
        if any(a.differs_from(b, GNSS_JUMP_SIGMAS) for a in fixes.values() for b in fixes.values()):
            self._distrusted = True
            yield from self._withdraw(now_ns, number, "GPS 1 and GPS 2 disagree: no start")
            return
        best = min(fixes, key=lambda n: fixes[n].sigma_m, default=None)
        if best is not None and self._replaces_initial(fixes[best]):
            yield self._publish(now_ns, best, fixes[best])
        elif self._has_moved(number):
            yield from self._withdraw(now_ns, number, f"GPS {number + 1} moves: no start")

    def _replaces_initial(self, fix: _Fix) -> bool:
        if self._initial is None:
            return True
        initial = self._initial[1]
        return fix.differs_from(initial, START_MOVED_SIGMAS) or fix.sigma_m < SIGMA_IMPROVEMENT * initial.sigma_m

    def _has_moved(self, number: int) -> bool:
        """Whether receiver ``number`` gave the initial position and is elsewhere now."""
        if self._initial is None or self._initial[0] != number:
            return False
        newest = self._tracks[number].newest
        moved = newest is not None and newest.differs_from(self._initial[1], START_MOVED_SIGMAS)
        self._moved_readings = self._moved_readings + 1 if moved else 0
        return self._moved_readings >= MOVED_READINGS

    def _publish(self, now_ns: int, number: int, fix: _Fix | None) -> GnssInitialPosition:
        """``fix`` None: withdraws the initial position."""
        self._initial, self._moved_readings, self._published_ns = None if fix is None else (number, fix), 0, now_ns
        self._published = GnssInitialPosition(
            # t_ns identifies a message, so it must differ from that of the one before.
            t_ns=now_ns if self._published is None else max(now_ns, self._published.t_ns + 1),
            lat_deg=None if fix is None else fix.lat_deg,
            lon_deg=None if fix is None else fix.lon_deg,
            sigma_m=None if fix is None else fix.sigma_m,
            receiver=number,
        )
        return self._published

    def _withdraw(self, now_ns: int, number: int, text: str) -> Iterator[Message]:
        yield self._publish(now_ns, number, None)
        yield statustext(now_ns, WARNING, text)
