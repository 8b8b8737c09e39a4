"""Offset and drift between the clock of a flight record and that of an autopilot's log, from the attitude in both.

Both hold the attitude of one autopilot: the log as written on board, the record as received by telemetry. At the time t
of the record, the log's clock reads t + offset + drift (t - middle of the record).

1. Each attitude gives mean body rates in the cells of a common grid, by the rotation from one grid point to the next:
   without aliasing at any sampling rate, and without gyroscope noise. Cells in gaps are unknown.
2. The three rates are correlated at all lags (FFT) and for all drifts up to MAX_DRIFT (correlation.py). The best lag
   must be no coincidence.
3. Windows of the record get an offset each, by Gauss-Newton on the rotation between the two attitudes, with the
   constant part of the window left free (mounting trim, heading). A robust line through these offsets is the result,
   with standard errors that contain the scatter of the windows.
4. The aligned log must explain the rates of the record, and the offsets must lie on one line."""

import math
from dataclasses import dataclass

import numpy as np

from terrafix.core.autopilot_log.attitude import AttitudeSeries
from terrafix.core.autopilot_log.correlation import ROBUST, LagPeak, clipped, correlate
from terrafix.core.errors import EvaluationError

MIN_CELL_S = 0.1  # of the grid: short enough for the manoeuvres of a copter [tuned]
MAX_INTERPOLATED_GAP_S = 1.0  # or three typical intervals: across longer ones nothing is interpolated [tuned]
MIN_ATTITUDE_S = 10.0  # of attitude in record and log [tuned]
MIN_ALIGNED_RATE_RADPS = math.radians(0.5)  # RMS of the body rates; below, noise outweighs motion [tuned]
MIN_MATCHED = 0.8  # correlation of the rates after alignment: 0.64 of their variance is explained [tuned]
MAX_SCATTER_S = 0.025  # of the offsets of windows about their line, 1-sigma, robust [tuned]
WINDOW_S = (5.0, 20.0)  # least and greatest duration of a window [tuned]
MIN_WINDOWS = 5  # in a short record [tuned]
# correlation at a lag that is not distinct: the motion repeats itself, rather than being another [tuned]
UNIFORM_SHARE = 0.5
MIN_WINDOW_SAMPLES = 12  # [tuned]
MAX_WINDOW_SIGMA_S = 0.1  # a window that moves too little for this is left out [tuned]
ALIGNMENT_ITERATIONS = 6  # of Gauss-Newton, each from the line before [tuned]
MAX_OFFSET_STEP_S = 0.5  # of the offset of a window in one iteration [tuned]
DRIFT_PRIOR = 100e-6  # s/s, 1-sigma: two crystals of 50 ppm; matters for short flights only
HUBER = 1.345  # sigmas; 95 % efficiency for Gaussian errors [spec: Huber 1964]


@dataclass(frozen=True)
class Alignment:
    """Clock of the log against that of the record. Seconds; sigmas are standard errors."""

    offset_s: float  # log less record, at ``middle_s``
    offset_sigma_s: float
    drift: float  # s/s: above 0 the log's clock is the faster one
    drift_sigma: float
    middle_s: float  # time of the record
    correlation: float  # of the body rates at the best lag
    second: float  # at the next best lag
    needed: float  # at the best lag, for it to be no coincidence
    matched: float  # of the body rates after the fit
    windows: int  # in the line
    scatter_s: float  # of their offsets about it, 1-sigma, robust
    attitude_rad: float  # between the two attitudes, median

    def to_record(self, log_s: np.ndarray) -> np.ndarray:
        """-> times of the record."""
        return self.middle_s + (log_s - self.middle_s - self.offset_s) / (1.0 + self.drift)

    def to_log(self, record_s: np.ndarray) -> np.ndarray:
        """-> times of the log."""
        return record_s + self.offset_s + self.drift * (record_s - self.middle_s)


@dataclass(frozen=True)
class _Line:
    """Offset at ``middle_s`` and drift, with the line's windows."""

    offset_s: float
    drift: float
    middle_s: float
    offset_sigma_s: float = 0.0
    drift_sigma: float = 0.0
    windows: int = 0
    scatter_s: float = 0.0

    def at(self, record_s: np.ndarray) -> np.ndarray:
        return self.offset_s + self.drift * (record_s - self.middle_s)


def align(record: AttitudeSeries, log: AttitudeSeries) -> Alignment:
    """Both with increasing times (``cleaned``). Raises EvaluationError, one line: too little attitude, too little
    motion, or a log of another flight."""
    for name, attitude in (("record", record), ("log", log)):
        span_s = attitude.t_s[-1] - attitude.t_s[0] if attitude.t_s.size > 1 else 0.0
        if span_s < MIN_ATTITUDE_S:
            raise EvaluationError(
                f"the {name} has {span_s:.0f} s of attitude, and {MIN_ATTITUDE_S:.0f} s are needed to align the clocks"
            )
    cell_s = max(MIN_CELL_S, interval_s(record), interval_s(log))
    rates = [body_rates(attitude, cell_s) for attitude in (record, log)]
    for name, (_, values, known) in zip(("record", "log"), rates, strict=True):
        rms = rms_of(values[known])
        if rms < MIN_ALIGNED_RATE_RADPS:
            raise EvaluationError(
                f"too little motion to align the clocks: the {name} has body rates of {math.degrees(rms):.2f} deg/s "
                f"(RMS), and {math.degrees(MIN_ALIGNED_RATE_RADPS):.1f} are needed; was it a flight?"
            )
    peak = correlate(rates[0], rates[1], cell_s)
    if not peak.distinct:
        evidence = (
            f"body rates correlate by {peak.correlation:.2f} at the best lag and {peak.second:.2f} at the next, "
            f"{peak.needed:.2f} is needed"
        )
        if peak.correlation >= UNIFORM_SHARE:
            raise EvaluationError(f"the motion is too short or too uniform to align the clocks: {evidence}")
        raise EvaluationError(f"the log is of another flight than the record: {evidence}; give the log of this flight")
    line = _fitted(record, log, peak)
    return _accepted(record, log, cell_s, peak, line)


def _accepted(record: AttitudeSeries, log: AttitudeSeries, cell_s: float, peak: LagPeak, line: _Line) -> Alignment:
    """Raises EvaluationError when the log does not follow the record along the line."""
    start_s, values, known = body_rates(record, cell_s)
    grid = start_s + cell_s * np.arange(len(values) + 1)
    angles, there = interpolate(log, grid + line.at(grid))
    known &= there[:-1] & there[1:]
    if not known.any():
        raise EvaluationError("the log has no attitude at the times of the record; give the log of this flight")
    of_record, of_log = (clipped(rates[known]) for rates in (values, rates_between(rotations(angles), cell_s)))
    norm = math.sqrt(float(np.sum(of_record**2) * np.sum(of_log**2)))
    matched = float(np.sum(of_record * of_log)) / norm if norm > 0 else 0.0
    if matched < MIN_MATCHED or line.scatter_s > MAX_SCATTER_S or line.windows == 0:
        raise EvaluationError(
            f"the log is of another flight than the record: at the best alignment the body rates correlate by "
            f"{matched:.2f} ({MIN_MATCHED:.2f} is needed) and its time scatters by {1e3 * line.scatter_s:.0f} ms; "
            "give the log of this flight"
        )
    difference = _differences(record, log, line)[1]
    return Alignment(
        offset_s=line.offset_s,
        offset_sigma_s=line.offset_sigma_s,
        drift=line.drift,
        drift_sigma=line.drift_sigma,
        middle_s=line.middle_s,
        correlation=peak.correlation,
        second=peak.second,
        needed=peak.needed,
        matched=matched,
        windows=line.windows,
        scatter_s=line.scatter_s,
        attitude_rad=float(np.median(np.linalg.norm(difference, axis=1))),
    )


def _fitted(record: AttitudeSeries, log: AttitudeSeries, peak: LagPeak) -> _Line:
    line = _Line(peak.offset_s, peak.drift, 0.5 * float(record.t_s[0] + record.t_s[-1]))
    for _ in range(ALIGNMENT_ITERATIONS):
        times, offsets, sigmas = _offsets_of_windows(*_differences(record, log, line))
        if not len(times):
            return line
        line = _line(times, offsets + line.at(times), sigmas, line.middle_s)
    return line


def _differences(record: AttitudeSeries, log: AttitudeSeries, line: _Line) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> times of the record (N,), rotation vectors (N, 3) by which the record's attitude differs from that of the log
    at the same time, and the change of these per second by which the log is read later (N, 3).

    The attitude with more samples is interpolated at the samples of the other."""
    of_log = interval_s(record) > interval_s(log)
    sparse, dense = (record, log) if of_log else (log, record)
    if of_log:
        record_s = sparse.t_s
        at_s = record_s + line.at(record_s)
    else:
        record_s = line.middle_s + (sparse.t_s - line.middle_s - line.offset_s) / (1.0 + line.drift)
        at_s = record_s
    angles, known = interpolate(dense, at_s)
    half_s = max(0.5 * MIN_CELL_S, interval_s(dense))
    before, known_before = interpolate(dense, at_s - half_s)
    after, known_after = interpolate(dense, at_s + half_s)
    keep = known & known_before & known_after
    turned = rotations(angles[keep])
    own = rotations(np.stack([sparse.roll_rad, sparse.pitch_rad, sparse.yaw_rad], axis=1)[keep])
    difference = _vectors(np.einsum("nji,njk->nik", turned, own))
    rate = _vectors(np.einsum("nji,njk->nik", rotations(before[keep]), rotations(after[keep]))) / (2.0 * half_s)
    sign = 1.0 if of_log else -1.0  # the record read as late as the log is early
    return record_s[keep], sign * difference, rate


def _offsets_of_windows(
    times: np.ndarray, difference: np.ndarray, rate: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> for each window with enough motion: its time (weighted by the motion), offset and standard error.

    Least squares of difference = rate * offset + constant. The error is that for residuals of unequal variance, since
    jitter of the arrival acts as motion does (White 1980), and grows with their correlation in time."""
    found: list[tuple[float, float, float]] = []
    if not len(times):
        return np.zeros(0), np.zeros(0), np.zeros(0)
    window_s = float(np.clip((times[-1] - times[0]) / MIN_WINDOWS, *WINDOW_S))
    number = np.floor((times - times[0]) / window_s).astype(int)
    for first, last in zip(*_runs(number), strict=True):
        if last - first < MIN_WINDOW_SAMPLES:
            continue
        w = rate[first:last] - rate[first:last].mean(axis=0)
        e = difference[first:last] - difference[first:last].mean(axis=0)
        energy = float(np.sum(w**2))
        if energy <= 0.0:
            continue
        offset_s = float(np.sum(w * e)) / energy
        moment = np.sum(w * (e - offset_s * w), axis=1)
        total = float(np.sum(moment**2))
        kept = max(0.0, float(np.sum(moment[1:] * moment[:-1])) / total) if total > 0 else 0.0
        sigma_s = math.sqrt(total * (1.0 + kept) / max(1.0 - kept, 0.1)) / energy
        motion = np.sum(w**2, axis=1)
        if sigma_s < MAX_WINDOW_SIGMA_S:
            time_s = float(np.sum(motion * times[first:last]) / energy)
            found.append((time_s, float(np.clip(offset_s, -MAX_OFFSET_STEP_S, MAX_OFFSET_STEP_S)), sigma_s))
    columns = np.array(found).reshape(-1, 3)
    return columns[:, 0], columns[:, 1], columns[:, 2]


def _line(times: np.ndarray, offsets: np.ndarray, sigmas: np.ndarray, middle_s: float) -> _Line:
    """Robust line through offsets (iteratively reweighted least squares, Huber), and DRIFT_PRIOR.

    The variance of an offset is that of its window and a scatter common to all, estimated from the residuals."""
    scatter_s = 0.0
    floor = np.maximum(sigmas, 1e-5)
    design = np.stack([np.ones_like(times), times - middle_s], axis=1)
    fit, covariance = np.array([float(np.median(offsets)), 0.0]), np.zeros((2, 2))
    for _ in range(20):
        sigma = np.sqrt(floor**2 + scatter_s**2)
        residual = (offsets - design @ fit) / sigma
        weight = np.minimum(1.0, HUBER / np.maximum(np.abs(residual), 1e-12)) / sigma**2
        information = design.T @ (weight[:, None] * design) + np.diag([0.0, DRIFT_PRIOR**-2])
        covariance = np.linalg.inv(information)
        fit = covariance @ (design.T @ (weight * offsets))
        scatter_s = ROBUST * float(np.median(np.abs(offsets - design @ fit)))
    return _Line(
        offset_s=float(fit[0]),
        drift=float(fit[1]),
        middle_s=middle_s,
        offset_sigma_s=math.sqrt(covariance[0, 0]),
        drift_sigma=math.sqrt(covariance[1, 1]),
        windows=len(times),
        scatter_s=scatter_s,
    )


def body_rates(attitude: AttitudeSeries, cell_s: float) -> tuple[float, np.ndarray, np.ndarray]:
    """-> start of the grid [s], mean body rates in its cells (N, 3) [rad/s], and which are known (N,)."""
    count = int((attitude.t_s[-1] - attitude.t_s[0]) / cell_s)
    grid = attitude.t_s[0] + cell_s * np.arange(count + 1)
    angles, known = interpolate(attitude, grid)
    return float(grid[0]), rates_between(rotations(angles), cell_s), known[:-1] & known[1:]


def rates_between(turned: np.ndarray, step_s: float) -> np.ndarray:
    """(N + 1, 3, 3) rotations, ``step_s`` apart -> (N, 3) mean body rates."""
    return _vectors(np.einsum("nji,njk->nik", turned[:-1], turned[1:])) / step_s


def rms_of(rates: np.ndarray) -> float:
    """RMS of the rates (N, 3) about their mean; 0 for none."""
    return float(np.sqrt(np.mean(np.sum((rates - rates.mean(axis=0)) ** 2, axis=1)))) if len(rates) else 0.0


def interpolate(attitude: AttitudeSeries, at_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> roll, pitch, yaw (N, 3) at the times, and whether they are known: inside the attitude, and not in a gap."""
    t_s = attitude.t_s
    angles = [
        np.interp(at_s, t_s, np.unwrap(angle)) for angle in (attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad)
    ]
    after = np.clip(np.searchsorted(t_s, at_s), 1, t_s.size - 1)
    gap_s = max(MAX_INTERPOLATED_GAP_S, 3.0 * interval_s(attitude))
    known = (at_s >= t_s[0]) & (at_s <= t_s[-1]) & (t_s[after] - t_s[after - 1] <= gap_s)
    return np.stack(angles, axis=1), known


def rotations(angles: np.ndarray) -> np.ndarray:
    """(N, 3) roll, pitch, yaw -> (N, 3, 3) rotations from the body (FRD) to north, east, down."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles).T, np.sin(angles).T
    rows = [
        [cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy],
        [cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy],
        [-sp, sr * cp, cr * cp],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def interval_s(attitude: AttitudeSeries) -> float:
    """Typical time between two samples."""
    return float(np.median(np.diff(attitude.t_s)))


def _vectors(turned: np.ndarray) -> np.ndarray:
    """(N, 3, 3) rotations -> (N, 3) rotation vectors [rad], below pi."""
    axis = 0.5 * np.stack(
        [turned[:, 2, 1] - turned[:, 1, 2], turned[:, 0, 2] - turned[:, 2, 0], turned[:, 1, 0] - turned[:, 0, 1]],
        axis=1,
    )
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(turned, axis1=1, axis2=2) - 1.0))
    return axis * (angle / np.maximum(sine, 1e-12))[:, None]


def _runs(number: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and last + 1 index of each run of equal numbers."""
    edges = np.flatnonzero(np.diff(number)) + 1
    return np.concatenate([[0], edges]), np.concatenate([edges, [number.size]])
