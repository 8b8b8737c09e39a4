"""A flight whose heading nobody says: the estimator does not make one up, and the first map match tells it."""

import math

import msgspec
import numpy as np
import pytest
from simulated_flight import ORIGIN, Flight, Listener, cov_of, error_m

from terrafix.core.camera import Mount
from terrafix.core.geodesy import rot_from_quat, yaw_of
from terrafix.messages import MapMatch, Prediction, Verdict

FIRST_MATCH = 27


def flown(knows: set[str], *, seed: int, coarse: bool = False) -> tuple[Flight, Listener]:
    """To a quarter of a minute after the first match; with ``coarse`` that one has no pose of its own."""
    flight, listener = Flight(FIRST_MATCH + 30, seed=seed, knows=frozenset(knows)), Listener()
    listener.hear([ORIGIN])
    for i in range(flight.frames):
        messages = [m for m in flight.messages(i) if not (isinstance(m, MapMatch) and i < FIRST_MATCH)]
        if coarse and i == FIRST_MATCH:
            messages = [msgspec.structs.replace(m, coarse=True) if isinstance(m, MapMatch) else m for m in messages]
        listener.hear(messages)
    return flight, listener


def headings_rad(listener: Listener) -> dict[int, float]:
    predicted = (m for m in listener.said if isinstance(m, Prediction))
    return {m.frame_id: yaw_of(rot_from_quat(m.q_w_c) @ Mount().r_b_c().T) for m in predicted}


@pytest.mark.parametrize("seed", [2, 4])
@pytest.mark.parametrize("knows", [{"height", "attitude"}, {"height"}, set()], ids=["attitude", "height", "nothing"])
def test_the_heading_stays_open_until_a_match_says_it(knows: set[str], seed: int) -> None:
    flight, listener = flown(knows, seed=seed)
    yaw_rad = headings_rad(listener)
    truth_rad = [yaw_of(r) for r in flight.r_w_b]
    for said in (m for m in listener.said if isinstance(m, Prediction) and 0 < m.frame_id <= FIRST_MATCH):
        i = said.frame_id
        assert said.cov[35] > 2.5**2
        # It is a choice of axes: what is seen turns the vehicle in them, and nothing turns the axes.
        turned = math.remainder(yaw_rad[i] - yaw_rad[0] - truth_rad[i] + truth_rad[0], math.tau)
        assert abs(turned) < math.radians(5.0)
        off_m = np.array(said.p_c_in_w_m[:2]) - flight.p_m[i, :2]
        assert float(off_m @ np.linalg.solve(np.array(said.cov).reshape(6, 6)[:2, :2], off_m)) < 9.0
    assert listener.verdicts("map")[FIRST_MATCH].verdict is Verdict.ACCEPTED
    last = listener.estimate(flight.frames - 1)
    assert abs(math.remainder(yaw_rad[flight.frames - 1] - truth_rad[-1], math.tau)) < math.radians(4.0)
    off_m = error_m(last, flight)[:2]
    assert float(off_m @ np.linalg.solve(cov_of(last)[:2, :2], off_m)) < 13.8 and np.hypot(*off_m) < 15.0
    assert last.velocity_sigma_mps < 3.0


def test_the_velocity_has_no_direction_without_a_heading() -> None:
    flight, listener = flown({"height"}, seed=2)
    said = listener.estimate(FIRST_MATCH - 1)
    assert said.velocity_sigma_mps >= np.hypot(*said.velocity_enu_mps[:2]) > 0.5 * flight.speed_mps


def test_a_match_without_a_pose_of_its_own_does_not_tell_the_heading() -> None:
    _, listener = flown({"height"}, seed=2, coarse=True)
    verdicts = listener.verdicts("map")
    assert verdicts[FIRST_MATCH].verdict is Verdict.AMBIGUOUS
    assert verdicts[FIRST_MATCH + 9].verdict is Verdict.ACCEPTED
