"""A flight without a reported height: the estimator does not invent one, and the first map match measures it."""

import numpy as np
import pytest

from simulated_flight import EstimatorRun, Flight, cov_of, error_m, without_fix
from terrafix.estimator.models.terrain import Terrain
from terrafix.messages import Prediction

FIRST_MATCH = 36


@pytest.mark.parametrize("knows", [{"yaw", "attitude"}, set()], ids=["attitude", "nothing"])
def test_the_height_stays_unknown_until_a_match_measures_it(knows: set[str]) -> None:
    flight, listener = Flight(72, seed=3, telemetry=frozenset(knows)), EstimatorRun()
    listener.fly(flight, 0, FIRST_MATCH, without_fix).fly(flight, FIRST_MATCH, flight.frames)
    predicted = {m.frame_id: m for m in listener.published if isinstance(m, Prediction)}
    for i in range(min(predicted), FIRST_MATCH + 1):
        off_m = predicted[i].agl_m - float(flight.p_m[i, 2])
        assert abs(off_m) < predicted[i].agl_sigma_m and 60.0 < predicted[i].agl_m < 200.0
    after = predicted[FIRST_MATCH + 12]
    assert after.agl_sigma_m < 8.0 and abs(after.agl_m - float(flight.p_m[FIRST_MATCH + 12, 2])) < 16.0
    last = listener.estimate(flight.frames - 1)
    off = error_m(last, flight)[:2]
    assert float(off @ np.linalg.solve(cov_of(last)[:2, :2], off)) < 13.8
    assert last.velocity_sigma_mps < 3.0


def test_a_camera_below_the_ground_has_an_unknown_height_again(monkeypatch: pytest.MonkeyPatch) -> None:
    flight, run = Flight(20, seed=3, telemetry=frozenset()), EstimatorRun()
    run.fly(flight, 0, 19, without_fix)
    monkeypatch.setattr(Terrain, "height_above_m", lambda _self, p_m: float(p_m[2]) - 900.0)
    run.fly(flight, 19, 20, without_fix)
    assert "where the ground is" in run.verdicts("reset")[19].detail and run.estimate(19).cov[14] > 100.0**2
