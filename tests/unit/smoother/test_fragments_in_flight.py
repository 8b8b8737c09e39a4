"""Fragments over ground without a map, each of which reaches the map: merged in flight by estimator and smoother."""

from collections.abc import Iterator

import msgspec
import numpy as np
import pytest

from simulated_flight import KEYFRAME_EVERY, ORIGIN, PLACE, Flight, blind, t_ns
from terrafix.estimator.node import EstimatorNode
from terrafix.messages import MapMatch, Message, NavEstimate, Odometry, RefinedPose, Refinement
from terrafix.smoother.node import SmootherNode

FRAMES = 240
FRAGMENTS = (range(72), range(87, 150), range(165, FRAMES))
SEED = 4  # of the flight that most tests read
MAPPED = 12  # last frames of each fragment, over ground that the map shows


def messages(flight: Flight) -> Iterator[Message]:
    """Odometry connects the frames of each fragment; the first one of a fragment is registered to none."""
    yield ORIGIN
    for i in range(FRAMES):
        number = next((n for n, frames in enumerate(FRAGMENTS) if i in frames), None)
        for message in flight.messages(i):
            if isinstance(message, MapMatch):
                continue
            if isinstance(message, Odometry):
                first = 0 if number is None else FRAGMENTS[number].start
                if number is None or (i == first and i > 0):
                    message = msgspec.structs.replace(blind(message), becomes_keyframe=i % KEYFRAME_EVERY == 0)
                else:
                    message = msgspec.structs.replace(message, fragment_id=number)
            yield message
        if number is not None and i >= FRAGMENTS[number].stop - MAPPED and i % 3 == 0:
            yield flight.fix(i)


class FragmentFlight:
    def __init__(self, seed: int) -> None:
        self.flight = Flight(FRAMES, seed=seed, dem=True)
        self.refined: dict[int, RefinedPose] = {}
        self.first_ns: dict[int, int] = {}  # of the first Refinement with each fragment
        self.estimates: dict[int, NavEstimate] = {}  # first of each frame
        estimator, smoother = EstimatorNode(), SmootherNode()
        for message in messages(self.flight):
            published = [*estimator.on(message)]
            for given in (message, *published):
                for refinement in smoother.on(given):
                    if isinstance(refinement, Refinement):
                        self._take(refinement)
            for given in published:
                if isinstance(given, NavEstimate):
                    self.estimates.setdefault(given.frame_id, given)

    def _take(self, refinement: Refinement) -> None:
        for pose in refinement.poses:
            self.refined[pose.frame_id] = pose
            self.first_ns.setdefault(pose.fragment_id, refinement.t_ns)

    def error_m(self, pose: RefinedPose | NavEstimate) -> np.ndarray:
        return np.array(PLACE.to_local(pose.lat_deg, pose.lon_deg)) - self.flight.p_m[pose.frame_id, :2]

    def nees(self) -> np.ndarray:
        poses = list(self.refined.values())
        errors = np.array([self.error_m(pose) for pose in poses])
        covs = [[[p.sigma_e_m**2, p.cov_en_m2], [p.cov_en_m2, p.sigma_n_m**2]] for p in poses]
        return np.einsum("ni,ni->n", errors, np.linalg.solve(np.array(covs), errors[..., None])[..., 0])


@pytest.fixture(scope="module")
def flown() -> FragmentFlight:
    return FragmentFlight(SEED)


def test_three_fragments_are_anchored_and_their_past_is_refined_within_five_seconds_of_the_last_anchor(
    flown: FragmentFlight,
) -> None:
    for number, frames in enumerate(FRAGMENTS):
        anchored_ns = t_ns(next(i for i in frames if i >= frames.stop - MAPPED and i % 3 == 0))
        assert anchored_ns <= flown.first_ns[number] <= anchored_ns + 5_000_000_000
        mine = [i for i, pose in flown.refined.items() if pose.fragment_id == number]
        assert len(mine) >= 0.9 * len(frames) - 3


def test_the_refined_past_of_all_fragments_is_right_to_five_metres_in_the_median_where_the_estimates_were_not(
    flown: FragmentFlight,
) -> None:
    before = [np.hypot(*flown.error_m(flown.estimates[i])) for i in FRAGMENTS[2][:-MAPPED]]
    after = [np.hypot(*flown.error_m(pose)) for pose in flown.refined.values()]
    assert np.median(before) > 10.0
    assert np.median(after) <= 5.0


@pytest.mark.slow
def test_the_covariance_of_refined_poses_holds_over_many_flights(flown: FragmentFlight) -> None:
    nees = np.concatenate([flown.nees(), *(FragmentFlight(seed).nees() for seed in range(3) if seed != SEED)])
    assert float(np.mean(nees < 5.991)) >= 0.93 and 0.3 < float(np.mean(nees)) < 2.6
