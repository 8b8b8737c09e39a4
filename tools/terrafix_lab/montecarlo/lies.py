"""False inputs ("lies") of a flight: what the camera shows instead of the truth, and the map matches of that.

False numbers (height, focal length, heading, start, late pictures) are part of the plan. This module has the false
inputs that begin in flight, and a model of the anchor's search after a long series of frames without a match."""

import math
from dataclasses import replace
from typing import Protocol

import msgspec
import numpy as np

from terrafix.messages import MapMatch, Prediction, SearchResult, SearchStep, Verdict
from terrafix_lab.faults.edits import Span
from terrafix_lab.montecarlo.fault import DrawnFault
from terrafix_lab.montecarlo.faults import no_match, wrong_match
from terrafix_lab.montecarlo.flown import Shot, SimulatedFlight
from terrafix_lab.montecarlo.plan import FlightPlan

START = (0.25, 0.6)  # range of the start, as shares of the flight
FOREIGN_FRAMES, FOREIGN_AWAY_M, FOREIGN_PACE = (
    (5, 15),
    (300.0, 900.0),
    (0.5, 3.0),
)  # range of the number of frames, the offset, and the speed over the flight's own
FROZEN_S = (15.0, 40.0)  # range of the duration
# Over the map of another town the frames are not found. One correlation in five gives an overconfident match near by,
# and half of these repeat the position of the last one: two such matches in a row confirm a search.
TOWN_SHARE, TOWN_AGAIN, TOWN_AWAY_M = 0.2, 0.5, (40.0, 110.0)
# The search is modelled by what was measured of the anchor's: the position is lost after 15 frames without a match, and
# found after 5 frames that can be matched, if heading and scale are within the range that is searched.
LOST_FRAMES, FOUND_FRAMES, LOST_SIGMA_M = 15, 5, 300.0


class FindMatch(Protocol):
    """MapMatches.match"""

    def __call__(self, prediction: Prediction, shot: Shot, *, usable: bool = True) -> MapMatch: ...


class Lies:
    """Of one flight. Call ``picture`` and ``match`` once for every frame, in order."""

    def __init__(self, plan: FlightPlan, flown: SimulatedFlight) -> None:
        self._lies, self._flown = plan.lies, flown
        rng = np.random.default_rng([plan.seed, 61])
        times_s = [shot.t_s for shot in flown.frames]

        def start() -> int:
            return int(np.searchsorted(times_s, float(rng.uniform(*START)) * plan.duration_s))

        self._foreign_from, self._frozen_from, self._town_from = start(), start(), start()
        self._foreign_to = self._foreign_from + int(rng.integers(FOREIGN_FRAMES[0], FOREIGN_FRAMES[1] + 1))
        self._frozen_to = self._frozen_from + round(float(rng.uniform(*FROZEN_S)) * plan.frame_hz)
        self._turn_rad = float(rng.uniform(-math.pi, math.pi))
        self._pace, self._away_m = float(rng.uniform(*FOREIGN_PACE)), _random_offset_m(rng, FOREIGN_AWAY_M)
        self._rng, self._town_m = rng, _random_offset_m(rng, TOWN_AWAY_M)
        self._search = Search() if plan.lies or flown.lie is not None else None

    def span(self) -> Span | None:
        """Of the first false input, whose end is not known here if it is drawn; None: there is none."""
        if not self._lies:
            return self._flown.lie
        starts = {
            DrawnFault.FOREIGN: self._foreign_from,
            DrawnFault.FROZEN: self._frozen_from,
            DrawnFault.TOWN: self._town_from,
        }
        first = min(starts.get(lie, 0) for lie in self._lies)
        return Span(self._flown.frames[min(first, len(self._flown.frames) - 1)].t_s, math.inf, "")

    def picture(self, i: int) -> Shot:
        """True pose of the content of frame ``i``, with its stated time."""
        shot = self._flown.pictures[i]
        if self._is_frozen(i):
            return replace(self._flown.pictures[self._frozen_from], t_s=shot.t_s)
        return self._foreign(shot) if self._is_foreign(i) else shot

    def match(self, i: int, prediction: Prediction, find: FindMatch) -> MapMatch:
        """Map match of frame ``i``. ``find``: the match of a prediction and a shot without false inputs."""
        shot = self.picture(i)
        found = find(prediction, shot, usable=self._search is None or not self._search.is_lost)
        if self._is_foreign(i):
            found = no_match(found)
        if DrawnFault.TOWN in self._lies and i >= self._town_from and found.verdict is not Verdict.BAD_IMAGE:
            return self._match_of_other_town(found, i)
        if self._search is None:
            return found
        return self._search.update(found, prediction, shot, find)

    def _is_foreign(self, i: int) -> bool:
        return DrawnFault.FOREIGN in self._lies and self._foreign_from <= i < self._foreign_to

    def _is_frozen(self, i: int) -> bool:
        return DrawnFault.FROZEN in self._lies and self._frozen_from <= i < self._frozen_to

    def _foreign(self, shot: Shot) -> Shot:
        """Pose of another camera: the same trajectory, far away, rotated, and at another speed."""
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

    def _match_of_other_town(self, match: MapMatch, i: int) -> MapMatch:
        matches, repeats, other_m = (
            self._rng.uniform() < TOWN_SHARE,
            self._rng.uniform() < TOWN_AGAIN,
            _random_offset_m(self._rng, TOWN_AWAY_M),
        )
        if not matches:
            return no_match(match)
        if not repeats:
            self._town_m = other_m
        return wrong_match(match, self._flown.frames[i], self._town_m, self._rng)


class Search:
    """Model of the anchor's search: lost after LOST_FRAMES without a match, found after FOUND_FRAMES with one."""

    def __init__(self) -> None:
        self._missed = self._matched = 0

    @property
    def is_lost(self) -> bool:
        return self._missed >= LOST_FRAMES

    def update(self, match: MapMatch, prediction: Prediction, shot: Shot, find: FindMatch) -> MapMatch:
        if match.verdict is Verdict.ACCEPTED and not self.is_lost:
            self._missed = 0
            return match
        self._missed += match.verdict is not Verdict.BAD_IMAGE  # such a frame is no evidence against the position
        if not self.is_lost:
            return match
        e_m, n_m, up_m = float(shot.p_m[0]), float(shot.p_m[1]), prediction.p_c_in_w_m[2]
        there = find(msgspec.structs.replace(prediction, p_c_in_w_m=(e_m, n_m, up_m)), shot, usable=False)
        self._matched += there.verdict is Verdict.ACCEPTED and not there.position_only
        if self._matched >= FOUND_FRAMES and there.verdict is Verdict.ACCEPTED and not there.position_only:
            self._missed = self._matched = 0
            return msgspec.structs.replace(there, search=SearchResult(step=SearchStep.MERGE, relocalized=True))
        search = SearchResult(step=SearchStep.WIDEN, sigma_m=LOST_SIGMA_M)
        return msgspec.structs.replace(no_match(match), verdict=Verdict.LOST, search=search)


def _random_offset_m(rng: np.random.Generator, range_m: tuple[float, float]) -> np.ndarray:
    """(2,) east, north: a length in ``range_m``, in any direction."""
    length_m, towards = float(rng.uniform(*range_m)), float(rng.uniform(0.0, 2.0 * math.pi))
    return length_m * np.array([math.sin(towards), math.cos(towards)])
