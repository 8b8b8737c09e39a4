"""Correlation of two series of body rates at all lags, and whether its best lag is a coincidence."""

import math
from dataclasses import dataclass

import numpy as np

from terrafix.core.clock import MAX_CLOCK_DRIFT

MIN_OVERLAP_S = 30.0  # at a lag, or half of the shorter series [tuned]
# rates beyond this many robust sigmas count as that: one flip must not be all of the correlation [tuned]
CLIP_SIGMAS = 5.0
PEAK_WIDTH_S = 3.0  # the second best lag is further than this from the best [tuned]
ORDER = 4  # cells of the past from which a rate is predicted [tuned]
NOISE_SHARE = 0.01  # of the variance of the rates: noise of the attitude and of its times [tuned]
FALSE_ALARM = 1e-3  # probability that another flight passes each of the two tests here; the fit has its own [tuned]
ROBUST = 1.4826  # standard deviation of a Gaussian over its median absolute deviation

Rates = tuple[float, np.ndarray, np.ndarray]  # start [s], (N, 3) [rad/s] in cells, known (N,)


@dataclass(frozen=True)
class LagPeak:
    """The best lag.

    Lags are ranked by the score sum(x y) / sqrt(sum(x^2 y^2)): of two series that have nothing to do with each other,
    however unevenly they move, it is Gaussian about 0 at every lag. Its standard deviation (1 for white series) is
    measured on the other lags of the same pair, so that slow and repeated manoeuvres count as what they are. ``sigma``
    and ``second`` are on the scale of the correlation at the best lag. As a correlation ends at 1, both tests are of
    its Fisher transform atanh, whose standard deviation is ``sigma``."""

    offset_s: float  # second series less first, in the middle of the first
    drift: float
    correlation: float  # at the best lag
    second: float  # at the next best one
    sigma: float  # standard deviation of the correlation at wrong lags
    lags: int  # that were tried, over all drifts

    @property
    def needed(self) -> float:
        """Least correlation that is no coincidence."""
        return math.tanh(needed_height(self.sigma, self.lags))

    @property
    def distinct(self) -> bool:
        best, second = (math.atanh(min(r, 1.0 - 1e-9)) for r in (self.correlation, max(self.second, 0.0)))
        return self.correlation >= self.needed and best - second >= needed_lead(self.sigma, self.lags)


def needed_height(sigma: float, lags: int) -> float:
    """What the best of ``lags`` wrong lags exceeds with the probability FALSE_ALARM at most: Gaussian tail
    exp(-z^2 / 2) (Chernoff bound), times the number of lags (union bound)."""
    return sigma * math.sqrt(2.0 * math.log(max(lags, 2) / FALSE_ALARM))


def needed_lead(sigma: float, lags: int) -> float:
    """The lead of the best over the second of ``lags`` wrong lags that is exceeded with the probability FALSE_ALARM:
    the spacing of the two largest Gaussian values is exponential with mean sigma / sqrt(2 ln lags) (Gumbel domain)."""
    return sigma * math.log(1.0 / FALSE_ALARM) / math.sqrt(2.0 * math.log(max(lags, 2)))


def correlate(first: Rates, second: Rates, cell_s: float) -> LagPeak:
    """Tries all lags with enough overlap, and drifts that move the ends of the first series by a cell each."""
    filters = _whitening([first, second])
    (x, known_x), (y, known_y) = (_whitened(rates, filters) for rates in (first, second))
    known = [known_x.astype(float), known_y.astype(float)]
    lags = np.arange(-len(x) + 1, len(y))
    by_lag = _Correlator(len(x), len(y))
    overlap = by_lag(known[0], known[1])
    energy = by_lag(x**2, known[1][:, None]) * by_lag(known[0][:, None], y**2)
    both = by_lag(x**2, y**2)
    usable = overlap >= min(MIN_OVERLAP_S / cell_s, 0.5 * known[0].sum(), 0.5 * known[1].sum()) - 0.5
    ends = MAX_CLOCK_DRIFT * 0.5 * len(x)  # cells by which the largest drift moves the ends
    drifts = np.linspace(-MAX_CLOCK_DRIFT, MAX_CLOCK_DRIFT, 2 * math.ceil(ends) + 1) if ends > 0.5 else np.zeros(1)
    tried = []
    for drift in drifts:
        product = by_lag(_stretched(x, float(drift)), y)
        score = np.where(usable & (both > 1e-9 * both.max()), product / np.sqrt(np.maximum(both, 1e-12)), 0.0)
        tried.append((float(score.max()), float(drift), score, product))
    _, drift, score, product = max(tried, key=lambda one: one[0])
    at = int(np.argmax(score))
    others = score[usable & (np.abs(lags - lags[at]) * cell_s > PEAK_WIDTH_S)]
    correlation = float(product[at] / math.sqrt(max(energy[at], 1e-12)))
    scale = correlation / max(float(score[at]), 1e-12)
    return LagPeak(
        offset_s=second[0] - first[0] + cell_s * (float(lags[at]) + _vertex(score, at)),
        drift=drift,
        correlation=correlation,
        second=scale * float(others.max()) if others.size else 0.0,
        sigma=scale * ROBUST * float(np.median(np.abs(others))) if others.size else math.inf,
        lags=int(usable.sum()) * len(drifts),
    )


class _Correlator:
    """sum over k and axes of a[k] b[k + lag], for the lags from -(len(a) - 1) to len(b) - 1."""

    def __init__(self, first: int, second: int) -> None:
        self._size = 1 << (first + second - 1).bit_length()
        self._lags = np.arange(-first + 1, second)

    def __call__(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        spectra = [np.fft.rfft(v.reshape(len(v), -1), self._size, axis=0) for v in (a, b)]
        product = np.sum(np.conj(spectra[0]) * spectra[1], axis=1)
        return np.fft.irfft(product, self._size)[self._lags]


def clipped(rates: np.ndarray) -> np.ndarray:
    """Rates (N, 3) less their median, clipped. All axes keep their unit: the one that moves most counts most."""
    values = rates - np.median(rates, axis=0)
    sigma = np.maximum(ROBUST * np.median(np.abs(values), axis=0), 0.2 * np.sqrt(np.mean(values**2, axis=0)))
    return np.clip(values, -CLIP_SIGMAS * sigma, CLIP_SIGMAS * sigma)


def _filled(rates: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Clipped rates, 0 where unknown."""
    found = np.zeros_like(rates)
    found[known] = clipped(rates[known])
    return found


def _whitening(series: list[Rates]) -> np.ndarray:
    """Coefficients (ORDER, 3) of the linear prediction of each axis from its past, from the autocovariance of both
    series (Yule-Walker), with NOISE_SHARE of white noise so that frequencies without motion are not amplified."""
    filled = [_filled(rates, known) for _, rates, known in series]
    coefficients = np.zeros((ORDER, 3))
    for axis in range(3):
        lagged = [sum(float(v[k:, axis] @ v[: len(v) - k, axis]) for v in filled) for k in range(ORDER + 1)]
        covariance = np.array([[lagged[abs(i - j)] for j in range(ORDER)] for i in range(ORDER)])
        covariance += np.eye(ORDER) * (NOISE_SHARE * lagged[0] + 1e-12)
        coefficients[:, axis] = np.linalg.solve(covariance, np.array(lagged[1:]))
    return coefficients


def _whitened(rates: Rates, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> rates less their prediction from the past (N, 3), 0 where unknown, and which are known (N,)."""
    _, values, known = rates
    filled = _filled(values, known)
    white, there = filled.copy(), known.copy()
    for k in range(1, ORDER + 1):
        white[k:] -= coefficients[k - 1] * filled[:-k]
        there[k:] &= known[:-k]
        there[:k] = False
    return _filled(white, there), there


def _stretched(x: np.ndarray, drift: float) -> np.ndarray:
    """The cells as a clock with that drift about the middle counts them."""
    middle = 0.5 * len(x)
    at = np.round(middle + (np.arange(len(x)) - middle) / (1.0 + drift))
    return x[np.clip(at, 0, len(x) - 1).astype(int)]


def _vertex(score: np.ndarray, at: int) -> float:
    """Where between the cells the maximum is, by the parabola through it and its neighbours: -0.5 to 0.5."""
    if not 0 < at < len(score) - 1:
        return 0.0
    low, top, high = score[at - 1], score[at], score[at + 1]
    bend = low - 2.0 * top + high
    return float(np.clip(0.5 * (low - high) / bend, -0.5, 0.5)) if bend < 0 else 0.0
