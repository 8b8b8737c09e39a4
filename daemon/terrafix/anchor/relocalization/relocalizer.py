"""While the position is not known: the search for it, what is said meanwhile, and a hint that moves it."""

import msgspec
import numpy as np

from terrafix.anchor.matching.frame_matcher import View
from terrafix.anchor.matching.map_layers import MapLayer
from terrafix.anchor.matching.match_message import found
from terrafix.anchor.matching.predicted_view import ground_plane, view_of
from terrafix.anchor.relocalization.map_search import MapSearch
from terrafix.anchor.relocalization.position_prior import SIGMAS_95, CurrentBelief, radius_now_m, weigh
from terrafix.anchor.verification.probation import Probation
from terrafix.core.geodesy import LocalFrame
from terrafix.core.node import Image
from terrafix.map.null_model import FlightBudget
from terrafix.map.package import LocalMap
from terrafix.messages import HintVerdict, MapMatch, Origin, PositionHint, Prediction, Verdict

LOST_SIGMA_M = 1000.0  # 1-sigma of a position that is not known, at least; more on a larger map
SCALE_CHANGED = 1.5  # ratio of heights beyond which a search begins anew


def anywhere_m(source: LocalMap) -> float:
    """1-sigma per axis of a position of which nothing is known."""
    e_min, n_min, e_max, n_max = source.bounds_m
    return max(LOST_SIGMA_M, 0.5 * (e_max - e_min), 0.5 * (n_max - n_min))


def mixed_sigma_m(doubt: float, source: LocalMap) -> float:
    """1-sigma per axis that "anywhere", with this probability, adds to a place that is known."""
    return float(np.sqrt(doubt)) * anywhere_m(source)


def start_around(e_m: float, n_m: float, sigma_m: float, source: LocalMap) -> tuple[float, float] | None:
    """Where a search begins: around a place that says something, None when it says no more than the map."""
    e_min, n_min, e_max, n_max = source.bounds_m
    return (e_m, n_m) if sigma_m < 0.25 * max(e_max - e_min, n_max - n_min) else None


class PlaceSearch:
    """One flight's. ``sigma_m``: what the position is known worse by than the estimator thinks, 1-sigma per axis; also
    of a place that is only doubted, and then without a search."""

    def __init__(self) -> None:
        self._search: MapSearch | None = None
        self._probation: Probation | None = None
        self._budget = FlightBudget()
        self.sigma_m = 0.0

    @property
    def is_on(self) -> bool:
        return self._search is not None

    def begin(self, best: MapLayer, agl_m: float, around_m: tuple[float, float] | None) -> None:
        """``around_m``: where; None: the whole map."""
        self._search = MapSearch(best.map, best.matcher, agl_m, around_m, best.null_at(agl_m), self._budget)
        self.sigma_m = anywhere_m(best.map)

    def move(self, step_m: tuple[float, float], sigma_m: float) -> None:
        if self._search is not None:
            self._search.move(*step_m, sigma_m)
        if self._probation is not None:
            self._probation.move(float(np.hypot(*step_m)))

    def tested(self, image: Image, view: View | None) -> float:
        """A frame at the place that was found last, seen from ``view`` (None: several places are possible).

        -> probability that it is wrong; 0 when it is not in question any more, 1 when it is given up."""
        test = self._probation
        if test is None:
            return 0.0
        test.look(image, view)
        if test.passed or test.failed:
            self._probation = None
            return 0.0 if test.passed else 1.0
        return test.doubt

    def answer(self, answer: MapMatch) -> MapMatch:
        """What is said while it is on."""
        return msgspec.structs.replace(
            answer,
            verdict=Verdict.LOST,
            matches=[],
            p_c_in_w_m=None,
            q_w_c=None,
            cov=None,
            inliers=0,
            found=False,
            step=answer.step if self._search is None else self._search.step,
            lost_sigma_m=self.sigma_m,
        )

    def look(
        self, answer: MapMatch, prediction: Prediction, image: Image | None, best: MapLayer, ground_m: float
    ) -> MapMatch:
        """One look; ACCEPTED and ``found``, with the place as the mode, when the search has come to an end."""
        assert self._search is not None
        if not 1 / SCALE_CHANGED < prediction.agl_m / self._search.agl_m < SCALE_CHANGED:
            self.begin(best, prediction.agl_m, None)
        if image is None:
            return self.answer(answer)
        view = view_of(prediction, None, ground_m)
        place = self._search.look(image, view)
        if place is None:
            return self.answer(answer)
        e_m, n_m = place.track.e_m, place.track.n_m
        ground, relief_m = ground_plane(best.map, e_m, n_m, view.agl_m)
        said = msgspec.structs.replace(
            answer, mode_e_m=e_m, mode_n_m=n_m, mode_mass=1.0, ground=ground, relief_m=relief_m
        )
        said = found(said, place.fix, view, place.track.jump_m)
        if said.verdict is not Verdict.ACCEPTED:
            return self.answer(answer)
        self._probation = Probation(self._search.tracks, best.null_at(prediction.agl_m).frame, prediction.agl_m)
        self._search, self.sigma_m = None, mixed_sigma_m(self._probation.doubt, best.map)
        return msgspec.structs.replace(said, lost_sigma_m=self.sigma_m)

    def heed(
        self, hint: PositionHint, origin: Origin, prediction: Prediction, best: MapLayer, odds: float
    ) -> HintVerdict:
        """The operator's hint: where the search goes on, or a comparison with what is believed at these log odds."""
        e_m, n_m = LocalFrame(origin.lat_deg, origin.lon_deg).to_local(hint.lat_deg, hint.lon_deg)
        radius_m = radius_now_m(hint.radius_m, (prediction.t_ns - hint.t_ns) * 1e-9)
        sigma_m = float(np.hypot(np.sqrt(max(prediction.cov[0], prediction.cov[7])), self.sigma_m))
        believed = CurrentBelief(*prediction.p_c_in_w_m[:2], sigma_m, odds)
        weighed = weigh((e_m, n_m), radius_m, believed, best.map.bounds_m, searching=self.is_on)
        tracks = self._search.tracks.all if self._search is not None else []
        follows = any(t.frames and np.hypot(t.e_m - e_m, t.n_m - n_m) <= radius_m for t in tracks)
        around = start_around(e_m, n_m, radius_m / SIGMAS_95, best.map)
        # What a search knows by now is kept where poses speak for a place within the hint, and where the hint says no
        # more than the map.
        if weighed.begins_search and not follows and (around is not None or not self.is_on):
            self.begin(best, prediction.agl_m, around)
        return HintVerdict(
            t_ns=prediction.t_ns,
            hint_t_ns=hint.t_ns,
            verdict=weighed.verdict,
            distance_m=weighed.distance_m,
            sigma_m=sigma_m,
            text=weighed.text,
        )
