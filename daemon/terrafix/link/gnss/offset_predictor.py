"""Where a receiver should be against our estimate, by where it was so far in this flight.

Most of their disagreement stays for a flight, or comes and goes in minutes: the map's own error, the receiver's. A
drag-off shows long before it is larger than all of that. So the offset is forecast LAG_S ahead, in two ways:

* by what it was: a first-order autoregression about its mean (Box and Jenkins, Time Series Analysis, 3.2), which errs
  as our position does;
* by what it was then and the receiver's slip since: how much further it has moved than our velocity says, which should
  be nothing, and errs as our velocity does.

A drag-off is in the errors of both, in full, and little else is. They are combined with the weights that leave the
least variance (Bates and Granger, The combination of forecasts, 1969), and the error of that is judged by the errors of
earlier forecasts. What both sides claim is the prior of their variance, so that the chance of an error is that of a
bivariate Student t (Gelman et al., Bayesian Data Analysis, 3.2), and little is accused that little is known of.
Constants were chosen on flights of other seeds than those of docs/autopilot.md, "The GNSS judge"."""

from collections import deque
from dataclasses import dataclass

from terrafix.link.gnss.predictor_noise import Errors, Scatter

SAMPLE_S = 1.0
SMOOTH_S = 2.0  # the offset is averaged over so long: readings and estimates are noisy
LAG_S = 30.0  # nothing that is younger is learnt: a drag-off must not become what is usual
MEMORY_S = 600.0  # of the mean
FORGET_S = 1800.0  # of how good forecasts are
INDEPENDENT_S = 15.0  # errors so far apart count as one sample each
RIDGE = 10.0  # keeps the coefficient at zero (forecast: the mean) until the flight has shown another
VAGUER = 1.3  # a forecast from an offset that was claimed so much worse than now is none


@dataclass(frozen=True)
class _Past:
    """A sample that is not learnt yet. Offsets are complex: metres east, and north as the imaginary part."""

    offset_m: complex
    variance_m2: float
    slipped_m: complex  # by then, since the beginning
    from_m: complex  # the offset that it was forecast from
    mean_m: complex  # as it was then
    errors: Errors | None  # of that forecast


class OffsetForecast:
    """``take`` every offset of receiver and estimate; ``pause`` when there is none, or none to learn from."""

    def __init__(self) -> None:
        self._offset_m = self._slipped_m = 0j  # now, smoothed
        self._slip_m = 0j  # all of it, as it came
        self._variance_m2 = 0.0
        self._smooth = False
        self._mean_m = 0j
        self._weight = 0.0
        self._scatter = Scatter()
        self._xx = self._xy = 0.0  # of the regression
        self._past: deque[_Past] = deque()
        self._since_s = 0.0

    def take(
        self, offset_m: complex, sigma_m: float, slip_m: complex, slip_sigma_m: float, dt_s: float, *, learn: bool
    ) -> tuple[float, float | None]:
        """``offset_m``: east + j north; ``slip_m``: in the ``dt_s`` since the last one. ``sigma_m``: 1-sigma per axis
        of the offset, ``slip_sigma_m``: of the slip in LAG_S, both as claimed.

        -> (chance of being so far from the forecast, the distance [m]); (1, None): there is no forecast yet."""
        share = min(1.0, dt_s / SMOOTH_S) if self._smooth else 1.0
        self._smooth = True
        self._slip_m += slip_m
        self._offset_m += share * (offset_m - self._offset_m)
        self._slipped_m += share * (self._slip_m - self._slipped_m)
        self._variance_m2 += share * (sigma_m**2 - self._variance_m2)
        variance_m2 = max(sigma_m**2, self._variance_m2)  # after a vague stretch the average is vague for a while
        from_m = self._from(variance_m2)
        forecast_m = self._mean_m + self._coefficient() * (from_m - self._mean_m)
        slipped_m = self._slipped_m - self._past[0].slipped_m if self._is_full() else None
        errors = Errors(self._offset_m - forecast_m, variance_m2**0.5, slipped_m, slip_sigma_m)
        known = self._weight > 0.0
        self._since_s += dt_s
        if learn and self._since_s >= SAMPLE_S:
            self._since_s = 0.0
            past = _Past(self._offset_m, variance_m2, self._slipped_m, from_m, self._mean_m, errors if known else None)
            self._past.append(past)
            if len(self._past) > LAG_S / SAMPLE_S:
                self._learn(self._past.popleft())
        return self._scatter.chance(errors) if known else (1.0, None)

    def pause(self) -> None:
        self._past.clear()
        self._smooth = False

    def _is_full(self) -> bool:
        return len(self._past) >= LAG_S / SAMPLE_S

    def _from(self, variance_m2: float) -> complex:
        """The offset LAG_S ago; without one that is good enough the mean."""
        if not self._is_full() or self._past[0].variance_m2 > VAGUER**2 * variance_m2:
            return self._mean_m
        return self._past[0].offset_m

    def _coefficient(self) -> float:
        return min(1.0, max(0.0, self._xy / (self._xx + RIDGE)))

    def _learn(self, past: _Past) -> None:
        gain, keep = SAMPLE_S / INDEPENDENT_S, 1.0 - SAMPLE_S / FORGET_S
        if past.errors is not None:
            x, y = past.from_m - past.mean_m, past.offset_m - past.mean_m
            self._scatter.learn(past.errors, gain, keep)
            self._xx = keep * (self._xx + gain * abs(x) ** 2 / past.variance_m2)
            self._xy = keep * (self._xy + gain * (x * y.conjugate()).real / past.variance_m2)
        weight = 1.0 / past.variance_m2
        self._weight = self._weight * (1.0 - SAMPLE_S / MEMORY_S) + weight
        self._mean_m += weight / self._weight * (past.offset_m - self._mean_m)
