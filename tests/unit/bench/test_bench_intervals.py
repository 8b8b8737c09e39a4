"""Measured interval of GPS_INPUT in a record against the generated intervals."""

import numpy as np
import pytest

from terrafix.messages import GpsInput, Message, ProcessEvent
from terrafix_lab.bench.intervals import measure


def gps(t_ms: float, age_ms: float, fix_type: int = 3) -> GpsInput:
    return GpsInput(
        t_ns=round(t_ms * 1e6), fix_type=fix_type, time_week=0, time_week_ms=0, lat_deg=48.0, lon_deg=11.0,
        alt_amsl_m=0.0, hdop=1.0, vdop=1.0, vn_mps=0.0, ve_mps=0.0, vd_mps=0.0, speed_accuracy_mps=0.5,
        horiz_accuracy_m=3.0, vert_accuracy_m=3.0, satellites_visible=6, estimate_age_ms=age_ms)  # fmt: skip


def flight(gaps_ms: np.ndarray) -> list[Message]:
    """An image every 500 ms whose estimate is available 150 ms later."""
    messages: list[Message] = []
    for t_ms in np.concatenate([[0.0], np.cumsum(gaps_ms)]) + 10_000.0:
        image_ms = np.floor((t_ms - 150.0) / 500.0) * 500.0
        messages.append(gps(t_ms, t_ms - image_ms))
    return messages


def test_measured_intervals_equal_those_of_the_messages() -> None:
    gaps = np.full(1000, 100.0)
    gaps[10], gaps[20:25] = 300.0, 130.0
    pace = measure(flight(gaps))
    assert pace.gps_inputs == 1001
    assert (pace.interval_median_ms, pace.longest_gap_ms) == (pytest.approx(100.0), pytest.approx(300.0))
    assert pace.interval_p99_ms == pytest.approx(np.percentile(gaps, 99, method="inverted_cdf"))
    assert (pace.over_p99_floor, pace.over_gap_floor) == (6, 1)
    assert not pace.meets_ac14  # the gap
    assert measure(flight(np.full(1000, 100.0))).meets_ac14
    assert not measure(flight(np.full(1000, 104.0))).meets_ac14


def test_ages_count_from_the_exposure() -> None:
    """Sent every 100 ms; the first message after the estimate (150 ms) has an age of 200 ms, the last of 600 ms."""
    pace = measure(flight(np.full(1000, 100.0)))
    assert pace.first_age_median_ms == pytest.approx(200.0, abs=1.0)
    assert pace.first_age_p95_ms == pytest.approx(200.0, abs=1.0)
    assert pace.age_p95_ms == pytest.approx(600.0, abs=1.0)


def test_messages_without_fix_have_no_age_and_process_deaths_are_listed() -> None:
    died = ProcessEvent(t_ns=0, process="vision", event="died")
    started = ProcessEvent(t_ns=0, process="vision", event="started")
    pace = measure([gps(0.0, -1.0, 1), died, started, gps(100.0, 180.0)])
    assert (pace.fix3_share, pace.first_age_p95_ms, pace.trouble) == (0.5, 180.0, ["vision died"])


def test_an_empty_record_does_not_meet_the_criterion() -> None:
    pace = measure([])
    assert (pace.meets_ac14, pace.interval_p99_ms, pace.fix3_share) == (False, None, 0.0)
