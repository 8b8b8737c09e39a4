"""The start from GNSS: where a receiver says that the vehicle stands, if nobody said where the flight begins.

A receiver is believed on the ground alone, before the vehicle is armed for the first time: while it has a 3D fix,
claims to be good to 10 m, has stood still for five seconds, and nothing speaks against it. A vehicle that is
carried on takes its start along. A receiver that jumps as nobody can carry it, or that another one contradicts, is
jammed, spoofed or broken, and nobody on the ground can say which of its places was the true one."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

from terrafix.link.gnss.spoofing_detector import FIX_3D, JUMP_SIGMAS, LEAST_M, SILENT_NS, UNKNOWN_M
from terrafix.link.ground_station.prior_request import NOT_KNOWN_M
from terrafix.link.integrity.output_predictor import distance_m
from terrafix.link.pilot_text.statustext import INFO, WARNING, statustext
from terrafix.messages import GnssReading, GnssStart, Message, Origin, Start, StatusText, Verdict

GOOD_M = 10.0  # 1-sigma that it claims: twice what ArduPilot asks for before a copter is armed
STEADY_NS = 5_000_000_000
STILL_MPS = 0.5  # who walks is faster, and what a receiver says of one that stands is slower
AWAY_SIGMAS, AWAY_READINGS = 2.0, 3  # by what both claim: there it is no longer
BETTER = 0.5  # of the sigma that was said: a receiver that has just woken up gets better
CARRIED_MPS = 40.0  # by a car
SAY_NS = 1_000_000_000


@dataclass(frozen=True)
class _Place:
    """What a receiver says, at ``t_ns``; 1-sigma per axis."""

    t_ns: int
    lat_deg: float
    lon_deg: float
    sigma_m: float

    @classmethod
    def of(cls, reading: GnssReading) -> "_Place | None":
        """If it is good."""
        claimed_m = UNKNOWN_M if reading.horizontal_m is None else reading.horizontal_m
        if reading.fix_type < FIX_3D or claimed_m > GOOD_M or reading.lat_deg is None or reading.lon_deg is None:
            return None
        return cls(reading.t_ns, reading.lat_deg, reading.lon_deg, max(LEAST_M, claimed_m))

    def is_away(self, other: "_Place", sigmas: float, carried_m: float = 0.0) -> bool:
        return self.distance_m(other) > sigmas * math.hypot(self.sigma_m, other.sigma_m) + carried_m

    def distance_m(self, other: "_Place") -> float:
        return distance_m(self.lat_deg, self.lon_deg, other.lat_deg, other.lon_deg)


class _Receiver:
    """``newest`` good place; ``jumped_m``: how far it jumped to there."""

    def __init__(self) -> None:
        self.newest: _Place | None = None
        self.jumped_m = 0.0
        self._since: _Place | None = None  # it has been there since

    def take(self, reading: GnssReading) -> None:
        here, before = _Place.of(reading), self.newest
        if here is None:
            self._since = None
            return
        self.newest = here
        if before is not None:
            dt_ns = here.t_ns - before.t_ns
            if here.is_away(before, JUMP_SIGMAS, CARRIED_MPS * dt_ns * 1e-9):
                self.jumped_m = here.distance_m(before)
            if dt_ns > SILENT_NS:
                self._since = None
        moves = reading.speed_mps is not None and reading.speed_mps > STILL_MPS
        if self._since is None or moves or here.is_away(self._since, AWAY_SIGMAS):
            self._since = here

    def steady(self, now_ns: int) -> _Place | None:
        """Where it is, if it has been there for long enough."""
        if self._since is None or self.newest is None or now_ns - self.newest.t_ns > SILENT_NS:
            return None
        return self.newest if self.newest.t_ns - self._since.t_ns >= STEADY_NS else None


class GnssStarts:
    """``reading`` says where the flight begins, ``answer`` what the pilot reads of that."""

    def __init__(self, *, wanted: bool) -> None:
        self._wanted = wanted
        self._unknown = False  # nobody said it
        self._armed: bool | None = None
        self._over = False  # the vehicle was armed, or the map has told where it is
        self._distrusted = False
        self._receivers: dict[int, _Receiver] = {}
        self._place: tuple[int, _Place] | None = None  # receiver and place that hold
        self._away = 0  # readings in a row that are not there
        self._said: GnssStart | None = None
        self._said_ns = 0
        self._answered_ns = 0  # t_ns of the newest answer

    def origin(self, origin: Origin) -> None:
        self._unknown = origin.start_sigma_m > NOT_KNOWN_M

    def vehicle(self, armed: bool | None) -> None:
        self._armed = armed
        self._over = self._over or armed is True

    def anchored(self) -> None:
        """The map has told where the vehicle is."""
        self._over = True

    def reading(self, reading: GnssReading) -> Iterator[Message]:
        if not self._wanted or not self._unknown or self._over or self._armed is not False:
            return
        now_ns, number = reading.t_ns, reading.receiver
        self._receivers.setdefault(number, _Receiver()).take(reading)
        if not self._distrusted:
            yield from self._look(now_ns, number)
        if self._said is not None and now_ns - self._said_ns >= SAY_NS:
            self._said_ns = now_ns
            yield self._said

    def answer(self, start: Start) -> StatusText | None:
        if start.t_ns == self._answered_ns:
            return None
        self._answered_ns = start.t_ns
        if start.verdict is not Verdict.ACCEPTED:
            return statustext(start.t_ns, WARNING, "GPS is not on the map: no start")
        if start.lat_deg is None:
            return None  # why, was said with the withdrawal
        return statustext(start.t_ns, INFO, f"start from GNSS, {start.sigma_m:.0f} m")

    def _look(self, now_ns: int, number: int) -> Iterator[Message]:
        jumped_m = self._receivers[number].jumped_m
        if jumped_m > 0.0:
            self._distrusted = True
            yield from self._withdraw(
                now_ns, number, f"GPS {number + 1} jumped {min(jumped_m, 99_999.0):.0f} m: no start"
            )
            return
        steady = {n: place for n, r in self._receivers.items() if (place := r.steady(now_ns)) is not None}
        if any(a.is_away(b, JUMP_SIGMAS) for a in steady.values() for b in steady.values()):
            self._distrusted = True
            yield from self._withdraw(now_ns, number, "GPS 1 and GPS 2 disagree: no start")
            return
        best = min(steady, key=lambda n: steady[n].sigma_m, default=None)
        if best is not None and self._is_news(steady[best]):
            yield self._say(now_ns, best, steady[best])
        elif self._is_gone(number):
            yield from self._withdraw(now_ns, number, f"GPS {number + 1} moves: no start")

    def _is_news(self, place: _Place) -> bool:
        if self._place is None:
            return True
        said = self._place[1]
        return place.is_away(said, AWAY_SIGMAS) or place.sigma_m < BETTER * said.sigma_m

    def _is_gone(self, number: int) -> bool:
        """This receiver said the place that holds, and is elsewhere now."""
        if self._place is None or self._place[0] != number:
            return False
        newest = self._receivers[number].newest
        away = newest is not None and newest.is_away(self._place[1], AWAY_SIGMAS)
        self._away = self._away + 1 if away else 0
        return self._away >= AWAY_READINGS

    def _say(self, now_ns: int, number: int, place: _Place | None) -> GnssStart:
        self._place, self._away, self._said_ns = None if place is None else (number, place), 0, now_ns
        self._said = GnssStart(
            t_ns=now_ns if self._said is None else max(now_ns, self._said.t_ns + 1),  # by which they are told apart
            lat_deg=None if place is None else place.lat_deg,
            lon_deg=None if place is None else place.lon_deg,
            sigma_m=None if place is None else place.sigma_m,
            receiver=number,
        )
        return self._said

    def _withdraw(self, now_ns: int, number: int, text: str) -> Iterator[Message]:
        yield self._say(now_ns, number, None)
        yield statustext(now_ns, WARNING, text)
