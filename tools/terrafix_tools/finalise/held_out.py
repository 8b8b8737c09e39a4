"""Which solution of a flight map matches prefer that none of them was given (cross-validation).

The record is replayed once more without one in EVERY runs of its map matches. By the reprojection error of the points
of these, the batch smoother's solution is compared with the last estimates in flight, and an estimated lens with the
described one. A distance of positions alone would not do: a match by itself confuses position and tilt, and the same
error of the lens is in it as in the estimates in flight."""

import math
from dataclasses import dataclass

import gtsam
import numpy as np

from terrafix_tools.finalise.batch_smoother import Progress, Smoothed, smooth
from terrafix_tools.finalise.flight_graph import HELD_OUT_RUN, Fix, FlightGraph
from terrafix_tools.finalise.lens import Lens

EVERY = 3  # of the runs of map matches of a flight, one in so many is held out [tuned]
MIN_RUNS = 4  # below this the scatter of the runs is not known [tuned]
SIGNIFICANT = 1.645  # standard errors of many runs, one-sided 5 % [spec: normal]
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
        runs = len(before) // HELD_OUT_RUN
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
    where the flight does not determine it. ``track``: the last estimates in flight against the batch smoother's; None:
    it has no solution. ``kept``: the batch smoother's solution is the finalised one, else the refined positions are."""

    estimates_lens: bool
    lens: Comparison | None
    track: Comparison | None
    kept: bool


def choose(flight: FlightGraph, progress: Progress = lambda _done, _of: None) -> Choice:
    """``flight``: replayed without its ``held_out`` matches.

    Refined positions do not reach beyond a reset of the graph, and their heights are those of the described lens. A
    flight with a reset, or one that determines its lens, keeps the batch smoother's solution unless the held-out
    matches say that it is worse; any other one only if they say that it is better."""
    try:
        found = smooth(flight, progress, estimates_lens=False)
        lens, estimated = None, _estimated(flight, progress)
        if estimated is not None:
            lens = Comparison.of(_smoothed_px(flight, found), _smoothed_px(flight, estimated), "px")
            if not lens.worse:
                found = estimated
    except RuntimeError:  # GTSAM: the system is indeterminate
        return Choice(False, None, None, False)
    estimates_lens = found is estimated
    track = Comparison.of(_in_flight_px(flight), _smoothed_px(flight, found), "px")
    refined_lacks = estimates_lens or any(node.again for node in flight.recorder.nodes)
    return Choice(estimates_lens, lens, track, not track.worse if refined_lacks else track.better)


def _estimated(flight: FlightGraph, progress: Progress) -> Smoothed | None:
    """The solution with an estimated focal length; None where the flight does not determine it."""
    if not any(node.triples is not None and len(node.triples.xy) for node in flight.recorder.nodes):
        return None
    found = smooth(flight, progress)
    determined = found.lens_sigma.log_focal < DETERMINED * flight.origin.camera.focal_sigma
    return found if determined else None


def _comparable(flight: FlightGraph) -> list[Fix]:
    """The held-out matches of which PnP has accepted points: a match that gave a pose itself has none."""
    return [fix for fix in flight.held_out if fix.points is not None and fix.points.accepted().any()]


def _smoothed_px(flight: FlightGraph, found: Smoothed) -> np.ndarray:
    """(F,) error of each comparable match, by the solution."""
    return np.array([_off_px(flight, f, found.on_map(f), found.lens_at(f.node)) for f in _comparable(flight)])


def _in_flight_px(flight: FlightGraph) -> np.ndarray:
    """(F,) ... by the last estimates in flight, whose lens is the described one with the newest radial coefficient."""
    lens, nodes = Lens(flight.radial_k1[0]), flight.recorder.nodes
    return np.array([_off_px(flight, f, nodes[f.node].state.pose, lens) for f in _comparable(flight)])


def _off_px(flight: FlightGraph, fix: Fix, pose: gtsam.Pose3, lens: Lens) -> float:
    """Mean distance of the points of a match that PnP had accepted from their projection, pixels of the image."""
    assert fix.points is not None
    off = fix.points.off(pose, lens)[fix.points.accepted()]
    return float(np.mean(off)) * flight.origin.camera.fx * math.exp(lens.log_focal)
