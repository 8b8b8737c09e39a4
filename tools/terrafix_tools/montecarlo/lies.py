"""Lies of a flight: what its camera shows instead of the truth, and what the map says of that.

The lies that are numbers (height, focal length, heading, start, late pictures) are in the plan. Here are those that
begin in flight, and a stand-in for what the anchor does when it finds nothing for long: it is lost, and searches."""

import math
from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np

from terrafix.messages import MapMatch, Prediction, SearchStep, Verdict
from terrafix_tools.montecarlo.fault import Fault
from terrafix_tools.montecarlo.faults import nothing_found, sure_of
from terrafix_tools.montecarlo.flown import Flown, Shot
from terrafix_tools.montecarlo.plan import FlightPlan

BEGINS = (0.25, 0.6)  # of the flight
FOREIGN_FRAMES, FOREIGN_AWAY_M, FOREIGN_PACE = (5, 15), (300.0, 900.0), (0.5, 3.0)  # pace: times the flight's own
FROZEN_S = (15.0, 40.0)
# Over the map of another town nothing is found, but a look in five is sure of a place that is not far off, and half
# of these are sure of the last one again: two of them in a row are what a search takes for a find.
TOWN_SHARE, TOWN_AGAIN, TOWN_AWAY_M = 0.2, 0.5, (40.0, 110.0)
# The search is not simulated. As the anchor's was measured: an unknown place is given up after 15 looks that found
# nothing, and found again after 5 looks at which it could be seen, when heading and scale are those that are searched.
LOST_LOOKS, FOUND_LOOKS, LOST_SIGMA_M = 15, 5, 300.0

Matching = Callable[[Prediction, Shot], MapMatch]


class Lies:
    """Of one flight. ``picture`` and ``match`` once for every frame, in order."""

    def __init__(self, plan: FlightPlan, flown: Flown) -> None:
        self._lies, self._flown = plan.lies, flown
        rng = np.random.default_rng([plan.seed, 61])
        times_s = [shot.t_s for shot in flown.frames]

        def begin() -> int:
            return int(np.searchsorted(times_s, float(rng.uniform(*BEGINS)) * plan.duration_s))

        self._foreign_from, self._frozen_from, self._town_from = begin(), begin(), begin()
        self._foreign_to = self._foreign_from + int(rng.integers(FOREIGN_FRAMES[0], FOREIGN_FRAMES[1] + 1))
        self._frozen_to = self._frozen_from + round(float(rng.uniform(*FROZEN_S)) * plan.frame_hz)
        self._turn_rad = float(rng.uniform(-math.pi, math.pi))
        self._pace, self._away_m = float(rng.uniform(*FOREIGN_PACE)), _way(rng, FOREIGN_AWAY_M)
        self._rng, self._town_m = rng, _way(rng, TOWN_AWAY_M)
        self._search = Search() if plan.lies else None

    def begins_s(self) -> float | None:
        """When the first lie begins; None: there is none."""
        if not self._lies:
            return None
        begun = {
            Fault.FOREIGN: self._foreign_from,
            Fault.FROZEN: self._frozen_from,
            Fault.TOWN: self._town_from,
        }
        first = min(begun.get(lie, 0) for lie in self._lies)
        return self._flown.frames[min(first, len(self._flown.frames) - 1)].t_s

    def picture(self, i: int) -> Shot:
        """What frame ``i`` shows, with the time that it says."""
        shot = self._flown.pictures[i]
        if self._is_frozen(i):
            return replace(self._flown.pictures[self._frozen_from], t_s=shot.t_s)
        return self._elsewhere(shot) if self._is_foreign(i) else shot

    def match(self, i: int, prediction: Prediction, find: Matching) -> MapMatch:
        """What the anchor says of frame ``i``. ``find``: what it would say of a shot."""
        shot = self.picture(i)
        found = find(prediction, shot)
        if self._is_foreign(i):
            found = nothing_found(found)
        if Fault.TOWN in self._lies and i >= self._town_from:
            return self._of_another_town(found, i)
        if self._search is None:
            return found
        return self._search.heard(found, prediction, shot, find)

    def _is_foreign(self, i: int) -> bool:
        return Fault.FOREIGN in self._lies and self._foreign_from <= i < self._foreign_to

    def _is_frozen(self, i: int) -> bool:
        return Fault.FROZEN in self._lies and self._frozen_from <= i < self._frozen_to

    def _elsewhere(self, shot: Shot) -> Shot:
        """As another camera sees it that flies the same way far away, turned, and at a pace of its own."""
        first = self._flown.pictures[self._foreign_from]
        c, s = math.cos(self._turn_rad), math.sin(self._turn_rad)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        away = np.array([*self._away_m, 0.0])
        pace = np.array([self._pace, self._pace, 1.0])
        return replace(
            shot,
            p_m=first.p_m + away + turn @ (pace * (shot.p_m - first.p_m)),
            r_w_c=turn @ shot.r_w_c,
            r_w_b=turn @ shot.r_w_b,
        )

    def _of_another_town(self, match: MapMatch, i: int) -> MapMatch:
        sure, again, other_m = (
            self._rng.uniform() < TOWN_SHARE,
            self._rng.uniform() < TOWN_AGAIN,
            _way(self._rng, TOWN_AWAY_M),
        )
        if not sure:
            return nothing_found(match)
        if not again:
            self._town_m = other_m
        return sure_of(match, self._flown.frames[i], self._town_m, self._rng)


class Search:
    """A stand-in for the anchor's: lost after some looks in vain, found after some at which the place can be seen."""

    def __init__(self) -> None:
        self._in_vain = self._seen = 0

    def heard(self, match: MapMatch, prediction: Prediction, shot: Shot, find: Matching) -> MapMatch:
        if match.verdict is Verdict.ACCEPTED and self._in_vain < LOST_LOOKS:
            self._in_vain = 0
            return match
        self._in_vain += 1
        if self._in_vain < LOST_LOOKS:
            return match
        e_m, n_m, up_m = float(shot.p_m[0]), float(shot.p_m[1]), prediction.p_c_in_w_m[2]
        there = find(msgspec.structs.replace(prediction, p_c_in_w_m=(e_m, n_m, up_m)), shot)
        self._seen += there.verdict is Verdict.ACCEPTED and not there.coarse
        if self._seen >= FOUND_LOOKS and there.verdict is Verdict.ACCEPTED and not there.coarse:
            self._in_vain = self._seen = 0
            return msgspec.structs.replace(there, found=True, step=SearchStep.MERGE)
        lost = nothing_found(match)
        return msgspec.structs.replace(lost, verdict=Verdict.LOST, step=SearchStep.WIDEN, lost_sigma_m=LOST_SIGMA_M)


def _way(rng: np.random.Generator, away_m: tuple[float, float]) -> np.ndarray:
    """(2,) east, north: so far in some direction."""
    far_m, towards = float(rng.uniform(*away_m)), float(rng.uniform(0.0, 2.0 * math.pi))
    return far_m * np.array([math.sin(towards), math.cos(towards)])
