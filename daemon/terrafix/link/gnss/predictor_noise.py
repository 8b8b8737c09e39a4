"""Statistics of the errors of two predictors of a receiver's offset, and the p-value of a combined error."""

from dataclasses import dataclass

PRIOR_SAMPLES = 6.0  # weight of the claimed variances as prior, in samples [tuned]
# Lower limits of the standard deviations, as shares of the claimed ones: a flight that was better than claimed so far
# may become as bad as claimed. The claim of the drift holds for a velocity error that is constant over the horizon;
# such an error is seldom more than half of it. [tuned]
MIN_POSITION_SCALE, MIN_DRIFT_SCALE = 0.8, 0.5
MAX_CORRELATION = 0.95  # upper limit of the correlation between the two errors [tuned]


@dataclass(frozen=True)
class PredictionErrors:
    """Errors of the predictor by position and of the one by drift (None: there is none), metres, east + j north; and
    the claimed 1-sigma per axis of each."""

    position_m: complex
    position_sigma_m: float
    drift_m: complex | None
    drift_sigma_m: float


class PredictorNoise:
    """Second moments of the errors in units of the claimed standard deviations, with exponential forgetting."""

    def __init__(self) -> None:
        self._samples = self._position = self._drift = self._cross = 0.0

    def update(self, errors: PredictionErrors, gain: float, keep: float) -> None:
        """``gain``: weight of this error in samples. ``keep``: share of the old statistics that remains."""
        if errors.drift_m is None:
            return
        position, drift = errors.position_m / errors.position_sigma_m, errors.drift_m / errors.drift_sigma_m
        self._samples = keep * (self._samples + gain)
        self._position = keep * (self._position + gain * abs(position) ** 2 / 2.0)
        self._drift = keep * (self._drift + gain * abs(drift) ** 2 / 2.0)
        self._cross = keep * (self._cross + gain * (position * drift.conjugate()).real / 2.0)

    def p_value(self, errors: PredictionErrors) -> tuple[float, float]:
        """-> (probability of an error at least as large, the combined error of both predictors [m]).

        The combination has the weights of least variance (Bates and Granger 1969). The error follows a bivariate
        Student t distribution, because its variance is estimated from few samples."""
        samples = PRIOR_SAMPLES + self._samples
        variance_m2 = errors.position_sigma_m**2 * max(
            MIN_POSITION_SCALE**2, (PRIOR_SAMPLES + self._position) / samples
        )
        error_m = errors.position_m
        if errors.drift_m is not None:
            drift_m2 = errors.drift_sigma_m**2 * max(MIN_DRIFT_SCALE**2, (PRIOR_SAMPLES + self._drift) / samples)
            cross_m2 = self._cross / samples * errors.position_sigma_m * errors.drift_sigma_m
            cross_m2 = min(MAX_CORRELATION * (variance_m2 * drift_m2) ** 0.5, max(0.0, cross_m2))
            weight = min(1.0, max(0.0, (variance_m2 - cross_m2) / (variance_m2 + drift_m2 - 2.0 * cross_m2)))
            error_m = (1.0 - weight) * error_m + weight * errors.drift_m
            variance_m2 = (
                (1.0 - weight) ** 2 * variance_m2 + weight**2 * drift_m2 + 2.0 * weight * (1.0 - weight) * cross_m2
            )
        return float((1.0 + abs(error_m) ** 2 / (variance_m2 * 2.0 * samples)) ** -samples), abs(error_m)
