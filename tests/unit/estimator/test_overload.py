"""A computer with too much to do: frames are dropped, messages lost or late. What nothing measured is unknown
motion."""

import numpy as np
import pytest

from inertial_flight import InertialFlight
from overloaded_flight import FRAME_EVERY, FRAME_S, LateStamps, Load, fly, sigma_m
from seeds import seeds
from terrafix.messages import Verdict

SECONDS, SETTLED_S = 30, 8.0  # of flight; until the place of a plane that began in the air is known


@pytest.fixture(scope="module")
def plane() -> InertialFlight:
    """27 m/s, banked turns."""
    return InertialFlight(4, SECONDS, FRAME_EVERY)


def burst(seconds: float) -> Load:
    first = round(15.0 / FRAME_S)
    return Load(lost=lambda i: first <= i < first + seconds / FRAME_S)


LOSSES = {
    "single ones": Load(lost=lambda i: i % 10 == 7),
    "every other one": Load(lost=lambda i: i % 2 == 1),
    "a second": burst(1.0),
    "three seconds": burst(3.0),
    "before a bad image": Load(lost=lambda i: i % 9 == 3, overtaken=lambda i: i % 9 == 4),
    "after a bad image": Load(lost=lambda i: i % 9 == 5, overtaken=lambda i: i % 9 == 4),
    "three of four bad, and every fifth": Load(lost=lambda i: i % 5 == 0, overtaken=lambda i: i % 4 != 0),
}


@pytest.mark.slow
@pytest.mark.parametrize("load", LOSSES.values(), ids=LOSSES.keys())
def test_lost_odometry_is_unknown_motion_and_the_map_is_believed_after_it(plane: InertialFlight, load: Load) -> None:
    flown = fly(plane, load)
    settled = [e for e, _ in flown.estimates if e.t_ns * 1e-9 > SETTLED_S]
    assert len(flown.claimed(SETTLED_S)) > 0.9 * len(settled)
    assert flown.worst() < 3.0
    assert len(flown.maps(SETTLED_S)) >= 10 and set(flown.maps(SETTLED_S)) == {Verdict.ACCEPTED}


@pytest.mark.parametrize("seed", seeds(3, 4))
def test_right_matches_are_believed_though_attitudes_came_late_at_the_start(seed: int) -> None:
    """An attitude of 0.8 s before, taken for that of the frame, put the tilt of then into the mount, and the matches
    after it were rejected, some for as long as the plane flew."""
    late = Load(
        overtaken=lambda i: i % 4 != 0,
        telemetry_late=lambda i: 4 if i * FRAME_S < 3.0 else 0,
        match_every_s=2.0,
        match_late_s=1.2,
    )
    flown = fly(InertialFlight(seed, 14, FRAME_EVERY), late)
    assert len(flown.maps()) >= 5 and set(flown.maps()) == {Verdict.ACCEPTED}
    assert flown.worst() < 3.0 and flown.claimed(12.0)


BEGIN_S, END_S = 16.0, 22.0  # of stamps that get later


@pytest.mark.slow
@pytest.mark.parametrize("seed", seeds(1, 4))
def test_a_plane_is_found_again_after_stamps_that_got_later(seed: int) -> None:
    """When the stamps were right again the estimate was 25 m behind and 4 m/s too slow. Each right match was then
    farther from it than the one before, so that no two seemed to agree, and all were rejected to the end of the flight.
    Late matches are rejected where innovations of one sign do not tell before. Images and inertial readings contradict
    each other, and the stamps jump before 90 m of way between places could tell that the images are right."""
    flown = fly(LateStamps(seed, 36, lambda s: 0.15 * s, BEGIN_S, END_S), Load())
    assert Verdict.INNOVATION in flown.maps(END_S) or flown.resets(BEGIN_S), "or this test shows nothing"
    found_s = END_S + 7.0
    assert set(flown.maps(found_s)) == {Verdict.ACCEPTED} and len(flown.maps(found_s)) >= 7
    assert flown.worst(END_S + 5.0) < 3.0
    wrong = [e for e, error_m in flown.claimed(END_S) if float(np.hypot(*error_m)) > 3.0 * sigma_m(e)]
    assert len(wrong) <= 5, "until the first match after it: the images and the map contradict the estimate together"


@pytest.mark.slow
@pytest.mark.parametrize("seed", seeds(1, 4))
def test_odometry_to_one_side_of_the_prediction_is_a_wrong_velocity_before_a_match_is_rejected(seed: int) -> None:
    """Stamps that get later, and faster so: no image is far from the prediction, and each one is behind it."""
    flown = fly(LateStamps(seed, 22, lambda s: 0.05 * s**2, BEGIN_S, END_S), Load())
    (first, *_) = flown.resets(BEGIN_S)
    assert "to one side of the prediction" in first.detail and first.t_ns * 1e-9 < BEGIN_S + 4.0
    rejected = [v.t_ns for v in flown.verdicts if v.measurement == "map" and v.verdict is Verdict.INNOVATION]
    assert not rejected or first.t_ns <= min(rejected)


@pytest.mark.parametrize("seed", seeds(1, 4))
def test_matches_that_all_come_after_their_frame_has_left_the_window_place_a_plane(seed: int) -> None:
    """The anchor works on each for 6 s: with ten runnable processes for each core it took 14, all matches were stale,
    and nothing placed the plane as long as it flew."""
    flown = fly(InertialFlight(seed, 24, FRAME_EVERY), Load(match_every_s=6.0, match_late_s=6.0))
    assert Verdict.ACCEPTED in flown.maps()
    assert flown.worst() < 3.0
    estimate, error_m = flown.estimates[-1]
    assert float(np.hypot(*error_m)) < 3.0 * sigma_m(estimate) and sigma_m(estimate) < 30.0
