"""Consistency of many flights: NEES and its chi-square band, coverage, false fixes, velocity, drift.

Errors of one flight are correlated in time, so N frames are not N
independent draws. The band is that of the effective number of draws, from the autocorrelation of the normalised
error."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from terrafix_lab.montecarlo.fault import DrawnFault
from terrafix_lab.montecarlo.flight import Record
from terrafix_lab.track import Track, measured
from terrafix_tools.score import COVERAGE_FLOORS, INSIDE, coverage, nees_band, nees_of

POSE95 = 12.592  # chi-square with 6 degrees of freedom, 95 %
NORMAL95 = 1.959964  # two-sided
MAX_SIGMAS = 4.0  # errors are limited to this for the correlation
MIN_DRIFT_PATH_M = 1000.0  # since the last map fix; a ratio over a shorter path has no meaning
CONFIDENCE = 0.95  # two-sided, with which a share is judged to be another one


@dataclass(frozen=True)
class Nees:
    mean: float
    low: float  # 95 % band of the mean for a consistent covariance
    high: float
    draws: float  # effective number of independent draws

    @property
    def holds(self) -> bool:
        return self.low <= self.mean <= self.high


def band(flights: Sequence[np.ndarray], draws: float, dimensions: int) -> Nees:
    """Mean over the frames of all flights (N,), and the 95 % band of a mean of ``draws`` independent draws."""
    values = np.concatenate(flights) if flights else np.zeros(0)
    return Nees(float(values.mean()) if len(values) else math.nan, *nees_band(draws, dimensions), draws)


def draws_in(flights: Sequence[np.ndarray]) -> float:
    """Effective number of independent draws in some flights together: each ``whitened`` (N, k), in order of time.

    The squares of a Gaussian process with correlation r have the correlation r squared. The mean of the errors is known
    to be zero and is not estimated, so that a constant error of a flight leaves one draw. One flight cannot distinguish
    a small constant from none, so that the correlation is estimated over all flights together."""
    longest = max((len(w) for w in flights), default=0)
    size = 1 << (2 * max(longest, 1) - 1).bit_length()
    products, pairs = np.zeros(longest), np.zeros(longest)
    for w in flights:
        length = np.linalg.norm(w, axis=1, keepdims=True)
        limited = w * np.minimum(1.0, MAX_SIGMAS / np.maximum(length, MAX_SIGMAS))  # one lost flight must not dominate
        spectrum = np.fft.rfft(limited, size, axis=0)
        n = len(w)
        products[:n] += np.fft.irfft((np.abs(spectrum) ** 2).sum(axis=1), size)[:n]
        pairs[:n] += np.arange(n, 0, -1)
    if longest < 2 or products[0] <= 0.0:
        return float(pairs[0]) if longest else 0.0
    r2 = (products / pairs / (products[0] / pairs[0])) ** 2
    noise = r2 < 4.0 / pairs  # indistinguishable from zero correlation
    first = int(np.argmax(noise)) if noise.any() else longest
    share = pairs[1:first] / pairs[0]  # of the frames that have another one at this lag
    return float(pairs[0] / (1.0 + 2.0 * float((r2[1:first] * share).sum())))


def whitened(error: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """(N, k): the error in units of its 1-sigma, uncorrelated."""
    return np.linalg.solve(np.linalg.cholesky(cov), error[..., None])[..., 0]


@dataclass(frozen=True)
class FlightResult:
    """Errors and consistency of one flight."""

    record: Record
    distance_m: np.ndarray  # (N,) horizontal error
    nees: np.ndarray  # (N,) of the position on earth
    map_nees: np.ndarray  # (N,) of the position on the map: without the error of the map and its variance
    pose_nees: np.ndarray  # (N,) of the pose, six dimensions
    whitened: tuple[np.ndarray, np.ndarray, np.ndarray]  # errors of these three

    @classmethod
    def of(cls, record: Record) -> "FlightResult":
        error, cov = record.error_m, record.cov
        placed = record.anchor_age_ms >= 0
        map_cov = cov[:, :2, :2] - (placed * record.plan.map_sigma_m**2)[:, None, None] * np.eye(2)
        on_map = error[:, :2] - np.array(record.plan.map_offset_m)
        flights = ((error[:, :2], cov[:, :2, :2]), (on_map, map_cov), (error, cov))
        nees = [nees_of(e, c) for e, c in flights]
        white = [whitened(e[s], c[s]) for (e, c), s in zip(flights, map(np.isfinite, nees), strict=True)]
        return cls(record, np.hypot(*error[:, :2].T), nees[0], nees[1], nees[2], (white[0], white[1], white[2]))

    @property
    def track(self) -> Track:
        sigma_m = np.sqrt(np.linalg.eigvalsh(self.record.cov[:, :2, :2])[:, 1])
        return Track(self.record.t_s, self.distance_m, self.nees, sigma_m, self.record.lie)

    def refined_nees(self) -> np.ndarray:
        """(M,) of the frames that were refined."""
        nees = ((self.record.refined_error_m / self.record.refined_sigma_m) ** 2).sum(axis=1)
        return np.asarray(nees[np.isfinite(nees)])

    def smoothed_nees(self) -> np.ndarray:
        """(M,) of the frames that the smoother has refined in flight, two degrees of freedom."""
        error_m, cov = self.record.smoothed_error_m, self.record.smoothed_cov
        refined = np.isfinite(error_m).all(axis=1)
        return nees_of(error_m[refined], cov[refined])

    def velocity_share(self) -> np.ndarray:
        """(2N,) horizontal velocity errors in units of their 1-sigma."""
        return np.asarray((self.record.velocity_error_mps[:, :2] / self.record.velocity_sigma_mps[:, None]).ravel())

    def drift(self) -> float | None:
        """Error since the last map fix over the path since then; None for a flight with a map or a short path."""
        fixed = np.flatnonzero(self.record.anchor_age_ms == 0)
        if self.record.plan.fault is not DrawnFault.DRIFT or not len(fixed):
            return None
        path_m = float(self.record.path_m[-1] - self.record.path_m[fixed[-1]])
        grown = self.record.error_m[-1, :2] - self.record.error_m[fixed[-1], :2]
        return float(np.hypot(*grown)) / path_m if path_m >= MIN_DRIFT_PATH_M else None


def parts(flights: list[FlightResult]) -> dict[str, float]:
    """Mean squared error over its published variance, by quantity: 1 when consistent. The variance of a velocity is
    that of its worst direction."""
    ratio = np.concatenate([f.record.error_m**2 / np.einsum("nii->ni", f.record.cov) for f in flights])
    velocity = np.concatenate([f.velocity_share() for f in flights])
    numbers = {"east_north": ratio[:, :2], "up": ratio[:, 2], "tilt": ratio[:, 3:5], "heading": ratio[:, 5]}
    return {name: float(np.mean(values)) for name, values in {**numbers, "velocity": velocity**2}.items()}


def summary(flights: list[FlightResult]) -> dict[str, Any]:
    """Row of the table: over all frames of some flights."""
    tracks = [f.track for f in flights]
    false = [track.is_false().sum() for track in tracks]
    nees = np.concatenate([f.nees for f in flights])
    refined = np.concatenate([f.refined_nees() for f in flights])
    smoothed = np.concatenate([f.smoothed_nees() for f in flights])
    smoothed_m = np.concatenate([np.hypot(*f.record.smoothed_error_m.T) for f in flights])
    smoothed_m = smoothed_m[np.isfinite(smoothed_m)]
    on_map = np.concatenate([f.map_nees for f in flights])
    pose = np.concatenate([f.pose_nees for f in flights])
    distance = np.concatenate([f.distance_m for f in flights])
    refined_m = np.concatenate([np.hypot(*f.record.refined_error_m.T) for f in flights])
    refined_m = refined_m[np.isfinite(refined_m)]
    velocity = np.abs(np.concatenate([f.velocity_share() for f in flights]))
    cpu = np.concatenate([f.record.cpu_ms for f in flights])
    bands = [
        band([getattr(f, name) for f in flights], draws_in([f.whitened[i] for f in flights]), size)
        for i, (name, size) in enumerate((("nees", 2), ("map_nees", 2), ("pose_nees", 6)))
    ]
    drifts = [d for f in flights if (d := f.drift()) is not None]
    return {
        "flights": len(flights),
        "frames": len(nees),
        "median_m": float(np.median(distance)),
        "p95_m": float(np.percentile(distance, 95)),
        "max_m": float(distance.max()),
        "refined_median_m": float(np.median(refined_m)) if len(refined_m) else None,
        "smoothed_median_m": float(np.median(smoothed_m)) if len(smoothed_m) else None,
        "false_fixes": int(sum(false)),
        "late_false_fixes": int(sum(track.is_late().sum() for track in tracks)),
        "criteria": measured(tracks),
        "notice_s": max((s for track in tracks if (s := track.notice_s()) is not None), default=None),
        "flights_with_false_fixes": int(sum(count > 0 for count in false)),
        "coverage": coverage(nees),
        "coverage_refined": coverage(refined),
        "coverage_smoothed": coverage(smoothed),
        "nees_smoothed": float(np.mean(smoothed)) if len(smoothed) else None,
        "coverage_on_map": coverage(on_map),
        "coverage_pose": coverage(pose, POSE95),
        "nees": _row(bands[0]),
        "nees_on_map": _row(bands[1]),
        "nees_pose": _row(bands[2]),
        "parts": parts(flights),
        "velocity_coverage": float((velocity <= NORMAL95).mean()),
        "velocity_share_p95": float(np.percentile(velocity, 95)),
        "velocity_rms_mps": float(
            np.sqrt(np.mean([(f.record.velocity_error_mps[:, :2] ** 2).mean() for f in flights]))
        ),
        "velocity_sigma_median_mps": float(np.median(np.concatenate([f.record.velocity_sigma_mps for f in flights]))),
        "drift_median": float(np.median(drifts)) if drifts else None,
        "drift_p95": float(np.percentile(drifts, 95)) if drifts else None,
        "cpu_ms_median": float(np.median(cpu)),
        "cpu_ms_p99": float(np.percentile(cpu, 99)),
        "smoother_cpu_share_max": max(f.record.smoother_cpu_s / f.record.plan.duration_s for f in flights),
        "refine_cpu_s_max": max(f.record.refine_cpu_s for f in flights),
        "rebuilds": sum(f.record.rebuilds for f in flights),
        "restarts": sum(f.record.restarts for f in flights),
    }


def _row(nees: Nees) -> dict[str, float | bool]:
    return {"mean": nees.mean, "low": nees.low, "high": nees.high, "draws": nees.draws, "holds": nees.holds}


def floors(total: dict[str, Any]) -> dict[str, bool | None]:
    """Text of each floor -> whether it holds; None: the flights are too few to judge it."""
    draws = total["nees"]["draws"]
    sure = 3.0 / total["flights"]  # rule of three: the rate that no case in so many leaves possible, 95 % confidence
    return {
        "95 % ellipse holds 93 to 98 % of the positions": _covers(total["coverage"], draws),
        "95 % ellipse holds 93 to 98 % of the refined positions": _covers(total["coverage_refined"], draws),
        "no false fix (beyond 50 m and 3 sigma) but at the beginning of a false input "
        f"(none in {total['flights']} flights: in less than {min(1.0, sure):.1%} of all)": total["late_false_fixes"]
        == 0,
        "mean NEES of the position in its 95 % band": total["nees"]["holds"],
    }


def _covers(share: float | None, draws: float) -> bool | None:
    """Whether ``share`` of the positions is what the floor wants. A share outside counts only where a consistent
    covariance, which has 95 % inside, would have one as far off in fewer than 5 % of such samples (binomial)."""
    low, high = COVERAGE_FLOORS
    if share is None:
        return None
    if low <= share <= high:
        return True
    outside, count = (1.0 - share) * draws, max(1, round(draws))
    chances = [math.comb(count, k) * (1.0 - INSIDE) ** k * INSIDE ** (count - k) for k in range(count + 1)]
    tail = sum(chances[math.ceil(outside - 1e-9) :]) if share < low else sum(chances[: math.floor(outside + 1e-9) + 1])
    return None if tail > 0.5 * (1.0 - CONFIDENCE) else False
