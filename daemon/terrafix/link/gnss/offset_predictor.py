"""Predicts the offset of a receiver from our estimate out of the offsets of this flight, to detect a drag-off.

Most of the offset is constant over a flight or varies over minutes: the map's own error, and that of the receiver. A
drag-off is detectable long before it exceeds these. The offset is predicted over HORIZON_S in two ways:

* by position: a first-order autoregression about the mean offset (Box and Jenkins, Time Series Analysis, 3.2). Its
  error behaves like that of our position;
* by drift: the offset at the start of the horizon plus the receiver's drift since. The drift is its displacement minus
  the integral of our velocity, and should be zero. Its error behaves like that of our velocity.

A drag-off appears in both errors in full; little else does. They are combined with the weights of least variance (Bates
and Granger, The combination of forecasts, 1969), and the combined error is compared with earlier errors of this flight.
The claims of both sides are the prior of the variance, so that the error follows a bivariate Student t distribution
(Gelman et al., Bayesian Data Analysis, 3.2): with few samples an alarm needs a large error. The constants were chosen
on flights of other seeds than those of docs/autopilot.md, "The spoofing detector"."""

from collections import deque
from dataclasses import dataclass

from terrafix.link.gnss.predictor_noise import PredictionErrors, PredictorNoise

SAMPLE_S = 1.0  # s between samples [tuned]
SMOOTHING_S = 2.0  # s; time constant of the low-pass of the offset, against noise of readings and estimates [tuned]
HORIZON_S = 30.0  # s; younger samples are not learnt, so that a drag-off does not enter the statistics [tuned]
MEAN_MEMORY_S = 600.0  # s; memory of the mean offset [tuned]
STATISTICS_MEMORY_S = 1800.0  # s; memory of the error statistics [tuned]
DECORRELATION_S = 15.0  # s; errors that are so far apart count as one independent sample each [tuned]
# Ridge term of the regression, in samples: keeps the coefficient near zero (prediction: the mean) at first. [tuned]
OFFSET_RIDGE = 10.0
MAX_OFFSET_SIGMA_RATIO = 1.3  # claimed sigma of a past offset over the present one, above which it is not used [tuned]


@dataclass(frozen=True)
class _PendingSample:
    """A sample that is younger than HORIZON_S and not learnt yet. Offsets are complex: metres, east + j north."""

    offset_m: complex
    variance_m2: float
    drift_m: complex  # sum since the first reading
    reference_m: complex  # offset from which it was predicted
    mean_m: complex  # mean offset at its time
    errors: PredictionErrors | None  # of its prediction


class OffsetPredictor:
    """``update`` with every offset of the receiver; ``clear_pending`` when there is none, or none to learn from."""

    def __init__(self) -> None:
        self._offset_m = self._drift_m = 0j  # present values after the low-pass
        self._raw_drift_m = 0j  # sum before the low-pass
        self._variance_m2 = 0.0
        self._filter_started = False
        self._mean_m = 0j
        self._weight = 0.0
        self._noise = PredictorNoise()
        self._xx = self._xy = 0.0  # sums of the regression
        self._pending: deque[_PendingSample] = deque()
        self._since_sample_s = 0.0

    def update(
        self, offset_m: complex, sigma_m: float, drift_m: complex, drift_sigma_m: float, dt_s: float, *, learn: bool
    ) -> tuple[float, float | None]:
        """``offset_m``: receiver minus estimate, east + j north. ``sigma_m``: its claimed 1-sigma per axis.
        ``drift_m``: drift in the ``dt_s`` since the last call. ``drift_sigma_m``: claimed 1-sigma per axis of the drift
        in HORIZON_S.

        -> (p-value of the prediction error, its length [m]); (1, None) while there is no prediction."""
        share = min(1.0, dt_s / SMOOTHING_S) if self._filter_started else 1.0
        self._filter_started = True
        self._raw_drift_m += drift_m
        self._offset_m += share * (offset_m - self._offset_m)
        self._drift_m += share * (self._raw_drift_m - self._drift_m)
        self._variance_m2 += share * (sigma_m**2 - self._variance_m2)
        # After an interval with a large sigma the low-pass still contains offsets of that interval.
        variance_m2 = max(sigma_m**2, self._variance_m2)
        reference_m = self._reference_offset(variance_m2)
        predicted_m = self._mean_m + self._coefficient() * (reference_m - self._mean_m)
        horizon_drift_m = self._drift_m - self._pending[0].drift_m if self._covers_horizon() else None
        errors = PredictionErrors(self._offset_m - predicted_m, variance_m2**0.5, horizon_drift_m, drift_sigma_m)
        has_mean = self._weight > 0.0
        self._since_sample_s += dt_s
        if learn and self._since_sample_s >= SAMPLE_S:
            self._since_sample_s = 0.0
            sample = _PendingSample(
                self._offset_m, variance_m2, self._drift_m, reference_m, self._mean_m, errors if has_mean else None
            )
            self._pending.append(sample)
            if len(self._pending) > HORIZON_S / SAMPLE_S:
                self._learn(self._pending.popleft())
        return self._noise.p_value(errors) if has_mean else (1.0, None)

    def clear_pending(self) -> None:
        """Drops the samples that are not learnt yet, and restarts the low-pass."""
        self._pending.clear()
        self._filter_started = False

    def _covers_horizon(self) -> bool:
        return len(self._pending) >= HORIZON_S / SAMPLE_S

    def _reference_offset(self, variance_m2: float) -> complex:
        """The offset HORIZON_S ago; the mean when there is none, or none that is accurate enough."""
        if not self._covers_horizon() or self._pending[0].variance_m2 > MAX_OFFSET_SIGMA_RATIO**2 * variance_m2:
            return self._mean_m
        return self._pending[0].offset_m

    def _coefficient(self) -> float:
        """Coefficient of the autoregression, 0 to 1."""
        return min(1.0, max(0.0, self._xy / (self._xx + OFFSET_RIDGE)))

    def _learn(self, sample: _PendingSample) -> None:
        gain, keep = SAMPLE_S / DECORRELATION_S, 1.0 - SAMPLE_S / STATISTICS_MEMORY_S
        if sample.errors is not None:
            x, y = sample.reference_m - sample.mean_m, sample.offset_m - sample.mean_m
            self._noise.update(sample.errors, gain, keep)
            self._xx = keep * (self._xx + gain * abs(x) ** 2 / sample.variance_m2)
            self._xy = keep * (self._xy + gain * (x * y.conjugate()).real / sample.variance_m2)
        weight = 1.0 / sample.variance_m2
        self._weight = self._weight * (1.0 - SAMPLE_S / MEAN_MEMORY_S) + weight
        self._mean_m += weight / self._weight * (sample.offset_m - self._mean_m)
