"""Which solution of a flight map matches prefer that none of them was given (cross-validation).

The record is replayed once more without one in EVERY of its map matches. Refined positions and the batch
smoother's are compared at these: an estimated lens with the described one by the reprojection error of the points, both
tracks by the horizontal distance, because the refined one has no attitude of its own."""

from dataclasses import dataclass

import numpy as np

from terrafix.estimator.estimator import Estimator
from terrafix.estimator.state import HORIZONTAL
from terrafix_tools.finalise.batch_smoother import Progress, Smoothed, smooth
from terrafix_tools.finalise.flight_graph import FlightGraph

EVERY = 3  # of the map matches of a flight, one in so many is held out [tuned]
# Successive held-out matches whose errors count as one number: they lie over the same ground, with the same error of
# the map. [tuned]
RUN = 3
MIN_RUNS = 4  # below this the scatter of the runs is not known [tuned]
SIGNIFICANT = 2.0  # standard errors of many runs, one-sided 2.3 % [spec: normal]
OUTLIER = 4.0  # medians, to which a distance is clipped: a wrong match is equally wrong for both [tuned]
# Share of the description's 1-sigma of the focal length, above which the flight does not determine it. [tuned]
DETERMINED = 0.5


@dataclass(frozen=True)
class Comparison:
    """Mean error of ``matches`` held-out map matches by one solution, ``before``, and by another, ``after``, in
    ``unit``. ``sigmas``: after less before, in standard errors by the scatter of ``runs`` of matches; 0: too few."""

    matches: int
    before: float
    after: float
    unit: str
    runs: int
    sigmas: float

    @classmethod
    def of(cls, before: np.ndarray, after: np.ndarray, unit: str) -> "Comparison":
        """``before``, ``after`` (N,): of each match, in order of time."""
        if not len(before):
            return cls(0, 0.0, 0.0, unit, 0, 0.0)
        limit = OUTLIER * float(np.median(before))
        before, after = np.minimum(before, limit), np.minimum(after, limit)
        runs = len(before) // RUN
        sigmas = 0.0
        if runs >= MIN_RUNS:
            of_runs = np.array([np.mean(run) for run in np.array_split(after - before, runs)])
            error = float(np.std(of_runs, ddof=1) / np.sqrt(runs))
            sigmas = float(np.mean(of_runs) / max(error, 1e-9))
        return cls(len(before), float(np.mean(before)), float(np.mean(after)), unit, runs, sigmas)

    @property
    def better(self) -> bool:
        return self.sigmas < -self._limit

    @property
    def worse(self) -> bool:
        return self.sigmas > self._limit

    @property
    def _limit(self) -> float:
        """Of Student's t with the quantile of SIGNIFICANT (Abramowitz and Stegun 26.7.5, three terms)."""
        z, dof = SIGNIFICANT, max(self.runs - 1, 1)
        first, second = (z**3 + z) / 4.0, (5 * z**5 + 16 * z**3 + 3 * z) / 96.0
        third = (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384.0
        return z + first / dof + second / dof**2 + third / dof**3


@dataclass(frozen=True)
class Choice:
    """``estimates_lens``: the focal length is estimated, else as described; ``lens``: described against estimated, None
    where the flight does not determine it. ``track``: refined positions against the batch smoother's; None: one of both
    has no solution. ``kept``: the batch smoother's solution is the finalised one, else the refined positions are."""

    estimates_lens: bool
    lens: Comparison | None
    track: Comparison | None
    kept: bool


def choose(flight: FlightGraph, estimator: Estimator, progress: Progress = lambda _done, _of: None) -> Choice:
    """``flight``: replayed without its ``held_out`` matches, by ``estimator``, which is refined here.

    Refined positions do not reach beyond a reset of the graph, and their heights are those of the described lens. A
    flight with a reset, or one that determines its lens, keeps the batch smoother's solution unless the held-out
    matches say that it is worse; any other one only if they say that it is better."""
    refined_m, _ = estimator.graph.refine()
    try:
        found = smooth(flight, progress, estimates_lens=False)
        lens, estimated = None, _estimated(flight, progress)
        if estimated is not None:
            lens = Comparison.of(_reprojection_px(flight, found), _reprojection_px(flight, estimated), "px")
            if not lens.worse:
                found = estimated
    except RuntimeError:  # GTSAM: the system is indeterminate
        return Choice(False, None, None, False)
    estimates_lens = found is estimated
    track = Comparison.of(*_distances_m(flight, refined_m, found), "m")
    refined_lacks = estimates_lens or any(node.again for node in flight.recorder.nodes)
    return Choice(estimates_lens, lens, track, not track.worse if refined_lacks else track.better)


def _estimated(flight: FlightGraph, progress: Progress) -> Smoothed | None:
    """The solution with an estimated focal length; None where the flight does not determine it."""
    if not any(node.triples is not None and len(node.triples.xy) for node in flight.recorder.nodes):
        return None
    found = smooth(flight, progress)
    determined = found.lens_sigma.log_focal < DETERMINED * flight.origin.camera.focal_sigma
    return found if determined else None


def _distances_m(flight: FlightGraph, refined_m: np.ndarray, found: Smoothed) -> tuple[np.ndarray, np.ndarray]:
    """-> horizontal distance of each held-out match from the refined position and from the solution, (F,) each. The
    position of a match is that through the lens of the track: a wrong lens moves both alike."""
    fixes = [fix for fix in flight.held_out if found.placed[fix.node] and np.isfinite(refined_m[fix.node]).all()]
    away_m = []
    for fix in fixes:
        lens = found.lens_at(fix.node)
        change = fix.by_lens @ np.array([lens.k1 - fix.k1, lens.log_focal])
        seen = fix.pose, fix.pose.retract(change)
        tracks_m = refined_m[fix.node], found.on_map(fix).translation()
        away_m.append([np.hypot(*(p_m - at.translation())[HORIZONTAL]) for p_m, at in zip(tracks_m, seen, strict=True)])
    before, after = np.array(away_m).reshape(-1, 2).T
    return before, after


def _reprojection_px(flight: FlightGraph, found: Smoothed) -> np.ndarray:
    """(F,) mean distance of the points of each held-out match that PnP had accepted, in pixels as described."""
    fx, errors = flight.origin.camera.fx, list[float]()
    for fix in flight.held_out:
        if fix.points is not None and (agree := fix.points.accepted()).any():
            lens = found.lens_at(fix.node)
            off = fix.points.off(found.on_map(fix), lens)[agree]
            errors.append(float(np.mean(off)) * fx * float(np.exp(lens.log_focal)))
    return np.array(errors)
