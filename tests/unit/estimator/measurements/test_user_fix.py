"""A user fix is a gated measurement of the position of its frame."""

from typing import Any

import numpy as np
import pytest

from simulated_flight import PLACE, EstimatorRun, Flight, error_m, sigma_m, t_ns, without_fix
from terrafix.core.gate import GATE
from terrafix.core.log_lines import MessageLog
from terrafix.messages import MeasurementVerdict, NavEstimate, PositionHint, Verdict

FRAMES = 24


@pytest.fixture(scope="module")
def flight() -> Flight:
    return Flight(FRAMES, seed=2)


def flown(flight: Flight) -> EstimatorRun:
    """Without map matches: the start is known to 15 m."""
    return EstimatorRun().fly(flight, 0, 1).fly(flight, 1, FRAMES, without_fix)


def fix(flight: Flight, i: int, off_m: tuple[float, float] = (0.0, 0.0), sigma_m: float | None = 5.0) -> PositionHint:
    lat_deg, lon_deg = PLACE.to_wgs84(*(float(m) for m in flight.p_m[i, :2] + off_m))
    position: dict[str, Any] = {"lat_deg": lat_deg, "lon_deg": lon_deg, "radius_m": 15.0, "source": "console"}
    return PositionHint(t_ns=t_ns(FRAMES - 1) + 7, frame_id=i, sigma_m=sigma_m, **position)


def test_a_fix_of_an_earlier_frame_places_the_newest_one_and_a_hint_or_a_fix_far_away_does_not(flight: Flight) -> None:
    run, last = flown(flight), FRAMES - 1
    before = run.estimate(last)
    assert sigma_m(before) > 8.0
    assert run.feed([fix(flight, last, sigma_m=None)]) == []
    (refused,) = run.feed([fix(flight, last, (400.0, 0.0))])
    assert isinstance(refused, MeasurementVerdict) and refused.verdict is Verdict.INNOVATION
    assert refused.test_ratio is not None and refused.test_ratio > 1.0 and "m from the estimate" in refused.detail
    assert refused.test_ratio == pytest.approx((refused.mahalanobis2 or 0.0) / GATE[2])
    (stale,) = run.feed([fix(flight, 0)])
    assert isinstance(stale, MeasurementVerdict) and stale.verdict is Verdict.STALE
    applied, after = run.feed([fix(flight, last - 3)])
    assert isinstance(applied, MeasurementVerdict) and isinstance(after, NavEstimate)
    assert (applied.verdict, applied.measurement, applied.frame_id) == (Verdict.ACCEPTED, "user_fix", last - 3)
    entry = MessageLog().entry(applied)
    assert entry is not None and (entry.level, entry.event) == ("info", "UserFixApplied")
    assert sigma_m(after) < 6.5 and sigma_m(after) > 3.0
    assert np.hypot(*error_m(after, flight)[:2]) < min(np.hypot(*error_m(before, flight)[:2]) + 1.0, 10.0)
