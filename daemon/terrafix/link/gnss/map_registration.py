"""Estimates the registration error of the map (map offset) with a trusted GNSS receiver, and subtracts it from the
output. The flight then continues on the receiver's positions when GNSS is lost.

A map is off by metres, by nearly the same vector everywhere, and no number of map fixes shows it. A receiver does,
while the spoofing detector trusts it. The estimate is subtracted from what is sent, and nowhere else: estimator, anchor
and spoofing detector work in the frame of the map. So no receiver can pull the estimate, and the detector compares the
receiver with an estimate that does not depend on it.

Kalman filter (Maybeck, Stochastic Models, Estimation, and Control 1, 1979, ch. 5) for three quantities: map offset; the
receiver's slowly varying error, which has the same effect on the measurement and does not average out; and the age
of its readings, which has the same effect until the vehicle turns. A reading is learnt only after the receiver has been
trusted for LEARNING_DELAY_S since, and what contradicts the estimate is rejected. A spoofer that is too slow for all of
this moves the output by no more than the stated error of the map, and the published covariance reaches back to the
uncorrected position."""

import math
from collections import deque
from dataclasses import dataclass

import msgspec
import numpy as np

from terrafix.core.clock import NS_PER_S
from terrafix.core.gate import GATE
from terrafix.link.gnss.spoofing_detector import DEFAULT_RECEIVER_SIGMA_M, MIN_RECEIVER_SIGMA_M, READING_DELAY_SIGMA_S
from terrafix.link.integrity.output_predictor import EE, NN, PredictedState, east_north_m, offset
from terrafix.messages import GnssReading, MapOffset, NavEstimate

# Readings of this many seconds, and at least so many, count as one: the errors of map fixes are correlated so long.
BATCH_S, BATCH_READINGS = 20.0, 20  # [tuned]
LEARNING_DELAY_S = 60.0  # s; a drag-off of 0.5 m/s is detected within it [tuned]
MAX_READING_GAP_S = 2.0  # s; a longer gap starts a new batch [tuned]
MAX_MAP_FIX_AGE_MS = 3_000  # ms since the last map fix, up to which the estimate counts as one on the map [tuned]
RECEIVER_CORRELATION_S = 600.0  # s; of the receiver's slowly varying error: multipath, atmosphere [tuned]
# m; correlation length of the map offset. Mosaics are assembled from scenes, from orbit some 15 km wide. [tuned]
MAP_CORRELATION_M = 10_000.0
MIN_BATCH_SIGMA_M = 0.5  # m; measurement noise of a batch, at least [tuned]
PRIOR_BATCHES = 4.0  # weight of the claimed noise against the innovations, in batches [tuned]
REINIT_REJECTIONS = 3  # rejected batches in a row after which the estimate starts again from its prior [tuned]
# Largest distance of map and receiver in claimed sigmas; beyond it one of the claims is wrong, and nothing is applied.
MAX_DISTANCE_SIGMAS = 2.45  # [spec: 95 % radius of a bivariate normal]
# Probability that a trusted receiver is dragged too slowly for the detector. The uncorrected position is right then.
DRAG_PROBABILITY = 0.25  # [tuned]
MAX_SLEW_MPS = 0.3  # m/s; faster changes of the output would contradict the velocity that is sent [tuned]
# State: map offset east, north [m]; receiver error east, north [m]; age of a reading less READING_DELAY_S [s].
STATE_SIZE = 5  # [spec: state above]
MAP, RECEIVER = slice(0, 2), slice(2, 4)  # indices of the state [spec: state above]


@dataclass(frozen=True)
class Batch:
    """Mean of the readings of BATCH_S."""

    t_ns: int
    lat_lon_deg: tuple[float, float]
    distance_m: np.ndarray  # (2,) estimate minus receiver: east, north
    velocity_mps: np.ndarray  # (2,) east, north
    variance_m2: float  # per axis


class _BatchAccumulator:
    """Sums of the readings of one batch, over one map layer."""

    def __init__(self, t_ns: int, map_sigma_m: float) -> None:
        self.map_sigma_m = map_sigma_m
        self.from_ns = self.to_ns = t_ns
        self.count = 0
        self.total = np.zeros(5)  # distance east, north, velocity east, north, variance

    def add(self, t_ns: int, distance_m: np.ndarray, velocity_mps: np.ndarray, variance_m2: float) -> None:
        self.to_ns, self.count = t_ns, self.count + 1
        self.total += np.array([*distance_m, *velocity_mps, variance_m2])

    def is_full(self) -> bool:
        return self.to_ns - self.from_ns >= BATCH_S * NS_PER_S and self.count >= BATCH_READINGS

    def batch(self, lat_lon_deg: tuple[float, float]) -> Batch:
        mean = self.total / self.count
        return Batch(self.to_ns, lat_lon_deg, mean[:2], mean[2:4], float(mean[4]))


class MapOffsetFilter:
    """Kalman filter for the offset of one map layer: ``update`` with batches, ``offset_at`` for a place."""

    def __init__(self, map_sigma_m: float, prior: MapOffset | None = None) -> None:
        """``map_sigma_m``: stated 1-sigma per axis of the layer. ``prior``: an estimate to continue."""
        self._map_m2 = map_sigma_m**2
        self._prior_variance = np.array(
            [self._map_m2, self._map_m2, MIN_RECEIVER_SIGMA_M**2, MIN_RECEIVER_SIGMA_M**2, READING_DELAY_SIGMA_S**2]
        )
        self._x, self._p = np.zeros(STATE_SIZE), np.diag(self._prior_variance)
        self._lat_lon_deg: tuple[float, float] | None = None  # place of the last batch
        self._t_ns = 0
        self._accepted, self._nis_sum, self._rejected_in_row = 0.0, 0.0, 0
        if prior is not None:
            self._x, self._p = np.array(prior.state), np.array(prior.cov).reshape(STATE_SIZE, STATE_SIZE)
            self._lat_lon_deg, self._t_ns = (prior.lat_deg, prior.lon_deg), prior.t_ns
        self._max_variance_m2 = _max_map_variance(self._p)

    def update(self, batch: Batch) -> MapOffset | None:
        """-> the new estimate; None when the batch is rejected."""
        receiver_correlation = math.exp(-max(0.0, (batch.t_ns - self._t_ns) * 1e-9) / RECEIVER_CORRELATION_S)
        self._x, self._p = self._predicted(batch.lat_lon_deg, receiver_correlation)
        self._lat_lon_deg, self._t_ns = batch.lat_lon_deg, batch.t_ns
        h = np.hstack([np.eye(2), np.eye(2), batch.velocity_mps[:, None]])
        innovation = batch.distance_m - h @ self._x
        # Noise that the innovations of earlier batches show to be larger than claimed is scaled up.
        scale = max(1.0, (PRIOR_BATCHES + self._nis_sum) / (PRIOR_BATCHES + self._accepted))
        noise_m2 = scale * batch.variance_m2
        s = h @ self._p @ h.T + noise_m2 * np.eye(2)
        nis = float(innovation @ np.linalg.solve(s, innovation))
        self._rejected_in_row = self._rejected_in_row + 1 if nis > GATE[2] else 0
        if self._rejected_in_row == REINIT_REJECTIONS:
            self._x, self._p, self._rejected_in_row = np.zeros(STATE_SIZE), np.diag(self._prior_variance), 0
        elif not self._rejected_in_row:
            self._accepted, self._nis_sum = self._accepted + 1.0, self._nis_sum + nis / 2.0
            gain = np.linalg.solve(s, h @ self._p).T
            i_kh = np.eye(STATE_SIZE) - gain @ h
            # Joseph form of the covariance update.
            self._x, self._p = self._x + gain @ innovation, i_kh @ self._p @ i_kh.T + noise_m2 * gain @ gain.T
        self._max_variance_m2 = _max_map_variance(self._p)
        if self._rejected_in_row:
            return None
        return MapOffset(
            t_ns=batch.t_ns,
            map_sigma_m=math.sqrt(self._map_m2),
            lat_deg=batch.lat_lon_deg[0],
            lon_deg=batch.lat_lon_deg[1],
            state=tuple(float(v) for v in self._x),
            cov=tuple(float(v) for v in self._p.ravel()),
        )

    def reset_receiver(self) -> None:
        """Another receiver is used from now on: its error is independent of that of the one before."""
        self._x[RECEIVER], self._p[RECEIVER], self._p[:, RECEIVER] = 0.0, 0.0, 0.0
        self._p[RECEIVER, RECEIVER] = MIN_RECEIVER_SIGMA_M**2 * np.eye(2)

    def offset_at(self, lat_lon_deg: tuple[float, float]) -> tuple[np.ndarray, float]:
        """-> (map offset at this place (2,), east and north [m]; its variance along the worst axis [m^2]).

        While map and receiver are further apart than both claims allow, it is the prior: either may be wrong."""
        if float(np.hypot(*(self._x[MAP] + self._x[RECEIVER]))) > MAX_DISTANCE_SIGMAS * math.sqrt(
            self._map_m2 + MIN_RECEIVER_SIGMA_M**2
        ):
            return np.zeros(2), self._map_m2
        # One correlation for both axes, so that the mean and the largest variance need no matrix product.
        correlation = self._map_correlation(lat_lon_deg)
        variance_m2 = correlation**2 * self._max_variance_m2 + (1.0 - correlation**2) * self._map_m2
        return correlation * self._x[MAP], variance_m2

    def _predicted(
        self, lat_lon_deg: tuple[float, float], receiver_correlation: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """-> (state (5,), covariance (5, 5)) at a place, with Gauss-Markov decay of map offset and receiver error."""
        if self._lat_lon_deg is None:
            return self._x, self._p
        map_correlation = self._map_correlation(lat_lon_deg)
        phi = np.array([map_correlation, map_correlation, receiver_correlation, receiver_correlation, 1.0])
        return phi * self._x, phi[:, None] * self._p * phi + np.diag((1.0 - phi**2) * self._prior_variance)

    def _map_correlation(self, lat_lon_deg: tuple[float, float]) -> float:
        """Correlation of the map offset between this place and that of the last batch."""
        if self._lat_lon_deg is None:
            return 1.0
        return math.exp(-math.hypot(*east_north_m(self._lat_lon_deg, lat_lon_deg)) / MAP_CORRELATION_M)


def _max_map_variance(p: np.ndarray) -> float:
    """Variance of the map offset along its worst axis [m^2]. It is computed once for each batch, because estimates are
    sent ten times a second."""
    return float(np.linalg.eigvalsh(p[MAP, MAP])[-1])


class MapOffsetEstimator:
    """``update`` with each reading after its assessment; ``correct`` for the estimate that is sent.

    The layers of a map have one filter each; they are identified by their stated sigma."""

    def __init__(self, prior: MapOffset | None = None) -> None:
        """``prior``: estimate of the link process that this one replaces, if there was one."""
        self._filters: dict[float, MapOffsetFilter] = {}
        self._applied_m = np.zeros(2)  # offset that is subtracted at present, east and north
        self._applied_ns: int | None = None
        self._accumulator: _BatchAccumulator | None = None
        self._pending: deque[tuple[float, Batch]] = deque()  # map sigma and batch, younger than LEARNING_DELAY_S
        self._receiver: int | None = None  # receiver in use: trusted at present
        self._last_receiver: int | None = None
        if prior is not None:
            self._filters[prior.map_sigma_m] = MapOffsetFilter(prior.map_sigma_m, prior)

    def update(
        self, reading: GnssReading, vision: PredictedState | None, estimate: NavEstimate | None, *, trusted: bool
    ) -> MapOffset | None:
        """``vision``: ``estimate`` predicted to the time of the reading, None when it must not be compared.
        ``trusted``: the receiver is trusted. -> the new estimate of the map offset when it has changed, else None."""
        if self._receiver not in (None, reading.receiver):
            return None
        if not trusted:
            self._receiver, self._accumulator = None, None
            self._pending.clear()
            return None
        if self._receiver is None:
            self._receiver = reading.receiver
            for layer in self._filters.values() if reading.receiver != self._last_receiver else ():
                layer.reset_receiver()
            self._last_receiver = reading.receiver
        self._accumulate(reading, vision, estimate)
        if not self._pending or reading.t_ns - self._pending[0][1].t_ns < LEARNING_DELAY_S * NS_PER_S:
            return None
        map_sigma_m, batch = self._pending.popleft()
        return self._filters.setdefault(map_sigma_m, MapOffsetFilter(map_sigma_m)).update(batch)

    def _accumulate(self, reading: GnssReading, vision: PredictedState | None, estimate: NavEstimate | None) -> None:
        if vision is None or estimate is None or reading.lat_deg is None or reading.lon_deg is None:
            return
        if estimate.map_sigma_m <= 0.0 or not 0 <= estimate.last_anchor_age_ms <= MAX_MAP_FIX_AGE_MS:
            return
        continues = (
            self._accumulator is not None and reading.t_ns - self._accumulator.to_ns <= MAX_READING_GAP_S * NS_PER_S
        )
        if self._accumulator is None or not continues or self._accumulator.map_sigma_m != estimate.map_sigma_m:
            self._accumulator = _BatchAccumulator(reading.t_ns, estimate.map_sigma_m)
        lat_lon_deg = vision.lat_deg, vision.lon_deg
        receiver_m = DEFAULT_RECEIVER_SIGMA_M if reading.horizontal_m is None else reading.horizontal_m
        variance_m2 = (
            MIN_BATCH_SIGMA_M**2
            + max(0.0, vision.horizontal_sigma_m**2 - estimate.map_sigma_m**2)
            + max(0.0, receiver_m**2 - MIN_RECEIVER_SIGMA_M**2)
        )
        distance_m = np.array(east_north_m((reading.lat_deg, reading.lon_deg), lat_lon_deg))
        self._accumulator.add(reading.t_ns, distance_m, np.array(vision.velocity_enu_mps[:2]), variance_m2)
        if self._accumulator.is_full():
            self._pending.append((estimate.map_sigma_m, self._accumulator.batch(lat_lon_deg)))
            self._accumulator = None

    def correct(self, estimate: NavEstimate, now_ns: int) -> tuple[NavEstimate, tuple[float, float]]:
        """-> (the estimate minus the map offset as far as it is known; the subtracted offset, east and north [m])."""
        map_m2 = estimate.map_sigma_m**2
        layer = self._filters.get(estimate.map_sigma_m)
        offset_m, variance_m2 = np.zeros(2), map_m2
        if layer is not None:
            offset_m, variance_m2 = layer.offset_at((estimate.lat_deg, estimate.lon_deg))
        remaining_m = self._slew(offset_m, now_ns)
        if layer is None and not self._applied_m.any():
            return estimate, (0.0, 0.0)
        # While the applied offset slews to its target, the covariance is no larger than without a correction.
        added_m2 = max(variance_m2, min(map_m2, variance_m2 + remaining_m**2)) - map_m2
        added_m2 += DRAG_PROBABILITY * float(self._applied_m @ self._applied_m)
        cov = list(estimate.cov)
        cov[EE], cov[NN] = cov[EE] + added_m2, cov[NN] + added_m2
        east_m, north_m = float(self._applied_m[0]), float(self._applied_m[1])
        lat_deg, lon_deg = offset(estimate.lat_deg, estimate.lon_deg, -east_m, -north_m)
        corrected = msgspec.structs.replace(estimate, lat_deg=lat_deg, lon_deg=lon_deg, cov=tuple(cov))
        return corrected, (east_m, north_m)

    def _slew(self, target_m: np.ndarray, now_ns: int) -> float:
        """Moves the applied offset towards ``target_m`` with MAX_SLEW_MPS. -> the remaining distance [m]. The first
        call applies all of it: the link process before this one has done the slew."""
        since_ns, self._applied_ns = self._applied_ns, now_ns
        difference_m = target_m - self._applied_m
        remaining_m = float(np.hypot(*difference_m))
        step_m = (
            remaining_m if since_ns is None else min(remaining_m, MAX_SLEW_MPS * max(0.0, (now_ns - since_ns) * 1e-9))
        )
        if remaining_m > 0.0:
            self._applied_m = self._applied_m + difference_m * (step_m / remaining_m)
        return remaining_m - step_m
