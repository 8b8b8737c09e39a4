"""Frames matched with the exposures that an autopilot reports or has logged: which frame is which exposure.

Stamps of frames lag behind the exposures by a latency that is constant but for jitter. Images are lost and so are
reports, so numbers do not pair them: the latency does, at which the most stamps have an exposure. Where another latency
explains nearly as much, as at an even rate, the count is ambiguous and nothing is matched."""

from dataclasses import dataclass

import numpy as np

# Messages of MAVLink, the preferred one first: by the camera's signal, by the camera, by the signal that triggers it.
EXPOSURE_KINDS = ("CAMERA_FEEDBACK", "CAMERA_IMAGE_CAPTURED", "CAMERA_TRIGGER")  # [spec: MAVLink common.xml]
MIN_EXPOSED_FRAMES = 5  # with an exposure of their own [spec: four intervals, which chance does not repeat]
LOST = 0.02  # probability that an image or a report is lost [tuned]
REACH = 0.25  # share of the shortest interval of exposures within which a stamp has one [spec: half of a half]
MIN_JITTER_S = 1e-3  # to which logs and reports state times [spec: time_boot_ms]
MAX_AGAINST = np.log(0.01)  # log of the likelihood of the second latency over that of the first [spec: 99 %]
ANCHORS = 8  # stamps of which one has its exposure in the log: the candidates are their differences [spec: LOST]
MAX_CANDIDATES = 20_000  # [spec: 20 MB]


@dataclass(frozen=True)
class Matched:
    """``latency_s``: of the stamps behind the exposures, and its jitter, 1-sigma; ``times_s`` (N,): exposure of each
    frame, the stamp less the latency where ``seen`` (N,) is False."""

    latency_s: float
    jitter_s: float
    times_s: np.ndarray
    seen: np.ndarray

    def text(self) -> str:
        count = f"{int(self.seen.sum())} of {len(self.seen)} frames"
        return f"of {count}, {1e3 * self.latency_s:.0f} ms before their stamps (jitter {1e3 * self.jitter_s:.0f} ms)"


@dataclass(frozen=True)
class _Candidate:
    latency_s: float
    jitter_s: float
    nearest: np.ndarray  # (N,) index of an exposure
    seen: np.ndarray  # (N,)
    log_likelihood: float


def match_exposures(stamps_s: np.ndarray, exposures_s: np.ndarray, sigma_s: float, *, complete: bool) -> Matched | str:
    """Stamps (N,) of frames and exposures (M,), both increasing, matched; or why they do not fit, in words.

    ``sigma_s``: 1-sigma of the latency about 0. ``complete``: every frame and exposure of the flight is there, so that
    exposures beyond the frames count as lost images."""
    if len(stamps_s) < MIN_EXPOSED_FRAMES or len(exposures_s) < MIN_EXPOSED_FRAMES:
        return f"{len(exposures_s)} exposures and {len(stamps_s)} frames are too few to compare"
    interval_s = float(np.quantile(np.diff(exposures_s), 0.1))
    tried = [
        _candidate(float(latency_s), stamps_s, exposures_s, interval_s, sigma_s, complete)
        for latency_s in _latencies(stamps_s, exposures_s, REACH * interval_s, 3.0 * sigma_s)
    ]
    ranked = sorted((one for one in tried if one is not None), key=lambda one: -one.log_likelihood)
    chance = len(stamps_s) * np.log(LOST / interval_s)  # every stamp without an exposure
    if not ranked or ranked[0].seen.sum() < MIN_EXPOSED_FRAMES or ranked[0].log_likelihood + MAX_AGAINST < chance:
        return f"no latency up to {3.0 * sigma_s:.3g} s fits {len(exposures_s)} exposures to {len(stamps_s)} frames"
    best = ranked[0]
    for other in ranked[1:]:
        if other.log_likelihood < best.log_likelihood + MAX_AGAINST:
            break
        if abs(other.latency_s - best.latency_s) > 0.5 * interval_s:
            return (
                f"latencies of {best.latency_s:.2f} and {other.latency_s:.2f} s fit alike, so it is ambiguous which "
                "frame is which exposure; state [source] latency_ms with latency_sigma_ms"
            )
    times_s = np.where(best.seen, exposures_s[best.nearest], stamps_s - best.latency_s)
    return Matched(best.latency_s, best.jitter_s, times_s, best.seen)


def _latencies(stamps_s: np.ndarray, exposures_s: np.ndarray, step_s: float, reach_s: float) -> np.ndarray:
    """Differences of some stamps and all exposures, one of each ``step_s``."""
    anchors = stamps_s[np.unique(np.linspace(0, len(stamps_s) - 1, ANCHORS).astype(int))]
    differences = (anchors[:, None] - exposures_s).ravel()
    differences = differences[np.abs(differences) <= reach_s]
    _, first = np.unique(np.round(differences / step_s), return_index=True)
    return np.asarray(differences[first][:MAX_CANDIDATES])


def _candidate(
    latency_s: float,
    stamps_s: np.ndarray,
    exposures_s: np.ndarray,
    interval_s: float,
    sigma_s: float,
    complete: bool,
) -> _Candidate | None:
    """Twice: at the latency, and at the median of what it matches. None: it matches nothing."""
    for _ in range(2):
        at = np.clip(np.searchsorted(exposures_s, stamps_s - latency_s), 1, len(exposures_s) - 1)
        before = np.abs(stamps_s - latency_s - exposures_s[at - 1])
        nearest = at - (before < np.abs(stamps_s - latency_s - exposures_s[at]))
        off_s = stamps_s - latency_s - exposures_s[nearest]
        seen = np.abs(off_s) <= REACH * interval_s
        seen[1:] &= ~seen[:-1] | (nearest[1:] != nearest[:-1])  # a frame that comes twice
        if not seen.any():
            return None
        latency_s += float(np.median(off_s[seen]))
    off_s = off_s[seen] - np.median(off_s[seen])
    jitter_s = max(MIN_JITTER_S, float(np.sqrt(np.mean(off_s**2))))
    shown, reported = np.ones(len(exposures_s), bool), np.ones(len(stamps_s), bool)
    if not complete:
        shown = _within(exposures_s, stamps_s[[0, -1]] - latency_s, interval_s)
        reported = _within(stamps_s - latency_s, exposures_s[[0, -1]], interval_s)
    unused, alone = max(int(shown.sum()) - int(seen.sum()), 0), int((~seen & reported).sum())
    log = (alone - len(stamps_s)) * (np.log(jitter_s * np.sqrt(2.0 * np.pi)) + 0.5)  # beyond the reports: as if seen
    log += alone * np.log(LOST / interval_s) + unused * np.log(LOST)
    return _Candidate(latency_s, jitter_s, nearest, seen, float(log - 0.5 * (latency_s / sigma_s) ** 2))


def _within(times_s: np.ndarray, ends_s: np.ndarray, margin_s: float) -> np.ndarray:
    return np.asarray((times_s > ends_s[0] - 0.5 * margin_s) & (times_s < ends_s[1] + 0.5 * margin_s))
