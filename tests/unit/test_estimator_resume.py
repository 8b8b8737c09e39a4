"""An estimator that was killed in flight: the next one begins where it left off, as sure as that allows."""

import numpy as np
import pytest
from simulated_flight import FRAME_S, ORIGIN, SPEED_MPS, Flight, Listener, blind, error_m, sigma_m

from terrafix.estimator.node import EstimatorNode
from terrafix.estimator.resume import Keeper, kept
from terrafix.messages import NavEstimate, Odometry, Prediction

KILLED, BACK = 60, 66  # frames: three seconds


@pytest.fixture(scope="module")
def flight() -> Flight:
    return Flight(90, seed=6, dem=True)


@pytest.fixture(scope="module")
def killed(flight: Flight, tmp_path_factory: pytest.TempPathFactory) -> NavEstimate:
    """What it said last, through the file."""
    file = tmp_path_factory.mktemp("run") / "estimator.kept"
    assert kept(file) is None
    keeper = Keeper(file)
    for message in Listener().fly(flight, 0, KILLED).said:
        keeper.heard(message)
    last = kept(file)
    assert last is not None and last.frame_id == KILLED - 1
    return last


def resumed(flight: Flight, last: NavEstimate | None) -> Listener:
    run = Listener()
    run.node = EstimatorNode(0, last)
    run.hear([ORIGIN])
    for i in range(BACK, flight.frames):
        said = flight.messages(i)
        if i == BACK:  # its keyframe is not known to this one
            said = [blind(m) if isinstance(m, Odometry) else m for m in said]
        run.hear(said)
    return run


def test_it_goes_on_from_there(flight: Flight, killed: NavEstimate) -> None:
    run = resumed(flight, killed)
    first = run.estimate(BACK)
    assert np.linalg.norm(error_m(first, flight)[:2]) < 25.0
    assert sigma_m(killed) < sigma_m(first) < 40.0
    for i in range(BACK, flight.frames):
        said = run.estimate(i)
        assert np.linalg.norm(error_m(said, flight)[:2]) < 3.5 * np.sqrt(2.0) * sigma_m(said)
    assert sigma_m(run.estimate(flight.frames - 1)) < 10.0


def test_the_anchor_is_told_of_the_way_in_between(flight: Flight, killed: NavEstimate) -> None:
    told = next(m for m in resumed(flight, killed).said if isinstance(m, Prediction))
    flown_m = flight.p_m[BACK, :2] - flight.p_m[KILLED - 1, :2]
    assert np.linalg.norm(told.step_m - flown_m) < 20.0 < np.linalg.norm(flown_m)


def test_without_what_it_left_it_knows_the_start_only(flight: Flight) -> None:
    """Half a minute ago, and so it claims little."""
    first = resumed(flight, None).estimate(BACK)
    assert sigma_m(first) > 0.5 * SPEED_MPS * FRAME_S * BACK
