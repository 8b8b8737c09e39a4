"""Relocalizer: runs the map search while the position is unknown, tests its result, and applies external position
priors."""

import msgspec
import numpy as np

from terrafix.anchor.matching.frame_matcher import View
from terrafix.anchor.matching.map_layers import MapLayer
from terrafix.anchor.matching.match_message import relocalized_match
from terrafix.anchor.matching.predicted_view import ground_plane, position_sigma_m, view_of
from terrafix.anchor.relocalization.map_search import MapSearch
from terrafix.anchor.relocalization.position_prior import CurrentBelief, aged_radius_m, evaluate_prior
from terrafix.anchor.verification.probation import Probation
from terrafix.core.gate import SIGMAS_95
from terrafix.core.geodesy import LocalFrame
from terrafix.core.node import Image
from terrafix.map.null_model import FalseAlarmBudget
from terrafix.map.package import LocalMap
from terrafix.messages import HintVerdict, MapMatch, MatchPlace, Origin, PositionHint, Prediction, SearchResult, Verdict

LOST_SIGMA_M = 1000.0  # smallest 1-sigma of an unknown position, metres; larger on a larger map [tuned]
MAX_HEIGHT_RATIO = 1.5  # ratio of heights beyond which a search is restarted [tuned]


def unknown_sigma_m(source: LocalMap) -> float:
    """1-sigma per axis of an unknown position: half of the map's longer side, at least ``LOST_SIGMA_M``."""
    e_min, n_min, e_max, n_max = source.bounds_m
    return max(LOST_SIGMA_M, 0.5 * (e_max - e_min), 0.5 * (n_max - n_min))


def mixed_sigma_m(probability: float, source: LocalMap) -> float:
    """1-sigma per axis that the mixture component "anywhere", with this probability, adds to a known position."""
    return float(np.sqrt(probability)) * unknown_sigma_m(source)


def search_centre(e_m: float, n_m: float, sigma_m: float, source: LocalMap) -> tuple[float, float] | None:
    """Centre of a search around a position with this 1-sigma; None if the position is no more precise than the map's
    extent."""
    e_min, n_min, e_max, n_max = source.bounds_m
    return (e_m, n_m) if sigma_m < 0.25 * max(e_max - e_min, n_max - n_min) else None


class Relocalizer:
    """State of one flight. ``sigma_m``: 1-sigma per axis to be added to the estimator's covariance, during a search and
    while a position is only in doubt."""

    def __init__(self) -> None:
        self._search: MapSearch | None = None
        self._probation: Probation | None = None
        self._budget = FalseAlarmBudget()
        self.sigma_m = 0.0

    @property
    def is_active(self) -> bool:
        return self._search is not None

    @property
    def search(self) -> MapSearch | None:
        """The running search, for who shows it; None: none."""
        return self._search

    def start(self, best: MapLayer, agl_m: float, around_m: tuple[float, float] | None) -> None:
        """Starts a search around ``around_m`` (local east, north); None: on the whole map."""
        null = best.null_at(agl_m)
        self._search = MapSearch(best.map, best.matcher, agl_m, around_m, null, self._budget, best.recognizer)
        self.sigma_m = unknown_sigma_m(best.map)

    def stop(self) -> None:
        """Ends a running search without a result."""
        self._search = None

    def predict(self, step_m: tuple[float, float], sigma_m: float) -> None:
        if self._search is not None:
            self._search.predict(*step_m, sigma_m)
        if self._probation is not None:
            self._probation.predict(float(np.hypot(*step_m)))

    def refutes_place(self, image: Image, view: View | None) -> bool:
        """Sequential test of the last relocalized place with a frame. ``view``: camera at the belief's mode; None: the
        belief has no dominant mode. -> whether the place has failed it."""
        test = self._probation
        if test is None:
            return False
        test.update(image, view)
        if test.passed or test.failed:
            self._probation = None
        return test.failed

    @property
    def wrong_probability(self) -> float:
        """Probability that the last relocalized place is wrong; 0 while none is tested."""
        return 0.0 if self._probation is None else self._probation.wrong_probability

    def search_match(self, match: MapMatch) -> MapMatch:
        """``match`` as the message of a running search: verdict LOST, without a pose."""
        return msgspec.structs.replace(
            match,
            verdict=Verdict.LOST,
            matches=[],
            pnp=None,
            pose=None,
            inliers=0,
            search=SearchResult(
                step=match.search.step if self._search is None else self._search.step, sigma_m=self.sigma_m
            ),
        )

    def process_frame(
        self, no_match: MapMatch, prediction: Prediction, image: Image | None, best: MapLayer, ground_m: float
    ) -> MapMatch:
        """Processes one frame of the search. Verdict ACCEPTED with ``relocalized`` and ``place`` when a place is
        accepted, else LOST. ``image`` None: no usable frame."""
        assert self._search is not None
        if not 1 / MAX_HEIGHT_RATIO < prediction.agl_m / self._search.agl_m < MAX_HEIGHT_RATIO:
            self.start(best, prediction.agl_m, None)
        if image is None:
            return self.search_match(no_match)
        view = view_of(prediction, None, ground_m)
        place = self._search.process_frame(image, view)
        if place is None:
            return self.search_match(no_match)
        e_m, n_m = place.track.e_m, place.track.n_m
        ground = ground_plane(best.map, e_m, n_m, view.agl_m)
        match = msgspec.structs.replace(no_match, place=MatchPlace(e_m=e_m, n_m=n_m, mass=1.0), ground=ground)
        match = relocalized_match(match, place.fix, view, place.track.innovation_m)
        if match.verdict is not Verdict.ACCEPTED:
            return self.search_match(no_match)
        self._probation = Probation(self._search.tracker, best.null_at(prediction.agl_m).frame, prediction.agl_m)
        self._search, self.sigma_m = None, mixed_sigma_m(self._probation.wrong_probability, best.map)
        search = msgspec.structs.replace(match.search, sigma_m=self.sigma_m)
        return msgspec.structs.replace(match, search=search)

    def apply_prior(
        self, hint: PositionHint, origin: Origin, prediction: Prediction, best: MapLayer, log_odds: float
    ) -> HintVerdict:
        """Applies an external position prior: restarts the search there, or only compares it with the believed
        position, which has these log odds."""
        e_m, n_m = LocalFrame(origin.lat_deg, origin.lon_deg).to_local(hint.lat_deg, hint.lon_deg)
        radius_m = aged_radius_m(hint.radius_m, (prediction.t_ns - hint.t_ns) * 1e-9)
        sigma_m = float(np.hypot(position_sigma_m(prediction), self.sigma_m))
        belief = CurrentBelief(*prediction.p_c_in_w_m[:2], sigma_m, log_odds)
        decision = evaluate_prior((e_m, n_m), radius_m, belief, best.map.bounds_m, searching=self.is_active)
        tracks = self._search.tracker.tracks if self._search is not None else []
        has_confirmed = any(t.frames and np.hypot(t.e_m - e_m, t.n_m - n_m) <= radius_m for t in tracks)
        around = search_centre(e_m, n_m, radius_m / SIGMAS_95, best.map)
        # The state of a running search is kept if it has a confirmed track within the prior, or if the prior is no more
        # precise than the map's extent.
        if decision.starts_search and not has_confirmed and (around is not None or not self.is_active):
            self.start(best, prediction.agl_m, around)
        return HintVerdict(
            t_ns=prediction.t_ns,
            hint_t_ns=hint.t_ns,
            verdict=decision.verdict,
            distance_m=decision.distance_m,
            sigma_m=sigma_m,
            text=decision.text,
        )
