"""The score of a flight: errors, false fixes and when they are late, coverage and NEES of the claims, gaps, quantiles.

Every table and verdict takes these numbers from here, so that a name has one meaning. NEES: normalised estimation error
squared, the squared Mahalanobis distance of the error in the published covariance. Its mean is the number of dimensions
when the covariance is consistent (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and
Navigation", 2001, 5.4)."""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from terrafix.core.gate import CHI2_95

LIMITS_M = (5, 10, 20, 50)
FALSE_FIX_ERROR_M = 50.0
# "> 3 sigma": the squared Mahalanobis distance under the reported covariance exceeds 3^2
FALSE_FIX_SIGMAS = 3.0
# From the start of a false input: in this time, or in so many frames if these take longer, a false fix is not late.
ALLOWED_S, ALLOWED_FRAMES = 3.0, 5
COVERAGE_FLOORS = (0.93, 0.98)  # AC-13: share of the truth inside the 95 % ellipse
INSIDE = 0.95  # the same of a consistent covariance


def nees_of(error: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """(N, k), (N, k, k) -> (N,); inf where ``cov`` is not positive definite, or one of both is not finite."""
    out = np.full(len(error), math.inf)
    valid = np.isfinite(cov).all(axis=(1, 2)) & np.isfinite(error).all(axis=1)
    valid[valid] &= np.linalg.eigvalsh(cov[valid])[:, 0] > 0.0
    out[valid] = np.einsum("ni,ni->n", error[valid], np.linalg.solve(cov[valid], error[valid][..., None])[..., 0])
    return out


def coverage(nees: np.ndarray, limit: float = CHI2_95) -> float | None:
    """Share of the truth inside the claimed 95 % ellipse, whose squared size is ``limit``; None without estimates."""
    return float((nees <= limit).mean()) if len(nees) else None


def nees_band(draws: float, dimensions: int = 2, confidence: float = 0.95) -> tuple[float, float]:
    """Band of the mean of ``draws`` independent NEES of a consistent covariance, which holds this share of the means,
    the same outside on both sides. At least one degree of freedom in all."""
    freedom, tail = max(draws * dimensions, 1.0), 0.5 * (1.0 - confidence)
    low, high = (dimensions / freedom * _chi2_quantile(freedom, share) for share in (tail, 1.0 - tail))
    return low, high


def _chi2_quantile(freedom: float, share: float) -> float:
    """By bisection."""
    low, high = 0.0, freedom + 40.0 * math.sqrt(freedom)
    for _ in range(60):
        value = 0.5 * (low + high)
        low, high = (value, high) if _chi2_distribution(freedom, value) < share else (low, value)
    return 0.5 * (low + high)


def _chi2_distribution(freedom: float, value: float) -> float:
    """Series of the incomplete gamma function (Abramowitz and Stegun 1964, 6.5.29)."""
    order, half = 0.5 * freedom, 0.5 * value
    term = total = math.exp(order * math.log(half) - half - math.lgamma(order + 1.0))
    while term > 1e-16 * total:
        order += 1.0
        term *= half / order
        total += term
    return total


def is_false_fix(error_m: np.ndarray, nees: np.ndarray, beyond_m: float = FALSE_FIX_ERROR_M) -> np.ndarray:
    """(N,) horizontal errors and their NEES -> (N,) bool: beyond ``beyond_m`` and 3 sigma of the claim. A frame without
    a position (nan) is not false."""
    return np.asarray((error_m > beyond_m) & (nees > FALSE_FIX_SIGMAS**2))


def late_from_s(times_s: Sequence[float], start_s: float) -> float:
    """End of the time after the start of a false input in which a false fix is not late; ``times_s``: of the frames."""
    first = [t_s for t_s in times_s if t_s >= start_s][:ALLOWED_FRAMES]
    return max([start_s + ALLOWED_S, *first[-1:]])


def error_summary(errors_m: Sequence[float], frames: int, prefix: str = "") -> dict[str, float | None]:
    """Shares of ``frames`` within LIMITS_M, median, 95 % quantile and largest error; keys begin with ``prefix``."""
    out: dict[str, float | None] = {
        f"{prefix}within_{limit}m": sum(e <= limit for e in errors_m) / frames for limit in LIMITS_M
    }
    out[f"{prefix}median_m"] = float(np.median(errors_m)) if len(errors_m) else None
    out[f"{prefix}p95_m"] = float(np.percentile(errors_m, 95)) if len(errors_m) else None
    out[f"{prefix}max_m"] = float(max(errors_m)) if len(errors_m) else None
    return out


def longest_gap_s(times_s: Sequence[float], from_s: float, to_s: float) -> float:
    """Longest time without one of ``times_s``, in order, between two times."""
    times = [from_s, *(t_s for t_s in times_s if from_s <= t_s <= to_s), to_s]
    return max(b - a for a, b in pairwise(times))


def quantile(values: Sequence[float], share: float) -> float | None:
    """Nearest rank quantile; None without values."""
    if not values:
        return None
    return sorted(values)[max(0, math.ceil(share * len(values)) - 1)]
