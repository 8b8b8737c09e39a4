"""State of a running Terrafix from the messages on its bus."""

from collections import Counter, defaultdict, deque
from dataclasses import dataclass, field
from typing import TypeVar

from terrafix import messages as m
from terrafix.core.clock import NS_PER_S

# What is read from the bus.
KINDS: tuple[type[m.Message], ...] = (
    m.SourceFacts,
    m.Frame,
    m.FrameRate,
    m.Odometry,
    m.MapMatch,
    m.NavEstimate,
    m.MeasurementVerdict,
    m.SearchState,
    m.CalibrationFault,
    m.ModelEvent,
    m.GpsInput,
    m.LinkStatus,
    m.EkfStatus,
    m.GnssVerdict,
    m.PositionSource,
    m.StatusText,
    m.Health,
    m.ThermalReading,
    m.ProcessEvent,
    m.Dropped,
)
RATED: tuple[type[m.Message], ...] = (
    m.Frame,
    m.Odometry,
    m.MapMatch,
    m.NavEstimate,
    m.GpsInput,
)  # their rates are shown
WINDOW_S = 5.0  # over which rates and delays are taken
LINES = 5  # of rejected measurements and texts that are kept

T = TypeVar("T", bound=m.Message)


@dataclass
class Status:
    """``newest``: message of each type, with its time of reception [ns]; ``gnss``: by receiver; ``events``: of each
    process; ``rejected`` and ``texts``: the newest ones; ``dropped``: lost messages by process and type."""

    began_ns: int
    newest: dict[type[m.Message], tuple[int, m.Message]] = field(default_factory=dict)
    gnss: dict[int, m.GnssVerdict] = field(default_factory=dict)
    events: dict[str, m.ProcessEvent] = field(default_factory=dict)
    restarts: Counter[str] = field(default_factory=Counter)
    rejected: deque[m.MeasurementVerdict] = field(default_factory=lambda: deque(maxlen=LINES))
    texts: deque[m.StatusText] = field(default_factory=lambda: deque(maxlen=LINES))
    dropped: Counter[tuple[str, str]] = field(default_factory=Counter)
    _received: defaultdict[type[m.Message], deque[int]] = field(default_factory=lambda: defaultdict(deque))
    _delays_ns: deque[tuple[int, int]] = field(default_factory=deque)  # of estimates: time of reception, delay
    _matched: deque[tuple[int, bool]] = field(default_factory=deque)  # map matches: time of reception, accepted

    def take(self, received_ns: int, message: m.Message) -> None:
        self.newest[type(message)] = received_ns, message
        if isinstance(message, RATED):
            self._received[type(message)].append(received_ns)
        match message:
            case m.NavEstimate():
                self._delays_ns.append((received_ns, message.emitted_at_ns - message.t_ns))
            case m.MapMatch():
                self._matched.append((received_ns, message.verdict is m.Verdict.ACCEPTED))
            case m.GnssVerdict():
                self.gnss[message.receiver] = message
            case m.ProcessEvent():
                self.events[message.process] = message
                self.restarts[message.process] += message.event == "restarted"
            case m.MeasurementVerdict() if message.verdict is not m.Verdict.ACCEPTED:
                self.rejected.append(message)
            case m.StatusText():
                self.texts.append(message)
            case m.Dropped():
                self.dropped[message.process, message.message] += message.count
            case _:
                pass
        self._forget(received_ns)

    def last(self, kind: type[T]) -> T | None:
        """The newest message of a type; None: there was none."""
        found = self.newest.get(kind)
        return found[1] if found is not None and isinstance(found[1], kind) else None

    def age_s(self, kind: type[m.Message], now_ns: int) -> float | None:
        """Since the reception of the newest message of a type; None: there was none."""
        found = self.newest.get(kind)
        return None if found is None else (now_ns - found[0]) / NS_PER_S

    def rate_hz(self, kind: type[m.Message], now_ns: int) -> float:
        """Messages of a type per second, over WINDOW_S, or since the status began."""
        self._forget(now_ns)
        over_s = min(WINDOW_S, (now_ns - self.began_ns) / NS_PER_S)
        return len(self._received[kind]) / over_s if over_s > 0.0 else 0.0

    def delay_ms(self) -> float | None:
        """Median time from the exposure of a frame to its estimates, over WINDOW_S; None: there are none."""
        delays = sorted(delay for _, delay in self._delays_ns)
        return delays[len(delays) // 2] / 1e6 if delays else None

    def matched_share(self) -> float | None:
        """Share of the map matches of WINDOW_S that were accepted; None: there are none."""
        return sum(ok for _, ok in self._matched) / len(self._matched) if self._matched else None

    def _forget(self, now_ns: int) -> None:
        oldest_ns = now_ns - round(WINDOW_S * NS_PER_S)
        for times in self._received.values():
            while times and times[0] < oldest_ns:
                times.popleft()
        for pairs in (self._delays_ns, self._matched):
            while pairs and pairs[0][0] < oldest_ns:
                pairs.popleft()
