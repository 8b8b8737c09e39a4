"""How far off the map is, by a GNSS receiver while that is trusted, so that a flight goes on where GNSS had it.

A map lies metres beside the world, everywhere much alike, and no number of map fixes shows it. A receiver does, while
the judge (spoofing_detector.py) trusts it. What is learnt is taken out of what is sent, and of nothing else: estimator,
anchor and judge go on in the frame of the map, so that no receiver can lead the estimate, and the judge compares the
receiver with what it has not told.

A Kalman filter (Maybeck, Stochastic Models, Estimation, and Control 1, 1979, ch. 5) of the map's error, the receiver's
own slow error, which looks the same and does not average away, and of how old its readings are, which looks the same
until the vehicle has turned. Nothing is learnt of a reading before the receiver has been trusted for LAG_S after it,
and what contradicts what was learnt is not taken. A spoofer that is too slow for all of that moves what is sent by no
more than the map may be off by its own word, and the covariance that is said reaches back to the map."""

import math
from collections import deque
from dataclasses import dataclass

import msgspec
import numpy as np

from terrafix.core.gate import GATE
from terrafix.link.gnss.spoofing_detector import DELAY_SIGMA_S, LEAST_M, UNKNOWN_M
from terrafix.link.integrity.output_predictor import PredictedState, apart_m, offset
from terrafix.messages import GnssReading, MapOffset, NavEstimate

NS_PER_S = 1_000_000_000
BATCH_S, BATCH_READINGS = 20.0, 20  # readings of so long count as one: the errors of map fixes last as long
LAG_S = 60.0  # a drag-off of 0.5 m/s is seen within it
GAP_S = 2.0  # readings further apart are not of one batch
FIXED_MS = 3_000  # the estimate stands on the map: since the last map fix
RECEIVER_S = 600.0  # correlation of a receiver's slow error: multipath, atmosphere
ALIKE_M = 10_000.0  # correlation of a map's error: mosaics are put together of scenes, some 15 km wide from orbit
NOISE_M = 0.5  # of a batch, at least
PRIOR_BATCHES = 4.0  # that claims are worth, against how far batches are off
REFUSED = 3  # batches in a row, and what was learnt is forgotten
REACH = 2.45  # sigmas of map and receiver, 95 % of a plane: further apart one of them is not what it says
LYING = 0.25  # probability that a trusted receiver is led away too slowly to be seen: then the map was right
SLEW_MPS = 0.3  # what is sent moves no faster, or a velocity would be sent that does not go with it
SIZE = 5


@dataclass(frozen=True)
class Batch:
    """Readings of BATCH_S, as one."""

    t_ns: int
    place: tuple[float, float]  # latitude, longitude [deg]
    apart_m: np.ndarray  # (2,) estimate less receiver: east, north
    velocity_mps: np.ndarray  # (2,)
    variance_m2: float


class _Sum:
    """Readings on the way to a batch, of one map."""

    def __init__(self, t_ns: int, map_sigma_m: float) -> None:
        self.map_sigma_m = map_sigma_m
        self.from_ns = self.to_ns = t_ns
        self.count = 0
        self.total = np.zeros(SIZE)

    def add(self, t_ns: int, apart_m: np.ndarray, velocity_mps: np.ndarray, variance_m2: float) -> None:
        self.to_ns, self.count = t_ns, self.count + 1
        self.total += np.array([*apart_m, *velocity_mps, variance_m2])

    def is_full(self) -> bool:
        return self.to_ns - self.from_ns >= BATCH_S * NS_PER_S and self.count >= BATCH_READINGS

    def batch(self, place: tuple[float, float]) -> Batch:
        mean = self.total / self.count
        return Batch(self.to_ns, place, mean[:2], mean[2:4], float(mean[4]))


class Registration:
    """The error of one map: ``take`` batches, ask ``at`` a place."""

    def __init__(self, map_sigma_m: float, found: MapOffset | None = None) -> None:
        """``found``: what is known of it already."""
        self._map_m2 = map_sigma_m**2
        # Map's error east and north, receiver's error [m], age of readings less what is assumed [s]
        self._usual = np.array([self._map_m2, self._map_m2, LEAST_M**2, LEAST_M**2, DELAY_SIGMA_S**2])
        self._x, self._p = np.zeros(SIZE), np.diag(self._usual)
        self._place: tuple[float, float] | None = None
        self._t_ns = 0
        self._batches, self._misses, self._refused = 0.0, 0.0, 0
        if found is not None:
            self._x, self._p = np.array(found.state), np.array(found.cov).reshape(SIZE, SIZE)
            self._place, self._t_ns = (found.lat_deg, found.lon_deg), found.t_ns
        self._largest_m2 = _largest(self._p)

    def take(self, batch: Batch) -> MapOffset | None:
        """-> what is known now; None: the batch contradicts what was known."""
        alike = math.exp(-max(0.0, (batch.t_ns - self._t_ns) * 1e-9) / RECEIVER_S)
        self._x, self._p = self._moved(batch.place, alike)
        self._place, self._t_ns = batch.place, batch.t_ns
        h = np.hstack([np.eye(2), np.eye(2), batch.velocity_mps[:, None]])
        missed = batch.apart_m - h @ self._x
        scale = max(1.0, (PRIOR_BATCHES + self._misses) / (PRIOR_BATCHES + self._batches))
        noise_m2 = scale * batch.variance_m2
        s = h @ self._p @ h.T + noise_m2 * np.eye(2)
        squared = float(missed @ np.linalg.solve(s, missed))
        self._refused = self._refused + 1 if squared > GATE[2] else 0
        if self._refused == REFUSED:
            self._x, self._p, self._refused = np.zeros(SIZE), np.diag(self._usual), 0
        elif not self._refused:
            self._batches, self._misses = self._batches + 1.0, self._misses + squared / 2.0
            gain = np.linalg.solve(s, h @ self._p).T
            left = np.eye(SIZE) - gain @ h
            self._x, self._p = self._x + gain @ missed, left @ self._p @ left.T + noise_m2 * gain @ gain.T
        self._largest_m2 = _largest(self._p)
        if self._refused:
            return None
        return MapOffset(
            t_ns=batch.t_ns,
            map_sigma_m=math.sqrt(self._map_m2),
            lat_deg=batch.place[0],
            lon_deg=batch.place[1],
            state=tuple(float(v) for v in self._x),
            cov=tuple(float(v) for v in self._p.ravel()),
        )

    def other_receiver(self) -> None:
        """Its error is its own."""
        self._x[2:4], self._p[2:4], self._p[:, 2:4] = 0.0, 0.0, 0.0
        self._p[2, 2] = self._p[3, 3] = LEAST_M**2

    def at(self, place: tuple[float, float]) -> tuple[np.ndarray, float]:
        """-> (the map's error there (2,), east and north [m]; the largest variance of it [m^2]).

        Nothing is known of it while map and receiver are further apart than both may be off: either may be wrong."""
        if float(np.hypot(*(self._x[:2] + self._x[2:4]))) > REACH * math.sqrt(self._map_m2 + LEAST_M**2):
            return np.zeros(2), self._map_m2
        near = self._near(place)  # the same for both axes, which need not be moved to be measured
        return near * self._x[:2], near**2 * self._largest_m2 + (1.0 - near**2) * self._map_m2

    def _moved(self, place: tuple[float, float], alike: float) -> tuple[np.ndarray, np.ndarray]:
        """State and covariance at a ``place``, when of the receiver's error a share ``alike`` has stayed."""
        if self._place is None:
            return self._x, self._p
        near = self._near(place)
        keep = np.array([near, near, alike, alike, 1.0])
        return keep * self._x, keep[:, None] * self._p * keep + np.diag((1.0 - keep**2) * self._usual)

    def _near(self, place: tuple[float, float]) -> float:
        """The share of what was learnt that holds there."""
        return 1.0 if self._place is None else math.exp(-math.hypot(*apart_m(self._place, place)) / ALIKE_M)


def _largest(p: np.ndarray) -> float:
    """Variance of the map's error along the axis that is known worst [m^2]: estimates are sent ten times a second, and
    batches come once in BATCH_S."""
    return float(np.linalg.eigvalsh(p[:2, :2])[-1])


class MapOffsets:
    """``take`` each reading that was judged; ``corrected`` is the estimate as it is to be sent.

    Layers of a map are told apart by what they state of themselves."""

    def __init__(self, found: MapOffset | None = None) -> None:
        self._of: dict[float, Registration] = {}
        self._taken_out = np.zeros(2)
        self._at_ns: int | None = None
        self._sum: _Sum | None = None
        self._waiting: deque[tuple[float, Batch]] = deque()
        self._receiver: int | None = None  # that is trusted, and listened to now
        self._last_receiver: int | None = None
        if found is not None:
            self._of[found.map_sigma_m] = Registration(found.map_sigma_m, found)

    def take(
        self, reading: GnssReading, vision: PredictedState | None, estimate: NavEstimate | None, *, trusted: bool
    ) -> MapOffset | None:
        """``vision``: ``estimate`` at the time of the reading, None when it is none that counts. -> what is known now,
        when that has changed."""
        if self._receiver not in (None, reading.receiver):
            return None
        if not trusted:
            self._receiver, self._sum = None, None
            self._waiting.clear()
            return None
        if self._receiver is None:
            self._receiver = reading.receiver
            for known in self._of.values() if reading.receiver != self._last_receiver else ():
                known.other_receiver()
            self._last_receiver = reading.receiver
        self._gather(reading, vision, estimate)
        if not self._waiting or reading.t_ns - self._waiting[0][1].t_ns < LAG_S * NS_PER_S:
            return None
        map_sigma_m, batch = self._waiting.popleft()
        return self._of.setdefault(map_sigma_m, Registration(map_sigma_m)).take(batch)

    def _gather(self, reading: GnssReading, vision: PredictedState | None, estimate: NavEstimate | None) -> None:
        if vision is None or estimate is None or reading.lat_deg is None or reading.lon_deg is None:
            return
        if estimate.map_sigma_m <= 0.0 or not 0 <= estimate.last_anchor_age_ms <= FIXED_MS:
            return
        went_on = self._sum is not None and reading.t_ns - self._sum.to_ns <= GAP_S * NS_PER_S
        if self._sum is None or not went_on or self._sum.map_sigma_m != estimate.map_sigma_m:
            self._sum = _Sum(reading.t_ns, estimate.map_sigma_m)
        place = vision.lat_deg, vision.lon_deg
        receiver_m = UNKNOWN_M if reading.horizontal_m is None else reading.horizontal_m
        variance_m2 = (
            NOISE_M**2
            + max(0.0, vision.horizontal_sigma_m**2 - estimate.map_sigma_m**2)
            + max(0.0, receiver_m**2 - LEAST_M**2)
        )
        off_m = np.array(apart_m((reading.lat_deg, reading.lon_deg), place))
        self._sum.add(reading.t_ns, off_m, np.array(vision.velocity_enu_mps[:2]), variance_m2)
        if self._sum.is_full():
            self._waiting.append((estimate.map_sigma_m, self._sum.batch(place)))
            self._sum = None

    def corrected(self, estimate: NavEstimate, now_ns: int) -> tuple[NavEstimate, tuple[float, float]]:
        """-> (the estimate less the map's error, as far as that is known; what was taken out, east and north [m])."""
        map_m2 = estimate.map_sigma_m**2
        known = self._of.get(estimate.map_sigma_m)
        off_m, variance_m2 = np.zeros(2), map_m2
        if known is not None:
            off_m, variance_m2 = known.at((estimate.lat_deg, estimate.lon_deg))
        left_m = self._slew(off_m, now_ns)
        if known is None and not self._taken_out.any():
            return estimate, (0.0, 0.0)
        # On the way there nothing is known worse than before.
        error_m2 = max(variance_m2, min(map_m2, variance_m2 + left_m**2)) - map_m2
        error_m2 += LYING * float(self._taken_out @ self._taken_out)
        cov = list(estimate.cov)
        cov[0], cov[7] = cov[0] + error_m2, cov[7] + error_m2
        east_m, north_m = float(self._taken_out[0]), float(self._taken_out[1])
        lat_deg, lon_deg = offset(estimate.lat_deg, estimate.lon_deg, -east_m, -north_m)
        sent = msgspec.structs.replace(estimate, lat_deg=lat_deg, lon_deg=lon_deg, cov=tuple(cov))
        return sent, (east_m, north_m)

    def _slew(self, wanted_m: np.ndarray, now_ns: int) -> float:
        """-> what is left of the way [m]. At first there is none: a link that was here before this one has gone it."""
        since_ns, self._at_ns = self._at_ns, now_ns
        way_m = wanted_m - self._taken_out
        left_m = float(np.hypot(*way_m))
        step_m = left_m if since_ns is None else min(left_m, SLEW_MPS * max(0.0, (now_ns - since_ns) * 1e-9))
        if left_m > 0.0:
            self._taken_out = self._taken_out + way_m * (step_m / left_m)
        return left_m - step_m
