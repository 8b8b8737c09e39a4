"""How good two forecasts of a receiver's offset were in this flight, and what an error of both together is worth."""

from dataclasses import dataclass

PRIOR_SAMPLES = 6.0  # that the claims are worth
# Shares of the claims: a flight that was better than claimed so far may become as bad as claimed. The claim of the slip
# is that of a velocity that is wrong by the same amount for all of the time; such an error is seldom more than half of
# it.
LEAST_SCALE, LEAST_SLIP_SCALE = 0.8, 0.5
MOST_ALIKE = 0.95  # of the correlation of both errors


@dataclass(frozen=True)
class Errors:
    """Of the forecast by position and of the one by slip (None: there is none), metres east + j north; with what is
    claimed, 1-sigma per axis."""

    position_m: complex
    position_sigma_m: float
    slip_m: complex | None
    slip_sigma_m: float


class Scatter:
    """Second moments of the errors, in units of what is claimed."""

    def __init__(self) -> None:
        self._samples = self._position = self._slip = self._both = 0.0

    def learn(self, errors: Errors, gain: float, keep: float) -> None:
        """``gain``: samples that this one counts for; ``keep``: share of the old ones that is not forgotten."""
        if errors.slip_m is None:
            return
        position, slip = errors.position_m / errors.position_sigma_m, errors.slip_m / errors.slip_sigma_m
        self._samples = keep * (self._samples + gain)
        self._position = keep * (self._position + gain * abs(position) ** 2 / 2.0)
        self._slip = keep * (self._slip + gain * abs(slip) ** 2 / 2.0)
        self._both = keep * (self._both + gain * (position * slip.conjugate()).real / 2.0)

    def chance(self, errors: Errors) -> tuple[float, float]:
        """-> (chance of errors so large, the error of both forecasts together [m])."""
        samples = PRIOR_SAMPLES + self._samples
        variance_m2 = errors.position_sigma_m**2 * max(LEAST_SCALE**2, (PRIOR_SAMPLES + self._position) / samples)
        error_m = errors.position_m
        if errors.slip_m is not None:
            slip_m2 = errors.slip_sigma_m**2 * max(LEAST_SLIP_SCALE**2, (PRIOR_SAMPLES + self._slip) / samples)
            both_m2 = self._both / samples * errors.position_sigma_m * errors.slip_sigma_m
            both_m2 = min(MOST_ALIKE * (variance_m2 * slip_m2) ** 0.5, max(0.0, both_m2))
            weight = min(1.0, max(0.0, (variance_m2 - both_m2) / (variance_m2 + slip_m2 - 2.0 * both_m2)))
            error_m = (1.0 - weight) * error_m + weight * errors.slip_m
            variance_m2 = (
                (1.0 - weight) ** 2 * variance_m2 + weight**2 * slip_m2 + 2.0 * weight * (1.0 - weight) * both_m2
            )
        return float((1.0 + abs(error_m) ** 2 / (variance_m2 * 2.0 * samples)) ** -samples), abs(error_m)
